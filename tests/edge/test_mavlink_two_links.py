"""Two links, of which one carries somebody who speaks in the autopilot's name."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, on_the_wire
from .reports import make_report as report
from .reports import make_track as track

HOME, OTHER = 0, 1
MS = 1_000_000
BEGAN_NS = 1_000_000 * MS
ARDUPILOT, PX4 = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, dialect.MAV_AUTOPILOT_PX4
LEVEL, UPSIDE_DOWN = Rotation.identity(), Rotation.from_euler("x", np.pi)


class Air:
    """A station with two links, and whoever speaks on them as system 42's autopilot."""

    def __init__(self) -> None:
        self.own_ship = OwnShipBuffer()
        self.station = Station(MavlinkSettings(), self.own_ship, CAMERA, RequestQueue())
        self._mav = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)

    def beat(self, link: int, now_ns: int, autopilot: int = ARDUPILOT) -> None:
        self.tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, autopilot, 0, 0, 4, 3), link, now_ns)

    def attitude(self, link: int, now_ns: int, rotation: Rotation) -> None:
        q = np.roll(rotation.as_quat(), 1).tolist()
        self.tell(dialect.MAVLink_attitude_quaternion_message(now_ns // MS, *q, 0.0, 0.0, 0.0), link, now_ns)

    def tilt_deg(self, now_ns: int) -> float | None:
        now = self.own_ship.at(now_ns)
        return None if now is None else float(np.degrees(Rotation.from_matrix(now.R_ned_body).magnitude()))

    def tell(self, message: Any, link: int, now_ns: int) -> list[Any]:
        """Replies to it."""
        return on_the_wire(self.station.take(FrameReader(datagram=True).feed(message.pack(self._mav)), link, now_ns))

    def fly(self, began_ns: int, ended_ns: int, home_heard: Callable[[int], bool]) -> None:
        """Level on the home link while that is heard, upside down on the other one."""
        for now_ns in range(began_ns, ended_ns, 20 * MS):
            self.station.tick(now_ns)
            for link, rotation in ((HOME, LEVEL), (OTHER, UPSIDE_DOWN)):
                if link == HOME and not home_heard(now_ns - began_ns):
                    continue
                if now_ns % (1_000 * MS) == 0:
                    self.beat(link, now_ns)
                self.attitude(link, now_ns, rotation)


def test_an_autopilot_that_still_speaks_on_its_link_is_not_heard_on_another_when_its_heartbeats_are_lost() -> None:
    air = Air()
    air.beat(HOME, BEGAN_NS)
    for now_ns in range(BEGAN_NS, BEGAN_NS + 8_000 * MS, 20 * MS):
        air.station.tick(now_ns)
        air.attitude(HOME, now_ns, LEVEL)
        if now_ns % (1_000 * MS) == 0:
            air.beat(OTHER, now_ns)
        air.attitude(OTHER, now_ns + 5 * MS, UPSIDE_DOWN)
        assert air.tilt_deg(now_ns + 6 * MS) == 0.0
    # Silent altogether, it is looked for where it is.
    gone_ns = BEGAN_NS + 8_000 * MS
    for now_ns in range(gone_ns, gone_ns + 5_000 * MS, 20 * MS):
        air.station.tick(now_ns)
        if now_ns % (1_000 * MS) == 0:
            air.beat(OTHER, now_ns)
        air.attitude(OTHER, now_ns, UPSIDE_DOWN)
    assert air.tilt_deg(gone_ns + 5_000 * MS - 20 * MS) == 180.0


def test_the_other_link_does_not_say_which_autopilot_it_is() -> None:
    """PX4 would take TARGET_RELATIVE for its landing target, and from ArduPilot it must not be kept."""
    for autopilot, claimed in ((PX4, ARDUPILOT), (ARDUPILOT, PX4)):
        air = Air()
        air.beat(HOME, BEGAN_NS, autopilot)
        air.beat(OTHER, BEGAN_NS + 500 * MS, claimed)
        now_ns = BEGAN_NS + 600 * MS
        letters = air.station.report(report(track(now_ns), now_ns=now_ns), now_ns)
        sent = {message.get_type() for message in on_the_wire(letters)}
        assert "CAMERA_TRACKING_IMAGE_STATUS" in sent
        assert ("TARGET_RELATIVE" in sent) == (autopilot == ARDUPILOT)


def test_the_link_that_is_listed_first_is_believed_again_once_it_is_heard_again() -> None:
    hiccup = range(5_000 * MS, 9_000 * MS)
    for until_ms, tilt_deg in ((4_980, 0.0), (8_980, 180.0), (10_900, 180.0), (13_000, 0.0)):
        air = Air()
        air.fly(BEGAN_NS, BEGAN_NS + (until_ms + 20) * MS, lambda since_ns: since_ns not in hiccup)
        assert air.tilt_deg(BEGAN_NS + until_ms * MS) == tilt_deg, f"after {until_ms} ms"


def test_the_link_that_is_listed_first_is_believed_though_another_was_heard_before_it() -> None:
    air = Air()
    air.fly(BEGAN_NS, BEGAN_NS + 2_000 * MS, lambda since_ns: False)
    assert air.tilt_deg(BEGAN_NS + 1_980 * MS) == 180.0
    air.fly(BEGAN_NS + 2_000 * MS, BEGAN_NS + 6_000 * MS, lambda since_ns: True)
    assert air.tilt_deg(BEGAN_NS + 5_980 * MS) == 0.0
    assert air.station.home == HOME, "and asked there"


def test_a_link_that_is_heard_now_and_then_does_not_take_the_place_of_one_that_is_heard_all_the_time() -> None:
    air = Air()
    air.fly(BEGAN_NS, BEGAN_NS + 2_000 * MS, lambda since_ns: False)
    began_ns = BEGAN_NS + 2_000 * MS
    for second in range(0, 30, 2):
        air.fly(began_ns + second * 1_000 * MS, began_ns + (second + 2) * 1_000 * MS, lambda since_ns: since_ns == 0)
        assert air.tilt_deg(began_ns + (second + 2) * 1_000 * MS - 20 * MS) == 180.0


def test_a_link_that_brings_heartbeats_alone_gives_the_place_back_to_the_one_that_brought_telemetry() -> None:
    """As where a ground station, listed first, passes on what its own radio hears and none of our questions."""
    air, silent_s = Air(), 0
    for now_ns in range(BEGAN_NS, BEGAN_NS + 90_000 * MS, 20 * MS):
        air.station.tick(now_ns)
        air.attitude(OTHER, now_ns, UPSIDE_DOWN)
        if now_ns % (1_000 * MS) == 0:
            silent_s += air.tilt_deg(now_ns) is None
            air.beat(OTHER, now_ns)
            if now_ns >= BEGAN_NS + 5_000 * MS:
                air.beat(HOME, now_ns)
    assert air.tilt_deg(BEGAN_NS + 89_980 * MS) == 180.0
    assert silent_s < 20, "it is tried once and no more"


def test_of_several_links_that_bring_heartbeats_alone_none_keeps_the_place_of_the_one_that_brought_telemetry() -> None:
    air, telling = Air(), 2
    for now_ns in range(BEGAN_NS, BEGAN_NS + 60_000 * MS, 20 * MS):
        air.station.tick(now_ns)
        if air.station.home in (None, telling):  # asked elsewhere, it streams no more
            air.attitude(telling, now_ns, UPSIDE_DOWN)
        if now_ns % (1_000 * MS) == 0:
            air.beat(telling, now_ns)
            for link in (0, 1):
                if now_ns >= BEGAN_NS + (7_000 - 2_000 * link) * MS:
                    air.beat(link, now_ns)
    assert air.station.home == telling
    assert air.tilt_deg(BEGAN_NS + 59_980 * MS) == 180.0


def test_our_clock_is_told_on_any_link_and_the_autopilots_is_believed_on_one() -> None:
    air = Air()
    air.beat(HOME, BEGAN_NS)
    (question,) = (m for m in on_the_wire(air.station.tick(BEGAN_NS).home) if m.get_type() == "TIMESYNC")
    for link in (HOME, OTHER):
        (answer,) = air.tell(dialect.MAVLink_timesync_message(0, 7 + link), link, BEGAN_NS + MS)
        assert (answer.get_type(), answer.ts1) == ("TIMESYNC", 7 + link)
        assert abs(answer.tc1 - (time.time_ns() - time.monotonic_ns() + BEGAN_NS + MS)) < 10 * MS
    air.tell(dialect.MAVLink_timesync_message(10**15, question.ts1), OTHER, BEGAN_NS + 2 * MS)
    assert air.station.timesync.offset_ns is None
    air.tell(dialect.MAVLink_timesync_message(10**15, question.ts1), HOME, BEGAN_NS + 3 * MS)
    assert air.station.timesync.offset_ns is not None


def test_a_slower_link_that_is_preferred_makes_no_attitude_younger() -> None:
    """What it brings first is stamped earlier than the last of the other link, each of which has numbers of its own."""
    air, numbers, late_ms = Air(), {HOME: 200, OTHER: 0}, 150
    for now_ns in range(BEGAN_NS, BEGAN_NS + 8_000 * MS, 20 * MS):
        air.station.tick(now_ns)
        for link in (HOME, OTHER):
            if link == HOME and now_ns < BEGAN_NS + 2_000 * MS:
                continue
            air._mav.seq = numbers[link] = (numbers[link] + 1) % 256
            if now_ns % (1_000 * MS) == 0:
                air.beat(link, now_ns)
            sent_ns = now_ns - late_ms * MS * (link == HOME)
            q = np.roll(Rotation.from_euler("x", 0.5 * (sent_ns - BEGAN_NS) / 1e9).as_quat(), 1).tolist()
            air.tell(dialect.MAVLink_attitude_quaternion_message(sent_ns // MS, *q, 0.5, 0.0, 0.0), link, now_ns)
        exposed_ns = now_ns - 200 * MS
        if exposed_ns > BEGAN_NS and (own := air.own_ship.at(exposed_ns)) is not None:
            rolled = Rotation.from_euler("x", 0.5 * (exposed_ns - BEGAN_NS) / 1e9)
            off = Rotation.from_matrix(own.R_ned_body) * rolled.inv()
            assert off.magnitude() < 0.01, f"{off.magnitude():.3f} rad off at {(now_ns - BEGAN_NS) // MS} ms"
    assert air.station.home == HOME
