"""Rows that are exposed one after the other, while the camera turns, show each target where it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.estimator.model import load_model
from edge.tracking.rolling_shutter import RollingShutter
from edge.types import Array, Estimate, Mount, OwnShip

from .looping import PERIOD_NS, Gated, frame, looping
from .toy_scene import SIZE_WH, K

ALONG_NOSE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DIRECTION_NED = np.array([0.983, -0.065, -0.17]) / np.linalg.norm([0.983, -0.065, -0.17])  # of the target: high up
FRAMES = 30


def yawed(t_s: float) -> Rotation:
    """The aircraft's attitude: it yaws to and fro, at up to 0.66 rad/s, and rolls a little."""
    return Rotation.from_euler("ZYX", [0.15 * np.sin(4.4 * t_s), 0.0, 0.05 * np.sin(3.0 * t_s)])


def seen_at_px(frame_s: float, readout_s: float) -> Array:
    """Where the target is in a picture whose middle row is exposed at `frame_s`, found row by row."""
    t_s = frame_s
    for _ in range(20):
        x, y, z = ALONG_NOSE.T @ yawed(t_s).inv().apply(DIRECTION_NED)
        center_px = K[:2, :2] @ [x / z, y / z] + K[:2, 2]
        t_s = frame_s + readout_s * ((center_px[1] + 0.5) / SIZE_WH[1] - 0.5)
    return center_px


def errors_mrad(toy_model: Path, filmed_ms: float, told_ms: float) -> list[float]:
    """Angles in ned between the loop's target and the true one, of each frame in which it is tracked."""
    errors = []
    with looping(Gated(load_model(toy_model, 1)), readout_ms=told_ms) as (loop, ear, _):
        first_ns = frame(0, (500.5, 500.5)).meta.capture_ns
        for own_ns in range(-200_000_000, FRAMES * PERIOD_NS + 100_000_000, 10_000_000):
            t_s = own_ns / 1e9
            turn = (yawed(t_s - 1e-4).inv() * yawed(t_s + 1e-4)).as_rotvec() / 2e-4
            loop._own_ship.add_attitude(first_ns + own_ns, np.roll(yawed(t_s).as_quat(), 1), turn)
        for index in range(FRAMES):
            x, y = np.round(seen_at_px(index * PERIOD_NS / 1e9, filmed_ms / 1e3) - 0.5) + 0.5
            loop._process(frame(index, (float(x), float(y))))
            for track in ear.reports[-1].tracks:
                assert track.t_ned_target_m is not None
                across = np.cross(track.t_ned_target_m, DIRECTION_NED) / np.linalg.norm(track.t_ned_target_m)
                errors.append(1e3 * float(np.linalg.norm(across)))
    assert len(errors) > FRAMES / 2
    return errors


@pytest.mark.parametrize("readout_ms", [30.0, -30.0])
def test_a_target_far_from_the_middle_row_is_where_it_is_while_the_camera_turns(
    readout_ms: float, toy_model: Path
) -> None:
    told = errors_mrad(toy_model, readout_ms, readout_ms)
    not_told = errors_mrad(toy_model, readout_ms, 0.0)
    assert max(told) < 1.0
    assert max(not_told) > 4.0


@given(
    st.tuples(*[st.floats(-2.0, 2.0)] * 3), st.floats(-0.1, 0.1), st.floats(-300.0, 1400.0), st.floats(-np.pi, np.pi)
)
def test_in_ned_a_pose_is_that_of_its_own_row(
    rates_radps: tuple[float, float, float], readout_s: float, row_px: float, yaw_rad: float
) -> None:
    mount = Mount(Rotation.from_euler("y", -0.3).as_matrix() @ ALONG_NOSE, np.array([1.0, 0.0, 0.2]))

    def at(time_ns: int) -> OwnShip:
        turned = Rotation.from_euler("z", yaw_rad) * Rotation.from_rotvec(np.array(rates_radps) * (time_ns / 1e9))
        return OwnShip(time_ns, turned.as_matrix(), None, None, None)

    spread = np.random.default_rng(1).normal(size=(6, 6))
    box = np.array([700.0, row_px - 20.0, 760.0, row_px + 20.0])
    rotation = Rotation.from_euler("zyx", [0.4, 0.1, -2.0]).as_matrix()
    seen = Estimate(0.9, box, rotation, np.array([-9.0, 30.0, 200.0]), spread @ spread.T, "track")
    shutter = RollingShutter(round(readout_s * 1e9), mount)
    told = shutter.at_frame_time(seen, at(5_000_000_000), 1080, at)
    row_s = 5.0 + readout_s * (min(max(row_px + 0.5, 0.0), 1080.0) / 1080.0 - 0.5)
    R_then, R_now = (at(round(t_s * 1e9)).R_ned_body @ mount.R_body_cam for t_s in (row_s, 5.0))
    np.testing.assert_allclose(R_now @ told.t_cam_target_m, R_then @ seen.t_cam_target_m, atol=1e-5)
    np.testing.assert_allclose(R_now @ told.R_cam_target, R_then @ seen.R_cam_target, atol=1e-7)
    for block in (slice(0, 3), slice(3, 6)):
        in_ned = R_then @ seen.covariance[:3, block] @ R_then.T
        np.testing.assert_allclose(R_now @ told.covariance[:3, block] @ R_now.T, in_ned, atol=1e-5)
    assert told.box_xyxy_px is seen.box_xyxy_px


def test_without_an_attitude_for_both_times_a_pose_stays_as_seen() -> None:
    own = OwnShip(1_000_000_000, np.eye(3), None, None, None)
    later = OwnShip(990_000_000, Rotation.from_euler("z", 0.01).as_matrix(), None, None, None)
    box = np.array([700.0, 100.0, 760.0, 140.0])
    seen = Estimate(0.9, box, np.eye(3), np.array([0.0, 0.0, 200.0]), np.eye(6), "track")
    shutter = RollingShutter(20_000_000, Mount(ALONG_NOSE, np.zeros(3)))
    assert shutter.at_frame_time(seen, None, 1080, lambda _: own) is seen
    assert shutter.at_frame_time(seen, own, 1080, lambda _: None) is seen
    after_a_reset = replace(later, axes_epoch=1)
    assert shutter.at_frame_time(seen, own, 1080, lambda _: after_a_reset) is seen
    assert shutter.at_frame_time(seen, own, 1080, lambda _: later) is not seen
