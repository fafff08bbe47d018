"""Which of several autopilots is our own: another aircraft's attitude is never taken for the own ship's for long."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.mavlink_packing import Packer
from edge.links.mavlink_peer import Endpoint
from edge.links.mavlink_station import Station
from edge.links.transports.medium import Address, Received
from edge.links.transports.udp import Udp as UdpTransport
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect
from tests.waiting import until

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, Udp, linked, meet
from .reports import FAULT

OURS, OTHER = 1, 2
MS = 1_000_000
S = 1_000 * MS
BEGAN_NS = 1_000 * S
LEVEL_DEG, UPSIDE_DOWN_DEG = 0.0, 180.0


def said(system: int, tilt_deg: float, now_ns: int) -> list[bytes]:
    """An autopilot's heartbeat each second and its attitude each 20 ms."""
    mav = MAVLink(None, srcSystem=system, srcComponent=1)
    half_rad = np.deg2rad(tilt_deg) / 2
    q = (np.cos(half_rad), np.sin(half_rad), 0.0, 0.0)
    attitude = dialect.MAVLink_attitude_quaternion_message(now_ns // MS, *q, 0.0, 0.0, 0.0)
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3)
    return [bytes(message.pack(mav)) for message in ([beat] if now_ns % S == 0 else []) + [attitude]]


class Airspace:
    """Our own aircraft flies level, another upside down; each speaks at its times (s), on a link of its own."""

    def __init__(self, ours: Callable[[float], bool], other: Callable[[float], bool]) -> None:
        self.own_ship = OwnShipBuffer()
        self.station = Station(MavlinkSettings(), self.own_ship, CAMERA, RequestQueue())
        self.told: list[str] = []
        self._speak = ((OURS, LEVEL_DEG, ours), (OTHER, UPSIDE_DOWN_DEG, other))

    def fly(self, seconds: int) -> dict[float, float | None]:
        """Own tilt (degrees) at each half second, None where none is known."""
        tilts: dict[float, float | None] = {}
        for now_ns in range(BEGAN_NS, BEGAN_NS + seconds * S, 20 * MS):
            second = (now_ns - BEGAN_NS) / S
            self.station.tick(now_ns)
            for link, (system, tilt_deg, speaks) in enumerate(self._speak):
                for frame in said(system, tilt_deg, now_ns) if speaks(second) else []:
                    self.station.take(FrameReader(datagram=True).feed(frame), link, now_ns)
            self.told += self.station.recognition.news()
            if now_ns % (S // 2) == 0:
                now = self.own_ship.at(now_ns)
                tilts[second] = None if now is None else tilt_of(now.R_ned_body)
        return tilts


def tilt_of(R_ned_body: np.ndarray) -> float:
    return round(float(np.degrees(Rotation.from_matrix(R_ned_body).magnitude())), 3)


def test_another_aircraft_that_was_heard_beside_ours_is_never_taken_for_it() -> None:
    air = Airspace(ours=lambda s: s < 15.0 or s >= 60.0, other=lambda s: s >= 3.0)
    tilts = air.fly(65)
    assert {tilt for second, tilt in tilts.items() if 1.0 <= second < 15.0} == {LEVEL_DEG}
    assert {tilt for second, tilt in tilts.items() if 15.5 <= second < 60.0} == {None}
    assert {tilt for second, tilt in tilts.items() if second >= 61.0} == {LEVEL_DEG}
    assert air.told == [
        "autopilots 1 and 2 are heard; 1, the first, is taken for our own: set system_id",
        "autopilot 1 is silent; 2, heard, is held for another's: set system_id if it is not",
    ]


def test_another_that_is_heard_first_and_flies_by_does_not_keep_ours_out() -> None:
    air = Airspace(ours=lambda s: s >= 0.5, other=lambda s: s < 3.0 or 60.0 <= s < 70.0)
    tilts = air.fly(120)
    assert {tilt for second, tilt in tilts.items() if second >= 10.0} == {LEVEL_DEG}
    assert air.told[0] == "autopilot 2 is silent; 1, first heard since, is taken for our own: set system_id"


def test_an_autopilot_that_takes_another_id_is_followed_and_that_is_told() -> None:
    air = Airspace(ours=lambda s: s < 10.0, other=lambda s: s >= 10.2)
    tilts = air.fly(30)
    assert {tilt for second, tilt in tilts.items() if second >= 18.0} == {UPSIDE_DOWN_DEG}
    assert air.told == ["autopilot 1 is silent; 2, first heard since, is taken for our own: set system_id"]


def test_what_a_slow_line_still_brings_of_the_former_id_makes_no_stranger_of_the_new_one() -> None:
    air = Airspace(ours=lambda s: s < 10.6, other=lambda s: s >= 9.9)
    tilts = air.fly(30)
    assert {tilt for second, tilt in tilts.items() if second >= 18.0} == {UPSIDE_DOWN_DEG}


def test_ours_is_taken_again_when_it_is_heard_again_and_the_other_never_more() -> None:
    air = Airspace(ours=lambda s: s < 10.0 or 30.0 <= s < 40.0 or s >= 60.0, other=lambda s: s >= 20.0)
    tilts = air.fly(65)
    assert tilts[25.0] == UPSIDE_DOWN_DEG, "nobody could know"
    assert {tilt for second, tilt in tilts.items() if 31.0 <= second < 40.0} == {LEVEL_DEG}
    assert {tilt for second, tilt in tilts.items() if 40.5 <= second < 60.0} == {None}
    assert {tilt for second, tilt in tilts.items() if second >= 61.0} == {LEVEL_DEG}
    assert air.told[:2] == [
        "autopilot 1 is silent; 2, first heard since, is taken for our own: set system_id",
        "autopilot 1 is heard again; it is our own, and 2 another's: set system_id",
    ]


class Port:
    """One udpin endpoint and its station, with what is sent to it from several addresses."""

    def __init__(self, system_id: int | None = None) -> None:
        self.own_ship = OwnShipBuffer()
        self.station = Station(MavlinkSettings(system_id=system_id), self.own_ship, CAMERA, RequestQueue())
        self._transport = UdpTransport(NetworkEndpoint("udpin", "127.0.0.1", 0, "udpin:127.0.0.1:0"))
        self._endpoint = Endpoint(self._transport, [], Counter(), self.station.recognition, Packer(0, None))
        self._reader = FrameReader(datagram=True)
        self.heeded: dict[float, Address | None] = {}

    def hear(self, frames: list[bytes], sender: Address, now_ns: int) -> None:
        for frame in frames:
            self.station.take(self._endpoint.believed(Received(frame, sender, self._reader), now_ns), 0, now_ns)

    def tick(self, now_ns: int) -> None:
        self.station.tick(now_ns)
        self._endpoint.tick(now_ns)
        self.heeded[(now_ns - BEGAN_NS) / S] = self._endpoint.peer

    def close(self) -> None:
        self._transport.close()

    def tilt_deg(self, now_ns: int) -> float | None:
        now = self.own_ship.at(now_ns)
        return None if now is None else tilt_of(now.R_ned_body)


BEFORE, AFTER, OTHERS = ("10.0.0.1", 14550), ("10.0.0.1", 14999), ("10.0.0.2", 14550)


@pytest.mark.parametrize("other_from_s", [0.5, 22.0], ids=["heard beside ours", "taken for ours"])
def test_on_one_port_another_aircraft_does_not_keep_our_autopilot_out(other_from_s: float) -> None:
    """Both send to it, each from an address of its own, and ours comes back with another port."""
    with contextlib.closing(Port()) as port:
        for now_ns in range(BEGAN_NS, BEGAN_NS + 40 * S, 20 * MS):
            second = (now_ns - BEGAN_NS) / S
            port.tick(now_ns)
            if second < 15.0 or second >= 30.0:
                port.hear(said(OURS, LEVEL_DEG, now_ns), BEFORE if second < 15.0 else AFTER, now_ns)
            if second >= other_from_s:
                port.hear(said(OTHER, UPSIDE_DOWN_DEG, now_ns), OTHERS, now_ns)
        assert port.heeded[14.0] == BEFORE
        assert port.heeded[28.0] == (None if other_from_s < 15.0 else OTHERS)
        assert port.heeded[31.0] == port.heeded[39.0] == AFTER
        assert port.tilt_deg(now_ns) == LEVEL_DEG


def test_at_a_port_that_nobody_is_heeded_at_it_is_told_who_is_held_for_anothers() -> None:
    """As it may be ours after all: first heard beside another aircraft that has gone."""
    with contextlib.closing(Port()) as port:
        told = []
        for now_ns in range(BEGAN_NS, BEGAN_NS + 60 * S, 20 * MS):
            second = (now_ns - BEGAN_NS) / S
            port.tick(now_ns)
            if second < 20.0:
                port.hear(said(OTHER, UPSIDE_DOWN_DEG, now_ns), OTHERS, now_ns)
            port.hear(said(OURS, LEVEL_DEG, now_ns), BEFORE, now_ns)
            told += port.station.recognition.news()
        assert port.heeded[50.0] is None
        assert told[-1] == "autopilot 2 is silent; 1, heard, is held for another's: set system_id if it is not"


@pytest.mark.parametrize("accepted", [False, True], ids=["at a port", "on a line"])
@pytest.mark.parametrize("ours_from_s", [5.0, 60.0], ids=["ours too", "ours never"])
def test_it_is_told_who_is_heard_in_place_of_a_configured_id(ours_from_s: float, accepted: bool) -> None:
    with contextlib.closing(Port(system_id=OURS)) as port:
        told = []
        for now_ns in range(BEGAN_NS, BEGAN_NS + 20 * S, 20 * MS):
            port.tick(now_ns)
            if now_ns - BEGAN_NS >= ours_from_s * S:
                port.hear(said(OURS, LEVEL_DEG, now_ns), BEFORE, now_ns)
            for frame in said(OTHER, UPSIDE_DOWN_DEG, now_ns):
                if accepted:
                    port.station.take(FrameReader(datagram=True).feed(frame), 1, now_ns)
                else:
                    port.hear([frame], OTHERS, now_ns)
            told += port.station.recognition.news()
        assert told == ([] if ours_from_s < 8.0 else ["autopilot 2 is heard, but not 1, which system_id names"])
        assert port.tilt_deg(now_ns) == (LEVEL_DEG if ours_from_s < 8.0 else None)


def test_who_speaks_for_another_aircraft_alone_does_not_keep_the_port() -> None:
    """It was taken for ours there; ours shows on another link that it is not, and later comes by the port again."""
    with contextlib.closing(Port()) as port:
        for now_ns in range(BEGAN_NS, BEGAN_NS + 50 * S, 20 * MS):
            second = (now_ns - BEGAN_NS) / S
            port.tick(now_ns)
            if 20.0 <= second < 40.0:
                for frame in said(OURS, LEVEL_DEG, now_ns):
                    port.station.take(FrameReader(datagram=True).feed(frame), 1, now_ns)
            if second < 12.0 or second >= 40.0:
                port.hear(said(OURS, LEVEL_DEG, now_ns), BEFORE, now_ns)
            if second >= 18.0:
                port.hear(said(OTHER, UPSIDE_DOWN_DEG, now_ns), OTHERS, now_ns)
        assert port.heeded[19.0] == OTHERS
        assert port.heeded[35.0] is None
        assert port.heeded[42.0] == port.heeded[49.0] == BEFORE
        assert port.tilt_deg(now_ns) == LEVEL_DEG


def test_a_ground_station_alone_does_not_keep_the_port() -> None:
    """A router that has lost our autopilot forwards the ground station, and ours comes from another address."""
    mav = MAVLink(None, srcSystem=255, srcComponent=190)
    ground = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    with contextlib.closing(Port()) as port:
        for now_ns in range(BEGAN_NS, BEGAN_NS + 40 * S, 20 * MS):
            second = (now_ns - BEGAN_NS) / S
            port.tick(now_ns)
            if now_ns % S == 0:
                port.hear([bytes(ground.pack(mav))], BEFORE, now_ns)
            if second < 12.0 or second >= 30.0:
                port.hear(said(OURS, LEVEL_DEG, now_ns), BEFORE if second < 12.0 else OTHERS, now_ns)
        assert port.heeded[29.0] == BEFORE, "the ground station is still sent to"
        assert port.heeded[32.0] == port.heeded[39.0] == OTHERS
        assert port.tilt_deg(now_ns) == LEVEL_DEG


def test_nothing_is_said_of_a_vehicle_that_is_not_known_but_what_is_wrong_when_it_is() -> None:
    ground = Udp(0)
    with (
        linked("udpin:127.0.0.1:0", f"udpout:127.0.0.1:{ground.port}") as (link, _),
        Peer(link.ports[0]) as peer,
    ):
        reader, heard = FrameReader(datagram=True), []

        def beat() -> bool:
            link.set_health(FAULT)
            heard.extend(reader.feed(ground.receive()))
            return sum(m.get_type() == "HEARTBEAT" for m in heard) >= 4

        link.event(4, "model: runs on the CPU")
        for state in ("fault: no frame for 3 s", "searching", "degraded: no own attitude"):
            link.event(6 if state == "searching" else 4, state, of_state=True)
        link.event(6, "target 1 found")
        until(beat, what="heartbeats of the daemon alone")
        assert {m.get_type() for m in heard} == {"HEARTBEAT"}
        heard.clear()
        meet(link, peer)
        peer.settle(lambda: beat() and sum(m.get_type() == "STATUSTEXT" for m in heard) == 2, "what was wrong")
    ground.close()
    told = [(m.get_srcSystem(), m.severity, m.text) for m in heard if m.get_type() == "STATUSTEXT"]
    assert told == [(SYSTEM_ID, 4, "model: runs on the CPU"), (SYSTEM_ID, 4, "degraded: no own attitude")]


def test_a_configured_id_does_not_lose_what_was_wrong_before_anybody_was_there() -> None:
    with linked("udpin:127.0.0.1:0", system_id=SYSTEM_ID) as (link, _):
        link.event(4, "model: runs on the CPU")
        link.event(4, "degraded: no own attitude", of_state=True)
        until(lambda: link.counters().get("sent_STATUSTEXT", 0) == 2, what="texts to nobody")
        with Peer(link.ports[0]) as peer:
            meet(link, peer)
            peer.settle(lambda: sum(m.get_type() == "STATUSTEXT" for m in peer.received) == 2, "what was wrong")
            told = [(m.severity, m.text) for m in peer.received if m.get_type() == "STATUSTEXT"]
    assert told == [(4, "model: runs on the CPU"), (4, "degraded: no own attitude")]


def test_a_state_that_is_over_before_anybody_hears_of_it_is_not_told() -> None:
    station = Station(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue())
    station.event(4, "degraded: no frame for 3 s", BEGAN_NS, of_state=True)
    station.event(6, "searching", BEGAN_NS + S, of_state=True)
    for frame in said(OURS, LEVEL_DEG, BEGAN_NS + 600 * S):
        station.take(FrameReader(datagram=True).feed(frame), 0, BEGAN_NS + 600 * S)
    told = station.tick(BEGAN_NS + 600 * S).everywhere
    assert not [letter for letter in told if letter.message.get_type() == "STATUSTEXT"]
