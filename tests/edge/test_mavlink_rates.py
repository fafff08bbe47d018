"""How often each message goes and is asked for, held against the tables that docs/mavlink.md is made from."""

from __future__ import annotations

import re
import time
from collections import Counter

import pytest

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.links.mavlink_table import READ, SENT
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID
from .reports import TRACKING, make_report, make_track

SECONDS, FPS = 20, 60


def asked_hz(text: str) -> float | None:
    """The rate in a cell of the tables; None where there is none."""
    told = re.search(r"([\d.]+) Hz", text)
    return float(told[1]) if told else None


def test_every_message_goes_and_is_asked_for_as_often_as_the_tables_say() -> None:
    settings = MavlinkSettings(follow_target=True, adsb_icao_address=0xF00000, onboard_computer_status=True)
    station = Station(settings, OwnShipBuffer(gimballed=True), CAMERA, RequestQueue())
    peer, began_ns, went = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1), time.monotonic_ns(), Counter[str]()
    asked_of_us: dict[int, float] = {}
    for frame in range(SECONDS * FPS):
        now_ns = began_ns + frame * 1_000_000_000 // FPS
        beat = dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
        station.take(FrameReader(datagram=True).feed(beat.pack(peer)), 0, now_ns)
        station.health(TRACKING, now_ns)
        out = station.tick(now_ns)
        sent = [*out.everywhere, *out.home, *station.report(make_report(make_track(now_ns), now_ns=now_ns), now_ns)]
        for message in FrameReader(datagram=False).feed(b"".join(sent)):
            went[message.get_type()] += 1
            if message.get_type() == "COMMAND_LONG":
                asked_of_us[int(message.param1)] = 1e6 / message.param2
    told_hz = {row.name: asked_hz(row.rate) for row in SENT}
    went["HEARTBEAT"] //= 2  # of two components
    for name, hz in told_hz.items():
        if hz is not None:
            assert went[name] == pytest.approx(SECONDS * hz, abs=1), name
    told = {row.message_id: asked_hz(row.rate) for row in READ if "asked" in row.rate}
    assert asked_of_us == pytest.approx(told)
