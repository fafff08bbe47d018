"""Each endpoint's own sequences and signatures: who counts losses counts those that there are."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from typing import Any

from edge.config import MavlinkSettings
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.mavlink_packing import Letter, Packer
from edge.links.mavlink_peer import Endpoint
from edge.links.mavlink_recognition import Recognition
from edge.links.mavlink_station import Station
from edge.links.mavlink_vehicle import Vehicle
from edge.links.signing import Signing
from edge.links.transports.udp import Udp as UdpTransport
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, Udp, linked, meet
from .reports import TRACKING
from .reports import make_report as report
from .reports import make_track as track

KEY = bytes(range(32))
MS = 1_000_000


def gaps(messages: list[Any]) -> dict[int, int]:
    """Losses by component, as a ground station counts them."""
    last: dict[int, int] = {}
    lost: dict[int, int] = defaultdict(int)
    for message in messages:
        component = message.get_srcComponent()
        if component in last:
            lost[component] += (message.get_seq() - last[component] - 1) % 256
        last[component] = message.get_seq()
    return lost


def test_no_end_counts_as_lost_what_went_to_another() -> None:
    """The autopilot alone is asked for its clock and for rates, and answered."""
    ground = Udp(0)
    with (
        linked("udpin:127.0.0.1:0", f"udpout:127.0.0.1:{ground.port}") as (link, _),
        Peer(link.ports[0]) as peer,
    ):
        meet(link, peer)
        reader, heard = FrameReader(datagram=True), []

        def go_on() -> None:
            link.set_health(TRACKING)
            link.publish(report(track(time.monotonic_ns())))
            peer.command(512, 259.0)
            heard.extend(reader.feed(ground.receive()))

        peer.settle(lambda: {191, 100} <= {m.get_srcComponent() for m in heard[60:]}, "what both components say", go_on)
    ground.close()
    assert {"TIMESYNC", "COMMAND_LONG", "COMMAND_ACK"} <= {m.get_type() for m in peer.received}
    assert not {"TIMESYNC", "COMMAND_LONG", "COMMAND_ACK"} & {m.get_type() for m in heard}
    assert gaps(heard) == gaps(peer.received) == {191: 0, 100: 0}


def test_an_autopilot_that_two_endpoints_reach_refuses_nothing_of_the_slower_one() -> None:
    """ArduPilot keeps one table of streams for all its ports: a serial line is behind what comes by Ethernet."""
    signing = Signing(KEY, 0, lambda stamp: None, time.time_ns)
    settings = MavlinkSettings(follow_target=True)
    station = Station(settings, OwnShipBuffer(), CAMERA, RequestQueue(), signing)
    fast, slow = Packer(0, signing), Packer(1, signing)
    autopilot = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3)
    receiver = MAVLink(None)
    receiver.signing.secret_key = KEY
    on_its_way: list[bytes] = []
    began_ns = time.monotonic_ns()
    for now_ns in range(began_ns, began_ns + 2_000 * MS, 40 * MS):
        station.health(TRACKING, now_ns)
        station.take(FrameReader(datagram=True).feed(beat.pack(autopilot)), 0, now_ns)
        letters = [*station.tick(now_ns).everywhere, *station.report(report(track(now_ns), now_ns=now_ns), now_ns)]
        frames = [(slow.packed(letter), fast.packed(letter)) for letter in letters]
        # What the slow line brings is of the turn before.
        for frame in [quick for _, quick in frames] + on_its_way:
            assert receiver.decode(bytearray(frame)).get_signed()
        on_its_way = [late for late, _ in frames]


def test_what_nobody_is_there_to_hear_is_not_packed() -> None:
    saves: list[int] = []
    packer = Packer(0, Signing(KEY, 0, saves.append, time.time_ns))
    transport = UdpTransport(NetworkEndpoint("udpin", "127.0.0.1", 0, "udpin:127.0.0.1:0"))
    refused: Counter[str] = Counter()
    endpoint = Endpoint(transport, [], refused, Recognition(Vehicle(None, {}), None, None, refused), packer)
    letter = Letter(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), SYSTEM_ID, 191)
    for _ in range(5):
        assert endpoint.send(letter)
    transport.close()
    assert saves == [], "no timestamp was used"
    (first,) = FrameReader(datagram=True).feed(packer.packed(letter))
    assert first.get_seq() == 0, "else who comes later begins with a loss"
