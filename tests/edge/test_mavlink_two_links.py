"""Two links, of which one carries somebody who speaks in the autopilot's name."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID
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
        self._tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, autopilot, 0, 0, 4, 3), link, now_ns)

    def attitude(self, link: int, now_ns: int, rotation: Rotation) -> None:
        q = np.roll(rotation.as_quat(), 1).tolist()
        self._tell(dialect.MAVLink_attitude_quaternion_message(now_ns // MS, *q, 0.0, 0.0, 0.0), link, now_ns)

    def tilt_deg(self, now_ns: int) -> float | None:
        now = self.own_ship.at(now_ns)
        return None if now is None else float(np.degrees(Rotation.from_matrix(now.R_ned_body).magnitude()))

    def _tell(self, message: Any, link: int, now_ns: int) -> None:
        self.station.take(FrameReader(datagram=True).feed(message.pack(self._mav)), link, now_ns)


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
        frames = air.station.report(report(track(now_ns), now_ns=now_ns), now_ns)
        sent = {m.get_type() for data in frames for m in FrameReader(datagram=True).feed(data)}
        assert "CAMERA_TRACKING_IMAGE_STATUS" in sent
        assert ("TARGET_RELATIVE" in sent) == (autopilot == ARDUPILOT)
