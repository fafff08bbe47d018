"""How often each message goes and is asked for, held against the tables that docs/mavlink.md is made from."""

from __future__ import annotations

import re
import time
from collections import Counter
from itertools import pairwise

import pytest

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.links.mavlink_table import READ, SENT
from edge.links.mavlink_vehicle import Vehicle
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, on_the_wire
from .reports import TRACKING, make_report, make_track

SECONDS, FPS = 20, 60


def told_hz(text: str) -> float | None:
    """The rate in a cell of the tables; None where there is none."""
    told = re.search(r"([\d.]+) Hz", text)
    return float(told[1]) if told else None


def flown(settings: MavlinkSettings, autopilot: int) -> tuple[Counter[str], dict[int, float]]:
    """How often each message went in SECONDS with a target in each frame, and the rates asked of the autopilot."""
    station = Station(settings, OwnShipBuffer(gimballed=True), CAMERA, RequestQueue())
    peer, began_ns = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1), time.monotonic_ns()
    went, asked_hz = Counter[str](), dict[int, float]()
    for frame in range(SECONDS * FPS):
        now_ns = began_ns + frame * 1_000_000_000 // FPS
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, autopilot, 0, 0, 4, 3)
        station.take(FrameReader(datagram=True).feed(beat.pack(peer)), 0, now_ns)
        station.health(TRACKING, now_ns)
        out = station.tick(now_ns)
        sent = [*out.everywhere, *out.home, *station.report(make_report(make_track(now_ns), now_ns=now_ns), now_ns)]
        for message in on_the_wire(sent):
            went[message.get_type()] += 1
            if message.get_type() == "COMMAND_LONG":
                asked_hz[int(message.param1)] = 1e6 / message.param2
    went["HEARTBEAT"] //= 2  # of two components
    return went, asked_hz


def test_every_message_goes_and_is_asked_for_as_often_as_the_tables_say() -> None:
    settings = MavlinkSettings(follow_target=True, adsb_icao_address=0xF00000, onboard_computer_status=True)
    went, asked_hz = flown(settings, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    for row in SENT:
        if (hz := told_hz(row.rate)) is not None:
            assert went[row.name] == pytest.approx(SECONDS * hz, abs=1), row.name
    assert asked_hz == pytest.approx({row.message_id: told_hz(row.rate) for row in READ if "requested" in row.rate})


@pytest.mark.parametrize("autopilot", [dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, dialect.MAV_AUTOPILOT_PX4])
def test_what_goes_unasked_by_default_is_what_the_table_says(autopilot: int) -> None:
    went, _ = flown(MavlinkSettings(), autopilot)
    to_px4 = autopilot == dialect.MAV_AUTOPILOT_PX4
    wanted = {row.name for row in SENT if row.default == "on" or (row.default == "on, off to PX4" and not to_px4)}
    assert set(went) == wanted - {"STATUSTEXT", "COMMAND_ACK"}  # on a change, and to a command: there was none


@pytest.mark.parametrize("late_ms", [(0,), (0, 0, 40, 40), (0, 40, 80)])
def test_what_comes_once_a_second_as_asked_is_not_asked_again_for_its_jitter(late_ms: tuple[int, ...]) -> None:
    """An autopilot sends at its main loop's next turn."""
    rate_hz, ms = {dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0}, 1_000_000
    vehicle = Vehicle(None, rate_hz)
    arrives_ms = {1_000 * second + 20 + late_ms[second % len(late_ms)] for second in range(60)}
    for now_ms in range(0, 60_000, 10):
        if now_ms % 1_000 == 0:
            vehicle.heartbeat(SYSTEM_ID, dialect.MAV_AUTOPILOT_PX4, now_ms * ms)
        if now_ms in arrives_ms:
            vehicle.arrived(dialect.MAVLINK_MSG_ID_SYSTEM_TIME, now_ms * ms)
        if vehicle.request(now_ms * ms) is not None:
            vehicle.acknowledged(accepted=True)
    assert vehicle.asked_again == 0


def test_a_rate_that_is_never_given_is_asked_for_ever_more_rarely_but_for_as_long_as_it_is_not() -> None:
    """After 3 s, then twice that each time, up to every 30 s."""
    second = 1_000_000_000
    vehicle, asked_s = Vehicle(None, {dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0}), []
    for now_s in range(200):
        vehicle.heartbeat(SYSTEM_ID, dialect.MAV_AUTOPILOT_PX4, now_s * second)
        if vehicle.request(now_s * second) is not None:
            asked_s.append(now_s)
            vehicle.acknowledged(accepted=False)
    assert [later - before for before, later in pairwise(asked_s)] == [3, 6, 12, 24, 30, 30, 30, 30, 30]


def test_texts_in_parts_go_on_after_more_of_them_than_their_numbers_count() -> None:
    station = Station(MavlinkSettings(system_id=SYSTEM_ID), OwnShipBuffer(), CAMERA, RequestQueue())
    numbers = []
    for _ in range(2**16 + 1):
        first, second = station.event(dialect.MAV_SEVERITY_WARNING, 51 * "x", 0)
        assert first.message.id == second.message.id
        numbers.append(first.message.id)
    assert (min(numbers), max(numbers)) == (1, 2**16 - 1), "0 is of a text that has no parts"
    assert all(before != later for before, later in pairwise(numbers))
