"""The MAVLink link as an autopilot sees it, over real UDP sockets on loopback."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.health import HealthState
from edge.links.errors import LinkError
from edge.links.mavlink_link import MavlinkLink
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, TrackState
from msgs.mavlink import FrameReader, MAVLink, dialect

from .reports import BOX_XYXY_PX, ORIGIN, R_CAM_TARGET, R_NED_CAM, SIZE_WH, T_CAM_TARGET_M, V_NED_MPS, K
from .reports import make_report as report
from .reports import make_track as track

SYSTEM_ID = 42
CAMERA = CameraInfo("front", SIZE_WH, K, 30.0)
DEADLINE_S = 10.0


class Peer:
    """An autopilot: pymavlink and a socket. Its clock began `boot_ns` before the monotonic one."""

    def __init__(
        self, port: int, system_id: int = SYSTEM_ID, autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    ) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.02)
        self.address = ("127.0.0.1", port)
        self.mav = MAVLink(None, srcSystem=system_id, srcComponent=1)
        self.autopilot = autopilot
        self.boot_at_ns = time.monotonic_ns() - 100_000_000_000
        self.received: list[Any] = []
        self.beat_at = 0.0
        self.accepts = True

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def boot_ms(self) -> int:
        return (time.monotonic_ns() - self.boot_at_ns) // 1_000_000

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self.address)
        self.mav.seq = (self.mav.seq + 1) % 256

    def heartbeat(self) -> None:
        self.send(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, self.autopilot, 0, 0, 4, 3))

    def attitude(self, rotation: Rotation, boot_ms: int | None = None) -> None:
        q = np.roll(rotation.as_quat(), 1).tolist()
        stamp = self.boot_ms() if boot_ms is None else boot_ms
        self.send(dialect.MAVLink_attitude_quaternion_message(stamp, *q, 0.0, 0.0, 0.0))

    def command(self, command: int, *params: float, component: int = 100, system: int = SYSTEM_ID) -> None:
        filled = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(system, component, command, 0, *filled))

    def serve(self) -> list[Any]:
        """Beat once a second, answer what a real autopilot answers; returns what came."""
        if time.monotonic() - self.beat_at > 1.0:
            self.beat_at = time.monotonic()
            self.heartbeat()
        with contextlib.suppress(TimeoutError):
            datagram, _ = self.socket.recvfrom(65536)
            messages = MAVLink(None).parse_buffer(bytearray(datagram)) or []
            for message in messages:
                self._answer(message)
            self.received += messages
            return messages
        return []

    def until(self, wanted: Callable[[Any], bool], what: str, each: Callable[[], None] = lambda: None) -> Any:
        """Serve until a message is `wanted`; `each` is called every turn."""
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            each()
            for message in self.serve():
                if wanted(message):
                    return message
        raise AssertionError(f"no {what} in {DEADLINE_S} s; came: {sorted({m.get_type() for m in self.received})}")

    def named(self, name: str, each: Callable[[], None] = lambda: None) -> Any:
        return self.until(lambda m: m.get_type() == name, name, each)

    def settle(self, condition: Callable[[], bool], what: str, each: Callable[[], None] = lambda: None) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not happen in {DEADLINE_S} s"
            each()
            self.serve()

    def _answer(self, message: Any) -> None:
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            self.send(dialect.MAVLink_timesync_message(time.monotonic_ns() - self.boot_at_ns, message.ts1))
        elif message.get_type() == "COMMAND_LONG":
            result = dialect.MAV_RESULT_ACCEPTED if self.accepts else dialect.MAV_RESULT_UNSUPPORTED
            asker = (message.get_srcSystem(), message.get_srcComponent())
            self.send(dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *asker))


@contextlib.contextmanager
def linked(**settings: Any) -> Iterator[tuple[MavlinkLink, OwnShipBuffer]]:
    own_ship = OwnShipBuffer()
    link = MavlinkLink(MavlinkSettings(endpoints=["udpin:127.0.0.1:0"], **settings), own_ship, CAMERA, RequestQueue())
    link.start()
    try:
        yield link, own_ship
    finally:
        link.stop()


def meet(link: MavlinkLink, peer: Peer) -> None:
    """Until the link knows the autopilot and has taken its time."""
    link.set_health(HealthState.TRACKING)
    peer.settle(lambda: "timesync_uncertainty_us" in link.counters(), "time synchronisation")


def test_the_full_pose_arrives_as_target_relative() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        now_ns, utc_us = time.monotonic_ns(), time.time_ns() // 1000
        link.publish(report(track(now_ns), now_ns=now_ns))
        message = peer.named("TARGET_RELATIVE")
    assert (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM_ID, 191)
    assert (message.id, message.frame) == (0, 3)
    assert abs(message.timestamp - utc_us) < 5_000
    np.testing.assert_allclose([message.x, message.y, message.z], T_CAM_TARGET_M, rtol=1e-6)
    np.testing.assert_allclose(message.pos_std, [0.3, 0.4, 12.0], rtol=1e-6)
    R_cam_target = Rotation.from_quat(np.roll(message.q_target, -1)).as_matrix()
    np.testing.assert_allclose(R_cam_target, R_CAM_TARGET, atol=1e-6)
    R_ned_cam = Rotation.from_quat(np.roll(message.q_sensor, -1)).as_matrix()
    np.testing.assert_allclose(R_ned_cam, R_NED_CAM, atol=1e-6)


def test_box_and_place_on_the_globe_arrive_for_the_ground_station() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns())))
        box, place = peer.named("CAMERA_TRACKING_IMAGE_STATUS"), None
        place = next((m for m in peer.received if m.get_type() == "CAMERA_TRACKING_GEO_STATUS"), None)
        place = place or peer.named("CAMERA_TRACKING_GEO_STATUS")
    assert (box.get_srcComponent(), box.tracking_status, box.tracking_mode) == (100, 1, 2)
    corners = [box.rec_top_x, box.rec_top_y, box.rec_bottom_x, box.rec_bottom_y]
    np.testing.assert_allclose(corners, (BOX_XYXY_PX + 0.5) / np.tile(SIZE_WH, 2), rtol=1e-5)
    north_m = (place.lat * 1e-7 - ORIGIN[0]) * 111_170  # metres a degree at 47 degrees north
    east_m = (place.lon * 1e-7 - ORIGIN[1]) * 76_057
    t_ned_m = np.array([100.0, 50.0, -120.0]) + R_NED_CAM @ T_CAM_TARGET_M
    np.testing.assert_allclose([north_m, east_m], t_ned_m[:2], atol=0.5)
    assert place.alt == pytest.approx(ORIGIN[2] - t_ned_m[2], abs=0.01)
    np.testing.assert_allclose([place.vel_n, place.vel_e, place.vel_d], V_NED_MPS, rtol=1e-6)
    assert (place.h_acc, place.v_acc, place.vel_acc) == pytest.approx((3.0, 4.0, 2.0))
    assert place.dist == pytest.approx(np.linalg.norm(T_CAM_TARGET_M))
    nose = (R_NED_CAM @ R_CAM_TARGET)[:, 0]
    assert place.hdg == pytest.approx(math.atan2(nose[1], nose[0]) % (2 * math.pi), abs=1e-5)


def test_only_sure_fresh_whole_tracks_are_sent_and_coasting_is_said() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        now_ns = time.monotonic_ns()
        withheld = [
            track(now_ns, track_id=1, state=TrackState.TENTATIVE),
            track(now_ns, track_id=2, measured_ns=now_ns - 300_000_000, state=TrackState.COASTING),
            track(now_ns, track_id=3, t_cam_target_m=np.array([math.nan, 0.0, 200.0])),
            track(now_ns, track_id=4, covariance=np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])),
            track(now_ns, track_id=5, covariance=np.diag([1.0, 1.0, 200.0**2, 1.0, 1.0, 1.0])),
        ]
        coasting = track(now_ns, track_id=6, state=TrackState.COASTING, measured_ns=now_ns - 50_000_000)
        link.publish(report(*withheld, coasting))
        status = peer.named("CAMERA_TRACKING_IMAGE_STATUS")
        # A pose sent later shows that nothing of the above is still on its way.
        peer.until(
            lambda m: m.get_type() == "TARGET_RELATIVE" and m.id == 7,
            "later pose",
            lambda: link.publish(report(track(time.monotonic_ns(), track_id=7))),
        )
        peer.settle(lambda: link.counters().get("tracks_withheld") == len(withheld), "count of what was withheld")
    assert status.tracking_status == 8
    assert {m.id for m in peer.received if m.get_type() == "TARGET_RELATIVE"} == {6, 7}


def test_rates_are_bounded() -> None:
    with linked(target_relative_rate_hz=20.0, tracking_rate_hz=10.0) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.received.clear()
        began = time.monotonic()
        peer.settle(
            lambda: time.monotonic() - began > 2.0,
            "two seconds",
            lambda: link.publish(report(track(time.monotonic_ns()))),
        )
    counts = {name: sum(m.get_type() == name for m in peer.received) for name in ("TARGET_RELATIVE",)}
    counts["boxes"] = sum(m.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" for m in peer.received)
    assert 25 <= counts["TARGET_RELATIVE"] <= 43
    assert 12 <= counts["boxes"] <= 23


def test_px4_gets_no_target_relative_unless_asked() -> None:
    for asked in (False, True):
        with (
            linked(target_relative_to_px4=asked) as (link, _),
            Peer(link.ports[0], autopilot=dialect.MAV_AUTOPILOT_PX4) as peer,
        ):
            meet(link, peer)
            link.publish(report(track(time.monotonic_ns())))
            peer.named("CAMERA_TRACKING_IMAGE_STATUS")
            assert ("TARGET_RELATIVE" in {m.get_type() for m in peer.received}) == asked


def test_heartbeats_come_from_both_components_and_stop_when_the_loop_does() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.set_health(HealthState.FAULT)
        sources = set()
        while sources != {191, 100}:
            beat = peer.named("HEARTBEAT", lambda: link.set_health(HealthState.FAULT))
            sources.add(beat.get_srcComponent())
            assert (beat.get_srcSystem(), beat.autopilot) == (SYSTEM_ID, dialect.MAV_AUTOPILOT_INVALID)
            assert beat.type == {191: 18, 100: 30}[beat.get_srcComponent()]
        peer.until(
            lambda m: m.get_type() == "HEARTBEAT" and m.system_status == dialect.MAV_STATE_CRITICAL,
            "heartbeat that tells the fault",
            lambda: link.set_health(HealthState.FAULT),
        )
        silent_from = time.monotonic()
        last_beat = silent_from
        while time.monotonic() - silent_from < 6.0:
            if any(m.get_type() == "HEARTBEAT" for m in peer.serve()):
                last_beat = time.monotonic()
    assert last_beat - silent_from < 4.5


def test_own_attitude_is_stamped_with_the_time_it_was_measured() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        turning = Rotation.from_euler("ZYX", [0.3, 0.1, -0.2])
        measured_ns = time.monotonic_ns() - 80_000_000
        stamp_ms = (measured_ns - peer.boot_at_ns) // 1_000_000
        # It arrives 80 ms after it was measured, as over a slow link.
        peer.attitude(turning, stamp_ms)
        peer.settle(lambda: own_ship.at(measured_ns + 2_000_000) is not None, "attitude")
        assert own_ship.at(measured_ns - 10_000_000) is None, "not before it was measured"
        assert own_ship.at(measured_ns + 60_000_000) is None, "not by the time it arrived"
        now = own_ship.at(measured_ns + 2_000_000)
        assert now is not None
        np.testing.assert_allclose(now.R_ned_body, turning.as_matrix(), atol=1e-6)


def asks_for_attitude(message: Any) -> bool:
    return message.get_type() == "COMMAND_LONG" and message.param1 == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


def test_a_reboot_clears_the_own_ship_and_asks_for_rates_again() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        link.set_health(HealthState.TRACKING)
        peer.until(asks_for_attitude, "first request")
        meet(link, peer)
        peer.attitude(Rotation.identity())
        peer.settle(lambda: own_ship.at(time.monotonic_ns()) is not None, "attitude")
        before_ns = time.monotonic_ns()
        peer.boot_at_ns = before_ns
        peer.attitude(Rotation.from_euler("x", 1.0))
        peer.settle(lambda: link.counters()["reboots"] == 1, "reboot")
        assert own_ship.at(before_ns - 1_000_000) is None, "what was before the reboot is gone"
        peer.until(asks_for_attitude, "request after the reboot")


def test_nothing_of_one_vehicle_is_left_when_another_takes_its_place() -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())

    def tell(system_id: int, now_s: float, boot_s: float, rotation: Rotation) -> None:
        mav = MAVLink(None, srcSystem=system_id, srcComponent=1)
        q = np.roll(rotation.as_quat(), 1).tolist()
        for message in (
            dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3),
            dialect.MAVLink_attitude_quaternion_message(round(boot_s * 1000), *q, 0.0, 0.0, 0.0),
        ):
            station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, round(now_s * 1e9))

    turned = Rotation.from_euler("x", 1.0)
    tell(1, now_s=1_000.0, boot_s=500.0, rotation=Rotation.identity())
    station.tick(1_006_000_000_000)
    tell(2, now_s=1_006.0, boot_s=20.0, rotation=turned)
    now = own_ship.at(1_006_010_000_000)
    assert now is not None, "stamped by the clock of the vehicle that is gone"
    np.testing.assert_allclose(now.R_ned_body, turned.as_matrix(), atol=1e-6)
    assert own_ship.at(1_000_000_000_000) is None


def test_the_loop_never_waits_for_the_links_thread_to_count() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as flood:
        junk = b"\xfe\0\0\0\0\0\0\0" * 1_000  # what takes a parser longest: 10 ms
        waited_s, began = 0.0, time.monotonic()
        for _ in range(200):
            flood.socket.sendto(junk, flood.address)
            asked = time.monotonic()
            link.counters()
            waited_s += time.monotonic() - asked
        # Waiting for the thread at each count would fill nearly all of this time; sending shares the rest.
        assert waited_s < 0.5 * (time.monotonic() - began)
        flood.settle(lambda: link.counters().get("refused_stranger", 0) > 0, "count of what was refused")


def test_rates_are_asked_for_with_zeros_and_again_when_they_fall() -> None:
    with linked(attitude_rate_hz=50.0) as (link, _), Peer(link.ports[0]) as peer:
        link.set_health(HealthState.TRACKING)
        first = peer.until(asks_for_attitude, "request for attitude")
        assert (first.command, first.param2) == (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 20_000.0)
        assert (first.target_system, first.target_component) == (SYSTEM_ID, 1)
        assert [first.param3, first.param4, first.param5, first.param6, first.param7] == [0.0] * 5
        sent_at = 0.0

        def ten_a_second() -> None:
            nonlocal sent_at
            if time.monotonic() - sent_at > 0.1:
                sent_at = time.monotonic()
                peer.attitude(Rotation.identity())

        peer.until(asks_for_attitude, "second request", ten_a_second)
        peer.settle(lambda: link.counters()["rates_asked_again"] >= 1, "count of what was asked again")


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (512, (259.0,), dialect.MAV_RESULT_ACCEPTED),
        (512, (30.0,), dialect.MAV_RESULT_UNSUPPORTED),
        (511, (275.0, 100_000.0), dialect.MAV_RESULT_ACCEPTED),
        (511, (275.0, 1_000.0), dialect.MAV_RESULT_DENIED),
        (511, (math.nan, 1_000.0), dialect.MAV_RESULT_DENIED),
        (2004, (0.5, 0.5), dialect.MAV_RESULT_ACCEPTED),
        (400, (1.0,), dialect.MAV_RESULT_UNSUPPORTED),
    ],
)
def test_commands_are_answered(command: int, params: tuple[float, ...], result: int) -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(command, *params)
        ack = peer.named("COMMAND_ACK")
        assert (ack.command, ack.result, ack.get_srcComponent()) == (command, result, 100)
        if params == (259.0,):
            information = peer.named("CAMERA_INFORMATION")
            assert (information.resolution_h, information.resolution_v) == SIZE_WH
            assert math.isnan(information.focal_length), "millimetres are not known from pixels"
            assert information.flags == 512 + 1024 + 2048


def test_commands_to_others_are_not_answered() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(400, 1.0, component=1)
        peer.command(400, 1.0, system=SYSTEM_ID + 1)
        peer.settle(lambda: link.counters().get("refused_not_for_us") == 2, "refusal")
        peer.command(2010)
        assert peer.named("COMMAND_ACK").command == 2010, "the first answer is to the command that was ours"


def test_our_clock_is_told_to_who_asks() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        before_ns = time.monotonic_ns()
        peer.send(dialect.MAVLink_timesync_message(0, 123_456_789))
        reply = peer.until(lambda m: m.get_type() == "TIMESYNC" and m.tc1 != 0, "reply")
        assert reply.ts1 == 123_456_789
        assert before_ns <= reply.tc1 <= time.monotonic_ns()


def test_long_events_arrive_in_chunks_that_belong_together() -> None:
    text = "degraded: no own attitude: poses in the camera frame only; 12 % of frames dropped"
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.event(4, text)
        first, second = peer.named("STATUSTEXT"), peer.named("STATUSTEXT")
    assert first.text + second.text == text
    assert first.id == second.id != 0
    assert (first.chunk_seq, second.chunk_seq, first.severity) == (0, 1, 4)


def test_strangers_get_nothing_and_change_nothing() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer, Peer(link.ports[0]) as stranger:
        meet(link, peer)
        stranger.heartbeat()
        stranger.attitude(Rotation.from_euler("x", 2.0))
        peer.settle(lambda: link.counters().get("refused_address", 0) == 2, "refusal")
        assert own_ship.at(time.monotonic_ns()) is None
        stranger.socket.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            stranger.socket.recv(1)


def test_before_an_autopilots_heartbeat_nothing_is_sent_to_whoever_calls() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as caller, Peer(link.ports[0]) as peer:
        caller.send(dialect.MAVLink_timesync_message(0, 1))
        ground = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
        caller.send(ground)
        firmware = (dialect.MAV_TYPE_ANTENNA_TRACKER, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
        caller.send(dialect.MAVLink_heartbeat_message(*firmware, 0, 0, 4, 3))
        meet(link, peer)
        assert link.counters()["refused_stranger"] == 3
        caller.socket.settimeout(0.0)
        with pytest.raises(BlockingIOError):
            caller.socket.recv(1)


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
            peer.socket.sendto((b"\xfd" + junk[1:]) if sent % 2 else junk, peer.address)
            sent += 1
            peer.serve()
        link.publish(report(track(time.monotonic_ns())))
        peer.named("TARGET_RELATIVE")
        peer.settle(
            lambda: sum(n for name, n in link.counters().items() if name.startswith("refused_")) >= sent / 2,
            "count of junk",
        )


def test_a_truncated_header_does_not_swallow_what_follows() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.socket.sendto(b"\xfd\xff\x00\x00", peer.address)
        peer.attitude(Rotation.identity())
        peer.settle(lambda: own_ship.at(time.monotonic_ns()) is not None, "attitude")


def test_a_port_that_is_taken_is_a_sentence() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        link = MavlinkLink(MavlinkSettings(endpoints=[endpoint]), OwnShipBuffer(), CAMERA, RequestQueue())
        with pytest.raises(LinkError, match=f"MAVLink endpoint {endpoint} cannot be opened: {os.strerror(98)}"):
            link.start()
        link.stop()


def test_udpout_makes_itself_known_first() -> None:
    with Peer(0) as peer:
        endpoint = f"udpout:127.0.0.1:{peer.socket.getsockname()[1]}"
        own_ship = OwnShipBuffer()
        link = MavlinkLink(MavlinkSettings(endpoints=[endpoint]), own_ship, CAMERA, RequestQueue())
        link.start()
        try:
            peer.address = ("127.0.0.1", link.ports[0])
            link.set_health(HealthState.SEARCHING)
            peer.socket.settimeout(DEADLINE_S)
            assert peer.socket.recv(300), "nobody has spoken to the link yet"
            peer.socket.settimeout(0.02)
            meet(link, peer)
        finally:
            link.stop()
