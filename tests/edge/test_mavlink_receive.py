"""What the MAVLink link believes, and what it drops and counts."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.mavlink_packing import Packer
from edge.links.mavlink_peer import Endpoint
from edge.links.mavlink_receive import RATE_MAX_HZ, Receiver
from edge.links.mavlink_recognition import Recognition
from edge.links.mavlink_station import Station
from edge.links.mavlink_vehicle import Contact, Vehicle
from edge.links.transports.medium import Received
from edge.links.transports.udp import Udp
from edge.requests import RequestQueue, StopTracking
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, alone, hear, linked, meet, on_the_wire
from .reports import SEARCHING, TRACKING
from .reports import make_report as report
from .reports import make_track as track


def test_strangers_get_nothing_and_change_nothing() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer, Peer(link.ports[0]) as stranger:
        meet(link, peer)
        stranger.heartbeat()
        stranger.attitude(Rotation.from_euler("x", 2.0))
        peer.settle(lambda: link.counters().get("refused_address", 0) == 2, "refusal")
        assert own_ship.at(time.monotonic_ns()) is None
        assert alone(stranger.wire)


def test_before_an_autopilots_heartbeat_nothing_is_sent_to_whoever_calls() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as caller, Peer(link.ports[0]) as peer:
        caller.send(dialect.MAVLink_timesync_message(0, 1))
        ground = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
        caller.send(ground)
        firmware = (dialect.MAV_TYPE_ANTENNA_TRACKER, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
        caller.send(dialect.MAVLink_heartbeat_message(*firmware, 0, 0, 4, 3))
        without_autopilot = (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_INVALID)
        caller.send(dialect.MAVLink_heartbeat_message(*without_autopilot, 0, 0, 4, 3))
        caller.mav.srcSystem = 0  # which addresses all systems, and is none
        caller.heartbeat()
        meet(link, peer)
        assert link.counters()["refused_stranger"] == 5
        assert alone(caller.wire)


@pytest.mark.parametrize("field", ["not_finite", "quaternion_norm"])
def test_attitudes_that_are_none_are_refused(field: str) -> None:
    q = (math.nan, 0.0, 0.0, 0.0) if field == "not_finite" else (2.0, 0.0, 0.0, 0.0)
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.send(dialect.MAVLink_attitude_quaternion_message(peer.boot_ms(), *q, 0.0, 0.0, 0.0))
        peer.settle(lambda: link.counters().get(f"refused_{field}") == 1, "refusal")
        assert own_ship.at(time.monotonic_ns()) is None


def test_a_megabyte_of_junk_from_the_autopilots_own_address_is_counted_and_the_link_goes_on() -> None:
    rng = np.random.default_rng(1)
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        sent = 0
        for size in [1, 7, 300, 1_400, 9_000, 60_000] * 14:
            junk = rng.bytes(size)
            # Half of it begins as MAVLink does, so that it reaches the parser.
            peer.wire.send((b"\xfd" + junk[1:]) if sent % 2 else junk)
            sent += 1
            peer.serve()
        link.publish(report(track(time.monotonic_ns())))
        peer.named("TARGET_RELATIVE")
        peer.settle(
            lambda: sum(n for name, n in link.counters().items() if name.startswith("refused_")) >= sent / 2,
            "count of junk",
        )


def test_a_truncated_header_does_not_swallow_what_follows() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.wire.send(b"\xfd\xff\x00\x00")
        peer.attitude(Rotation.identity())
        peer.settle(lambda: link.counters().get("received_ATTITUDE_QUATERNION", 0) == 1, "attitude")


def hostile() -> dict[str, list[Any]]:
    """Messages with a valid checksum by the reason they are refused for; 100 000 ms is a boot time that fits."""
    d, stamp = dialect, 100_000
    return {
        "implausible": [
            d.MAVLink_attitude_quaternion_message(stamp, 1.0, 0.0, 0.0, 0.0, 1e30, 0.0, 0.0),
            d.MAVLink_attitude_message(stamp, 1e20, 0.0, 0.0, 0.0, 0.0, 0.0),
            d.MAVLink_local_position_ned_message(stamp, 1e30, 0.0, 0.0, 0.0, 0.0, 0.0),
            d.MAVLink_local_position_ned_message(stamp, 0.0, 0.0, 0.0, -1e9, 0.0, 0.0),
            d.MAVLink_global_position_int_message(stamp, 2**31 - 1, 0, 0, 0, 0, 0, 0, 0),
            d.MAVLink_global_position_int_message(stamp, 1, -(2**31), 0, 0, 0, 0, 0, 0),
            d.MAVLink_global_position_int_message(stamp, 1, 1, 2**31 - 1, 0, 0, 0, 0, 0),
        ],
        "not_finite": [
            d.MAVLink_attitude_message(stamp, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0),
            d.MAVLink_local_position_ned_message(stamp, 0.0, math.inf, 0.0, 0.0, 0.0, 0.0),
        ],
        "unstamped": [
            d.MAVLink_attitude_quaternion_message(0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            d.MAVLink_system_time_message(1_700_000_000_000_000, 0),  # as MAVSDK sends it
        ],
        "quaternion_norm": [d.MAVLink_attitude_quaternion_message(stamp, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)],
        "message_id": [
            d.MAVLink_setup_signing_message(SYSTEM_ID, 191, [7] * 32, 2**48 - 1),
            d.MAVLink_statustext_message(0, b"x" * 50),
        ],
    }


@pytest.mark.parametrize("reason", list(hostile()))
def test_nonsense_with_a_valid_checksum_is_counted_and_changes_nothing(reason: str) -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def refused(times: int) -> None:
            for message in hostile()[reason]:
                peer.send(message)
            expected = times * len(hostile()[reason])
            peer.settle(lambda: link.counters().get(f"refused_{reason}", 0) == expected, "refusal")

        refused(1)
        assert own_ship.at(time.monotonic_ns()) is None
        hear(own_ship, peer, Rotation.identity())
        refused(2)
        assert (link.counters().get("failed", 0), link.counters()["reboots"]) == (0, 0)


def test_another_vehicles_telemetry_from_the_autopilots_address_is_refused() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        for system, component in ((SYSTEM_ID + 1, 1), (SYSTEM_ID, 191), (0, 0)):
            other = MAVLink(None, srcSystem=system, srcComponent=component)
            peer.wire.send(dialect.MAVLink_attitude_quaternion_message(peer.boot_ms(), 1, 0, 0, 0, 0, 0, 0).pack(other))
        peer.settle(lambda: link.counters().get("refused_not_our_autopilot") == 3, "refusal")
        assert own_ship.at(time.monotonic_ns()) is None


def test_a_message_no_dialect_knows_is_counted_and_dropped() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        # Id 0x030201 is nobody's, so that neither its checksum nor a signature could be judged.
        unknown = b"\xfd\x01\x00\x00\x00" + bytes([SYSTEM_ID, 1]) + b"\x01\x02\x03" + b"\x00" + b"\x00\x00"
        attitude = dialect.MAVLink_attitude_quaternion_message(peer.boot_ms(), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        peer.wire.send(unknown + peer.packed(attitude))
        peer.settle(lambda: link.counters().get("received_ATTITUDE_QUATERNION", 0) == 1, "attitude behind it")
        peer.settle(lambda: link.counters()["refused_message_id"] == 1, "count of it")


def test_a_flood_from_the_autopilots_own_address_does_not_keep_poses_from_going_out() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, peer.autopilot, 0, 0, 4, 3)
        flood = b"".join(peer.packed(beat) for _ in range(60))

        def flood_and_publish() -> None:
            for _ in range(50):
                peer.wire.send(flood)
            link.publish(report(track(time.monotonic_ns())))

        peer.named("TARGET_RELATIVE", flood_and_publish)
        peer.settle(lambda: link.counters().get("refused_rate", 0) > 0, "refusal of the surplus", flood_and_publish)


def test_the_flood_of_another_system_behind_its_address_does_not_silence_the_autopilot() -> None:
    refused: Counter[str] = Counter()
    receiver, reader, now_ns = Receiver(refused), FrameReader(datagram=True), 10_200_000_000
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    others = [bytes(beat.pack(MAVLink(None, srcSystem=SYSTEM_ID + 1, srcComponent=one))) for one in (1, 66)]
    for _ in range(3 * RATE_MAX_HZ):
        receiver.take(b"".join(others), reader, now_ns)
    assert refused["rate"] == 4 * RATE_MAX_HZ
    own = bytes(beat.pack(MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)))
    assert len(receiver.take(own, reader, now_ns)) == 1
    assert len(receiver.take(others[0], reader, now_ns + 1_000_000_000)) == 1


def test_a_flood_in_the_autopilots_own_name_does_not_silence_its_heartbeat() -> None:
    refused: Counter[str] = Counter()
    receiver, reader, now_ns = Receiver(refused), FrameReader(datagram=True), 10_200_000_000
    autopilot = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    false_time = bytes(dialect.MAVLink_timesync_message(2**62, 1).pack(autopilot))
    for _ in range(3 * RATE_MAX_HZ):
        receiver.take(false_time, reader, now_ns)
    assert refused["rate"] == 2 * RATE_MAX_HZ
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    assert len(receiver.take(bytes(beat.pack(autopilot)), reader, now_ns)) == 1


def test_an_autopilot_that_still_speaks_is_not_replaced_when_its_heartbeats_are_lost() -> None:
    """With the clock in hand: what another system then tells of its attitude is not ours."""
    station = Station(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue())
    ours, other = (MAVLink(None, srcSystem=system, srcComponent=1) for system in (SYSTEM_ID, SYSTEM_ID + 1))
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)

    def tell(message: Any, mav: MAVLink, second: int) -> None:
        now_ns = second * 1_000_000_000
        station.tick(now_ns)
        station.take(FrameReader(datagram=True).feed(bytes(message.pack(mav))), 0, now_ns)

    tell(beat, ours, 0)
    for second in range(1, 20):
        level = dialect.MAVLink_attitude_quaternion_message(1000 * second, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        tell(level, ours, second)
        tell(beat, other, second)
    assert station.vehicle.contact is Contact.LOST
    assert station.vehicle.system_id == SYSTEM_ID
    for second in range(20, 60):
        tell(beat, other, second)
    assert station.vehicle.system_id == SYSTEM_ID, "another aircraft, which was there all the while"


@pytest.mark.parametrize(
    ("system_id", "ours_beats", "other_beats", "told"),
    [
        (None, range(30), range(30), [f"autopilots {SYSTEM_ID} and {SYSTEM_ID + 1} are heard"]),
        (SYSTEM_ID, range(30), range(30), []),
        (None, range(5), range(5, 30), [f"autopilot {SYSTEM_ID} is silent"]),
        (None, range(30), (3, 20), []),
    ],
    ids=["two at once", "named", "one after the other", "passing by"],
)
def test_a_second_autopilot_on_the_network_is_told_once(
    system_id: int | None, ours_beats: Sequence[int], other_beats: Sequence[int], told: list[str]
) -> None:
    station = Station(MavlinkSettings(system_id=system_id), OwnShipBuffer(), CAMERA, RequestQueue())
    ours, other = (MAVLink(None, srcSystem=system, srcComponent=1) for system in (SYSTEM_ID, SYSTEM_ID + 1))
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    sentences: list[str] = []
    for second in range(30):
        now_ns = second * 1_000_000_000
        for mav, beats in ((ours, ours_beats), (other, other_beats)):
            if second in beats:
                station.take(FrameReader(datagram=True).feed(bytes(beat.pack(mav))), 0, now_ns)
        station.tick(now_ns)
        sentences += station.recognition.news()
    assert [sentence.partition(";")[0] for sentence in sentences] == told


@pytest.mark.parametrize(("component", "key"), [(191, "component_id"), (100, "camera_component_id")])
def test_another_component_with_an_id_of_ours_is_told_and_our_own_words_that_come_back_are_not(
    component: int, key: str
) -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        back = 0

        def bring_back() -> None:
            """As a router with two ways to us does, while what we say changes."""
            nonlocal back
            link.set_health(TRACKING if back % 2 else SEARCHING)
            for message in peer.received:
                if message.get_type() == "HEARTBEAT":
                    peer.wire.send(bytes(message.get_msgbuf()))
                    back += 1
            peer.received.clear()

        peer.settle(lambda: back >= 6, "our heartbeats", bring_back)
        peer.settle(lambda: link.counters().get("refused_not_our_autopilot", 0) >= 6, "their return", bring_back)
        texts: list[str] = []

        def told(words: str) -> bool:
            texts.extend(m.text for m in peer.received if m.get_type() == "STATUSTEXT")
            peer.received.clear()
            return words in "".join(texts)

        link.event(dialect.MAV_SEVERITY_INFO, "all came back")
        peer.settle(lambda: told("all came back"), "news")
        assert not told("another component")
        other = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=component)
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_CAMERA, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
        sentence = f"another component {component} of this vehicle is heard: set another {key}"
        peer.settle(lambda: told(sentence), "sentence", lambda: peer.wire.send(bytes(beat.pack(other))))


def test_who_draws_the_box_hears_on_while_the_autopilot_is_silent() -> None:
    station = Station(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue())

    def seen(second: float) -> list[Any]:
        now_ns = round(second * 1e9)
        return on_the_wire(station.report(report(track(now_ns)), now_ns))

    assert seen(1.0) == [], "there is no vehicle yet"
    vehicle = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    beat = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3
    )
    station.take(FrameReader(datagram=True).feed(bytes(beat.pack(vehicle))), 0, 2_000_000_000)
    assert "TARGET_RELATIVE" in {message.get_type() for message in seen(3.0)}
    station.tick(20_000_000_000)
    assert station.vehicle.contact is Contact.LOST
    (status,) = seen(20.1)
    assert status.get_type() == "CAMERA_TRACKING_IMAGE_STATUS"
    assert status.tracking_status == dialect.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
    # The camera falls silent too.
    (idle,) = (m for m in on_the_wire(station.tick(22_000_000_000).everywhere) if m.get_msgId() == status.get_msgId())
    assert idle.tracking_status == dialect.CAMERA_TRACKING_STATUS_FLAGS_IDLE


def test_only_commanders_command_where_they_are_named() -> None:
    requests = RequestQueue()
    with linked(commanders=[255], requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(2010)
        peer.settle(lambda: link.counters().get("refused_not_a_commander") == 1, "refusal")
        peer.mav.srcSystem, vehicle = 255, peer.mav.srcSystem
        peer.command(2010)
        peer.mav.srcSystem = vehicle
        assert peer.named("COMMAND_ACK").target_system == 255
    assert requests.take() == [StopTracking()]


def test_who_has_fallen_silent_is_not_kept_by_noise_from_its_address() -> None:
    """With the clock in hand: the autopilot comes again from another port, while its old one sends junk."""
    refused: Counter[str] = Counter()
    transport = Udp(NetworkEndpoint("udpin", "127.0.0.1", 0, "udpin:127.0.0.1:0"))
    judge = Recognition(Vehicle(None, {}), None, None, refused)
    endpoint = Endpoint(transport, [], refused, judge, Packer(0, None))
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    data = bytes(beat.pack(MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)))
    before, after, reader = ("10.0.0.1", 14550), ("10.0.0.1", 14999), FrameReader(datagram=True)
    assert endpoint.believed(Received(data, before, reader), 0)
    for second in range(1, 7):
        assert endpoint.believed(Received(b"junk", before, reader), second * 1_000_000_000) == []
        endpoint.tick(second * 1_000_000_000)
    assert endpoint.believed(Received(data, after, reader), 7_000_000_000)
    transport.close()


def test_hosts_that_are_not_allowed_are_not_heard() -> None:
    with linked(allowed_hosts=["127.0.0.9"]) as (link, _), Peer(link.ports[0]) as peer:
        link.set_health(TRACKING)
        peer.settle(lambda: link.counters().get("refused_host", 0) > 0, "refusal")
        assert alone(peer.wire)


def test_an_allowed_ipv4_host_is_heard_on_a_port_for_both_families() -> None:
    with linked("udpin:[::]:0", allowed_hosts=["127.0.0.1"]) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        assert "refused_host" not in link.counters()


def test_an_answer_to_another_component_is_not_taken_for_ours() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        for system, component in ((SYSTEM_ID, 195), (255, 190)):
            peer.send(dialect.MAVLink_command_ack_message(511, dialect.MAV_RESULT_DENIED, 0, 0, system, component))
        peer.settle(lambda: link.counters().get("refused_not_for_us") == 2, "refusal")
        assert link.counters()["rates_refused"] == 0
