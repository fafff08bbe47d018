"""The own position or heading jumps, as when the autopilot's filter is reset; no target jumps with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from edge.config import MavlinkSettings, MountSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.tracking.tracker import Tracker
from edge.types import Array, Estimate, OwnShip
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, on_the_wire

MS = 1_000_000
BEGIN_NS = 1_000_000 * MS
EVERY = 3  # milliseconds in which the own ship is asked for: meets every age of what is told each 20 ms
K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 540.0], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
T_CAM_TARGET_M = np.array([5.0, 3.0, 300.0])  # it flies in front, as fast
V_NED_MPS = np.array([20.0, 0.0, 0.0])
R_CAM_TARGET = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


class Autopilot:
    """Its messages, at their times, to a station."""

    def __init__(self, gimballed: bool = False, gimbal_id: int | None = None) -> None:
        self.own_ship = OwnShipBuffer(gimballed)
        settings = MavlinkSettings(gimbal_component_id=gimbal_id)
        self.station = Station(settings, self.own_ship, CAMERA, RequestQueue())
        self.ahead_ms, self.attitude_ms = 0, 20  # of its clock; between two attitudes
        self.numbers = self.answers = True  # its messages, TIMESYNC
        self._mav = MAVLink(None, srcSystem=1, srcComponent=1)

    def tell(self, message: Any, now_ns: int) -> None:
        self.station.take(FrameReader(datagram=True).feed(message.pack(self._mav)), 0, now_ns)
        self._mav.seq = (self._mav.seq + self.numbers) % 256

    def turn(self, k_ms: int, t_ned_m: Array, v_ned_mps: Array, yaw_rad: float = 0.0, rate_radps: float = 0.0) -> None:
        """One millisecond: attitude at 50 Hz, position at 20 Hz, answers to TIMESYNC."""
        self.attitude(k_ms, yaw_rad, rate_radps)
        now_ns = BEGIN_NS + k_ms * MS
        if k_ms % 50 == 7:
            boot_ms = now_ns // MS + self.ahead_ms
            self.tell(dialect.MAVLink_local_position_ned_message(boot_ms, *t_ned_m, *v_ned_mps), now_ns)

    def attitude(self, k_ms: int, yaw_rad: float = 0.0, rate_radps: float = 0.0) -> None:
        """The same without position."""
        now_ns, boot_ms = BEGIN_NS + k_ms * MS, BEGIN_NS // MS + k_ms + self.ahead_ms
        if k_ms % 1000 == 0:
            beat = (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
            self.tell(dialect.MAVLink_heartbeat_message(*beat), now_ns)
        home = self.station.tick(now_ns).home
        asked = on_the_wire(home) if home else []
        for question in (m for m in asked if m.get_type() == "TIMESYNC" and self.answers):
            self.tell(dialect.MAVLink_timesync_message(boot_ms * MS, question.ts1), now_ns)
        if k_ms % self.attitude_ms == 3:
            q_wxyz = (np.cos(0.5 * yaw_rad), 0.0, 0.0, np.sin(0.5 * yaw_rad))
            self.tell(dialect.MAVLink_attitude_quaternion_message(boot_ms, *q_wxyz, 0, 0, rate_radps), now_ns)

    def gimbal(self, k_ms: int, pan_rad: float, device_id: int = 0) -> None:
        """One that the autopilot speaks for."""
        now_ns = BEGIN_NS + k_ms * MS
        self.tell(gimbal_status(now_ns // MS, pan_rad, device_id), now_ns)


def gimbal_status(boot_ms: int, pan_rad: float, device_id: int = 0) -> Any:
    """Level, in the earth's frame."""
    q_wxyz = [np.cos(0.5 * pan_rad), 0.0, 0.0, np.sin(0.5 * pan_rad)]
    status = dialect.MAVLink_gimbal_device_attitude_status_message
    return status(0, 0, boot_ms, 64, q_wxyz, 0, 0, 0, 0, 0.0, 0.0, device_id)


def seen(rng: np.random.Generator) -> Estimate:
    t_m = T_CAM_TARGET_M * (1.0 + 0.01 * rng.normal())
    u, v, _ = K @ t_m / t_m[2]
    box = np.array([u - 20.0, v - 8.0, u + 20.0, v + 8.0])
    return Estimate(0.9, box, R_CAM_TARGET, t_m, np.diag([0.3, 0.3, 9.0, 0.01, 0.01, 0.01]), "track")


@pytest.mark.parametrize("frameless_ms", [0, 450])
@pytest.mark.parametrize(
    ("jump_m", "jump_deg"), [(10.0, 0.0), (40.0, 0.0), (1000.0, 0.0), (0.0, 4.0), (0.0, 8.0), (0.0, -90.0)]
)
def test_no_target_is_told_elsewhere_when_the_own_ship_jumps(jump_m: float, jump_deg: float, frameless_ms: int) -> None:
    autopilot, rng = Autopilot(), np.random.default_rng(0)
    tracker = Tracker(4, MountSettings().mount())
    own: OwnShip | None = None
    for k_ms in range(6000):
        jumped = k_ms > 4000
        t_ned_m = V_NED_MPS * k_ms / 1000 + np.array([jump_m * jumped, 0.0, -300.0])
        autopilot.turn(k_ms, t_ned_m, V_NED_MPS, np.deg2rad(jump_deg) * jumped)
        if k_ms % 33 != 30 or 0 <= k_ms - 4000 < frameless_ms:
            continue
        capture_ns = BEGIN_NS + (k_ms - 15) * MS
        own = autopilot.own_ship.at(capture_ns)
        tracks = tracker.update(capture_ns, [seen(rng)], own, K, SIZE_WH)
        if k_ms > 1000:
            (track,) = tracks
            off_m = np.linalg.norm(track.t_cam_target_m - T_CAM_TARGET_M)
            assert off_m < 4.0 * np.sqrt(track.covariance[2, 2]), f"{off_m:.1f} m off at {k_ms} ms"
            assert off_m < 15.0
            if own is not None and own.t_ned_body_m is not None and track.v_ned_target_mps is not None:
                off_mps = track.v_ned_target_mps - V_NED_MPS
                P_v = track.covariance_ned[3:6, 3:6]
                assert off_mps @ np.linalg.solve(P_v, off_mps) < 40.0, f"{off_mps} m/s off at {k_ms} ms"
    assert autopilot.station.counters["position_jumps"] == (jump_m > 0.0)
    assert autopilot.station.counters["attitude_jumps"] == (jump_deg != 0.0)
    assert own is not None
    assert own.t_ned_body_m is not None, "the position is taken again"


def test_a_reset_of_the_own_position_costs_neither_an_attitude_nor_a_target_s_velocity() -> None:
    autopilot, rng, tracker = Autopilot(), np.random.default_rng(0), Tracker(4, MountSettings().mount())
    for k_ms in range(5000):
        t_ned_m = V_NED_MPS * k_ms / 1000 + np.array([40.0 * (k_ms > 4000), 0.0, -300.0])
        autopilot.turn(k_ms, t_ned_m, V_NED_MPS)
        if k_ms % 33 == 30:
            capture_ns = BEGIN_NS + (k_ms - 15) * MS
            own = autopilot.own_ship.at(capture_ns)
            (track,) = tracker.update(capture_ns, [seen(rng)], own, K, SIZE_WH)
            if k_ms > 3900:
                assert own is not None, f"no attitude at {k_ms} ms"
                assert track.covariance_ned is not None
                assert np.sqrt(np.trace(track.covariance_ned[3:6, 3:6])) < 8.0, f"no velocity at {k_ms} ms"
    assert autopilot.station.counters["position_jumps"] == 1


@pytest.mark.parametrize(("speed_mps", "turn_radps"), [(25.0, 0.3), (60.0, 0.8), (15.0, 3.0)])
def test_hard_flying_is_no_jump(speed_mps: float, turn_radps: float) -> None:
    autopilot, rng = Autopilot(), np.random.default_rng(1)
    for k_ms in range(4000):
        angle = turn_radps * k_ms / 1000
        t_ned_m = speed_mps / turn_radps * np.array([np.sin(angle), 1.0 - np.cos(angle), 0.0]) + 0.3 * rng.normal(
            size=3
        )
        autopilot.turn(k_ms, t_ned_m, speed_mps * np.array([np.cos(angle), np.sin(angle), 0.0]), angle, turn_radps)
    assert autopilot.station.counters["position_jumps"] == autopilot.station.counters["attitude_jumps"] == 0
    now = autopilot.own_ship.at(BEGIN_NS + 3999 * MS)
    assert now is not None
    assert now.t_ned_body_m is not None


@pytest.mark.parametrize(("attitude_ms", "jump_deg"), [(20, 4.0), (50, 5.0), (100, 11.0), (140, 18.0)])
def test_turns_as_abrupt_as_an_aircraft_s_are_no_jump_and_a_step_in_between_is_one(
    attitude_ms: int, jump_deg: float
) -> None:
    """Up to 5 rad/s and 50 rad/s^2, at a rate as slow as a link may have."""
    autopilot, found = Autopilot(), []
    autopilot.attitude_ms = attitude_ms
    for k_ms in range(8000):
        t_s = k_ms / 1000
        jump_rad = np.deg2rad(jump_deg) * (k_ms > 6000)
        turning = k_ms < 5000
        autopilot.attitude(
            k_ms, 0.5 - 0.5 * np.cos(10.0 * min(t_s, 5.0)) + jump_rad, 5.0 * np.sin(10.0 * t_s) * turning
        )
        found.append(autopilot.station.counters["attitude_jumps"])
    assert (found[6000], found[-1]) == (0, 1)


@pytest.mark.parametrize("lasts_ms", [20, 4000])
def test_a_gimbal_that_jumps_points_nowhere_until_it_has_come_to_rest(lasts_ms: int) -> None:
    """One odd sample, or another zero of its encoders: it turned no target."""
    autopilot, known_rad = Autopilot(gimballed=True), []
    for k_ms in range(4000):
        autopilot.turn(k_ms, V_NED_MPS * k_ms / 1000, V_NED_MPS)
        if k_ms % 20 == 11:
            autopilot.gimbal(k_ms, 1.2 if 2000 <= k_ms < 2000 + lasts_ms else 0.3)
        if k_ms > 500 and k_ms % EVERY == 0 and (own := autopilot.own_ship.at(BEGIN_NS + k_ms * MS)) is not None:
            assert own.R_body_gimbal is not None
            known_rad.append((k_ms, np.arctan2(own.R_body_gimbal[1, 0], own.R_body_gimbal[0, 0])))
    before = [pan for k_ms, pan in known_rad if k_ms <= 2010]
    after = [pan for k_ms, pan in known_rad if k_ms > 2010]
    np.testing.assert_allclose(before, 0.3, atol=1e-6)
    np.testing.assert_allclose(after, 0.3 if lasts_ms < 1000 else 1.2, atol=1e-6)
    assert len(before) > 1400 // EVERY
    assert len(after) > 1400 // EVERY
    assert min(k_ms for k_ms, _ in known_rad if k_ms > 2010) > 2290
    assert autopilot.station.counters["gimbal_jumps"] == (2 if lasts_ms < 1000 else 1)


def test_a_gimbal_that_slews_is_no_jump() -> None:
    autopilot = Autopilot(gimballed=True)
    for k_ms in range(3000):
        autopilot.turn(k_ms, V_NED_MPS * k_ms / 1000, V_NED_MPS)
        if k_ms % 20 == 11:
            autopilot.gimbal(k_ms, 2.0 * np.sin(4.0 * k_ms / 1000))  # 8 rad/s at most
    assert autopilot.station.counters["gimbal_jumps"] == 0
    assert autopilot.own_ship.at(BEGIN_NS + 2999 * MS) is not None


@pytest.mark.parametrize("chosen", [None, 2])
def test_the_camera_s_gimbal_is_the_configured_one_else_the_first_until_it_is_silent(chosen: int | None) -> None:
    autopilot, known_rad = Autopilot(gimballed=True, gimbal_id=chosen), []
    for k_ms in range(2000):
        autopilot.attitude(k_ms)
        if k_ms % 20 == 4 and k_ms < 500:
            autopilot.gimbal(k_ms, 0.3, device_id=1)
        if k_ms % 20 == 9:
            autopilot.gimbal(k_ms, 0.9, device_id=2)
        if k_ms > 100 and (own := autopilot.own_ship.at(BEGIN_NS + k_ms * MS)) is not None:
            assert own.R_body_gimbal is not None
            known_rad.append((k_ms, np.arctan2(own.R_body_gimbal[1, 0], own.R_body_gimbal[0, 0])))
    for k_ms, pan_rad in known_rad:
        assert pan_rad == pytest.approx(0.3 if chosen is None and k_ms < 1400 else 0.9)
    assert {100 * (k_ms // 100) for k_ms, _ in known_rad} >= {200, 300, 400, 1600, 1700, 1800, 1900}


def test_a_gimbal_with_a_clock_of_its_own_is_known_again_as_soon_as_it_has_rebooted() -> None:
    autopilot, device, known = Autopilot(gimballed=True), MAVLink(None, srcSystem=1, srcComponent=154), 0
    for k_ms in range(1500):
        autopilot.attitude(k_ms)
        now_ns, up_ms = BEGIN_NS + k_ms * MS, k_ms if k_ms < 700 else k_ms - 900
        if k_ms % 20 == 11 and not 700 <= k_ms < 900:
            status = gimbal_status(500_000 * (k_ms < 700) + up_ms, 0.3)
            autopilot.station.take(FrameReader(datagram=True).feed(status.pack(device)), 0, now_ns)
        if k_ms > 1000 and (own := autopilot.own_ship.at(now_ns)) is not None:
            assert own.R_body_gimbal is not None
            known += np.arctan2(own.R_body_gimbal[1, 0], own.R_body_gimbal[0, 0]) == pytest.approx(0.3)
    assert known == 499


@pytest.mark.parametrize("apart_deg", [5.0, 15.0, 60.0])
@pytest.mark.parametrize("later_ms", [0, 1, 7])
def test_of_two_gimbals_that_an_autopilot_speaks_for_one_is_the_camera_s(apart_deg: float, later_ms: int) -> None:
    autopilot, known = Autopilot(gimballed=True), 0
    for k_ms in range(3000):
        autopilot.turn(k_ms, V_NED_MPS * k_ms / 1000, V_NED_MPS)
        for device_id in (1, 2):
            if k_ms % 20 == 4 + (device_id - 1) * later_ms:
                autopilot.gimbal(k_ms, 0.3 + (device_id - 1) * np.deg2rad(apart_deg), device_id)
        if k_ms > 500 and k_ms % EVERY == 0 and (own := autopilot.own_ship.at(BEGIN_NS + k_ms * MS)) is not None:
            known += 1
            np.testing.assert_allclose(np.arctan2(own.R_body_gimbal[1, 0], own.R_body_gimbal[0, 0]), 0.3, atol=1e-6)
    assert known > 2400 // EVERY
    assert autopilot.station.refused["other_gimbal"] > 100
