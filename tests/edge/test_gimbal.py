"""A target seen through a gimbal that pans while the aircraft banks is where it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.tracking.own_ship import GimbalFrame, OwnShipBuffer
from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, OwnShip, TrackState

from .reports import SIZE_WH, K

# On its gimbal the camera looks along the gimbal's x axis, upright.
MOUNT = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
T_NED_TARGET_M = np.array([260.0, 40.0, -100.0])
V_NED_OWN_MPS = np.array([20.0, 0.0, 0.0])
FRAME_S = 1 / 30


def test_a_still_target_stands_still_while_gimbal_and_body_turn() -> None:
    tracker, tracks = Tracker(1, MOUNT), ()
    rng = np.random.default_rng(3)
    for frame in range(90):
        t_s = frame * FRAME_S
        t_ned_own_m = V_NED_OWN_MPS * t_s + np.array([0.0, 0.0, -120.0])
        R_ned_body = Rotation.from_euler("ZYX", [0.3 * t_s, 0.05, 0.5 * np.sin(t_s)]).as_matrix()
        R_ned_gimbal = Rotation.from_euler("ZYX", [0.15 + 0.1 * np.sin(2 * t_s), -0.07, 0.0]).as_matrix()
        own = OwnShip(round(t_s * 1e9), R_ned_body, t_ned_own_m, V_NED_OWN_MPS, None, R_ned_body.T @ R_ned_gimbal)
        R_cam_ned = (R_ned_gimbal @ MOUNT.R_body_cam).T
        t_cam_m = R_cam_ned @ (T_NED_TARGET_M - t_ned_own_m) * (1.0 + rng.normal(0.0, 0.005))
        center_px = (K @ t_cam_m / t_cam_m[2])[:2]
        box = np.concatenate([center_px - 20.0, center_px + 20.0])
        covariance = np.diag([0.05, 0.05, 4.0, 0.01, 0.01, 0.01])
        seen = Estimate(0.9, box, R_cam_ned, t_cam_m, covariance, "track")
        tracks = tracker.update(own.time_ns, [seen], own, K, SIZE_WH)
    (track,) = tracks
    assert track.state is TrackState.CONFIRMED
    assert track.t_ned_target_m is not None
    assert track.v_ned_target_mps is not None
    np.testing.assert_allclose(track.t_ned_target_m, T_NED_TARGET_M, atol=4.0)
    assert np.linalg.norm(track.v_ned_target_mps) < 4.0


def pointing(samples: list[tuple[int, float, GimbalFrame]], time_ms: int) -> float | None:
    """Heading, rad, at a time of a gimbal on a level aircraft that flies north; `samples` of (ms, heading, frame)."""
    buffer = OwnShipBuffer(gimballed=True)
    for body_ms in range(900, 2_001, 20):
        buffer.add_attitude(body_ms * 1_000_000, [1.0, 0.0, 0.0, 0.0], np.zeros(3))
    for sample_ms, heading_rad, frame in samples:
        q_xyzw = Rotation.from_euler("z", heading_rad).as_quat()
        buffer.add_gimbal(sample_ms * 1_000_000, np.roll(q_xyzw, 1), frame)
    own = buffer.at(time_ms * 1_000_000)
    if own is None:
        return None
    assert own.R_body_gimbal is not None
    return float(Rotation.from_matrix(own.R_body_gimbal).as_rotvec()[2])


@pytest.mark.parametrize(("gap_ms", "last_ms"), [(4, 50), (150, 150), (160, None)])
def test_a_gimbal_points_where_it_turned_between_its_samples_and_soon_nowhere_after_the_last(
    gap_ms: int, last_ms: int | None
) -> None:
    """Turning at 2 rad/s. Samples 4 ms apart give no rate, so the last one holds, for 50 ms; samples too far apart are
    of no use at all."""
    samples = [(1_000 + k * gap_ms, 2e-3 * k * gap_ms, GimbalFrame.EARTH) for k in range(6)]
    end_ms, end_rad, _ = samples[-1]
    between = pointing(samples, 1_000 + 2 * gap_ms + gap_ms // 2)
    if last_ms is None:
        assert between is pointing(samples, end_ms) is None
        return
    assert between == pytest.approx(2e-3 * (2 * gap_ms + gap_ms // 2))
    assert pointing(samples, 999) is None
    after_rad = 0.0 if gap_ms == 4 else 2e-3 * last_ms
    assert pointing(samples, end_ms + last_ms) == pytest.approx(end_rad + after_rad)
    assert pointing(samples, end_ms + last_ms + 1) is None


def test_a_gimbal_s_headings_against_the_earth_and_against_the_nose_are_not_mixed() -> None:
    samples = [(1_000, 0.1, GimbalFrame.EARTH), (1_020, 0.2, GimbalFrame.EARTH), (1_040, 0.7, GimbalFrame.HEADING)]
    assert pointing(samples, 1_010) == pytest.approx(0.15)
    assert pointing(samples, 1_030) is None
    assert pointing(samples, 1_090) == pytest.approx(0.7), "the last one alone tells no rate"
    assert pointing(samples, 1_091) is None


def slewed_rad(t_s: float) -> float:
    """Heading of a gimbal that turns by 20 degrees from 3 s on, at up to 60 deg/s, begun and ended with 600 deg/s^2."""
    ramp_s, whole_s = 0.1, 20.0 / 60.0
    times_s = np.arange(0.0, t_s, 1e-3) - 3.0
    speeds = np.interp(times_s, [0.0, ramp_s, whole_s, whole_s + ramp_s], np.deg2rad([0.0, 60.0, 60.0, 0.0]))
    return float(speeds.sum() * 1e-3)


@pytest.mark.parametrize("attitudes_hz", [10, 20, 50])
def test_a_gimbal_that_begins_and_ends_a_slew_leaves_one_target_where_it_is(attitudes_hz: int) -> None:
    """Its messages are exact, but 20 ms late: between and after them, nothing tells how it is being accelerated."""
    buffer, tracker, rng = OwnShipBuffer(gimballed=True), Tracker(4, MOUNT), np.random.default_rng(0)
    v_target_mps, start_m, due_s, numbers = np.array([25.0, 0.0, 0.0]), np.array([300.0, 60.0, 0.0]), 0.0, set[int]()
    for frame in range(180):
        t_s = frame * FRAME_S
        while due_s + 0.02 <= t_s + 0.005:
            stamp_ns = round((1.0 + due_s) * 1e9)
            gimbal = Rotation.from_euler("z", slewed_rad(due_s))
            buffer.add_attitude(stamp_ns, [1.0, 0.0, 0.0, 0.0], np.zeros(3))
            buffer.add_position(stamp_ns, V_NED_OWN_MPS * due_s, V_NED_OWN_MPS)
            buffer.add_gimbal(stamp_ns, np.roll(gimbal.as_quat(), 1), GimbalFrame.EARTH)
            due_s += 1.0 / attitudes_hz
        own = buffer.at(round((1.0 + t_s) * 1e9))
        R_cam_ned = (Rotation.from_euler("z", slewed_rad(t_s)).as_matrix() @ MOUNT.R_body_cam).T
        t_cam_m = R_cam_ned @ (start_m + (v_target_mps - V_NED_OWN_MPS) * t_s)
        center_px = (K @ t_cam_m / t_cam_m[2])[:2]
        along, across = np.outer(t_cam_m, t_cam_m), np.eye(3) * float(t_cam_m @ t_cam_m) - np.outer(t_cam_m, t_cam_m)
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = 0.03**2 * along + 1500.0**-2 * across, 0.1**2 * np.eye(3)
        seen_m = t_cam_m * (1.0 + rng.normal(0.0, 0.01))
        box = np.concatenate([center_px - 25.0, center_px + 25.0])
        tracks = tracker.update(
            round((1.0 + t_s) * 1e9), [Estimate(0.9, box, R_cam_ned, seen_m, covariance, "track")], own, K, (8192, 1080)
        )
        assert len(tracks) == 1
        numbers.add(tracks[0].track_id)
        if own is not None and t_s > 2.0:
            assert own.R_body_gimbal is not None
            off_rad = (
                Rotation.from_matrix(own.R_body_gimbal).inv() * Rotation.from_euler("z", slewed_rad(t_s))
            ).magnitude()
            assert off_rad < 3.0 * np.hypot(own.attitude_std_rad, 1e-3)
            assert tracks[0].v_ned_target_mps is not None
            off_mps = tracks[0].v_ned_target_mps - v_target_mps
            assert off_mps @ np.linalg.solve(tracks[0].covariance_ned[3:6, 3:6], off_mps) < 16.3  # chi-squared, 99.9 %
    assert numbers == {0}


@pytest.mark.parametrize("pitch_deg", [-90.0, -89.0, -80.0, -70.0, 0.0, 70.0, 80.0, 89.0, 90.0])
@pytest.mark.parametrize("frame", list(GimbalFrame))
def test_a_nose_that_points_up_or_down_leaves_no_heading_to_tell_a_gimbal_against(
    pitch_deg: float, frame: GimbalFrame
) -> None:
    """An attitude that is off by half a degree may turn the camera by no more than what tracks have for it, 2 degrees
    of heading, three times over."""
    heading_deg, rng = 70.0, np.random.default_rng(2)
    body = Rotation.from_euler("ZYX", [heading_deg, pitch_deg, 5.0], degrees=True)
    gimbal = Rotation.from_euler("ZYX", [25.0, -10.0, 0.0], degrees=True)
    earth = gimbal if frame is GimbalFrame.EARTH else Rotation.from_euler("Z", heading_deg, degrees=True) * gimbal
    for _ in range(100):
        told = body * Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, 0.5, 3)))
        buffer = OwnShipBuffer(gimballed=True)
        for time_ns in (0, 20_000_000):
            buffer.add_attitude(time_ns, np.roll(told.as_quat(), 1), np.zeros(3))
            buffer.add_gimbal(time_ns, np.roll(gimbal.as_quat(), 1), frame)
        own = buffer.at(10_000_000)
        if frame is GimbalFrame.HEADING and abs(pitch_deg) > 78.0:
            assert own is None
            continue
        assert own is not None
        assert own.R_body_gimbal is not None
        off = earth.inv() * Rotation.from_matrix(own.R_ned_body @ own.R_body_gimbal)
        assert np.rad2deg(off.magnitude()) < 6.0
