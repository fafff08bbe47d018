"""Golden values of the paper's metrics, worked by hand or by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_replay import metrics

IDENTITY = np.eye(3)
T_GT_M = np.array([30.0, 0.0, 400.0])


def turned(axis: str, angle_deg: float) -> np.ndarray:
    return Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix()


def test_truth_as_estimate_scores_perfectly() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert metrics.rotation_error_deg(IDENTITY, IDENTITY) == 0
    assert metrics.translation_error_m(T_GT_M, T_GT_M) == 0
    assert metrics.add_m(IDENTITY, T_GT_M, IDENTITY, T_GT_M, points) == 0
    assert bool(metrics.pose_10deg_5pct(IDENTITY, T_GT_M, IDENTITY, T_GT_M))


@pytest.mark.parametrize("angle_deg", [0.001, 5.0, 90.0, 179.999])
def test_rotation_error_is_the_angle_between_the_two(angle_deg: float) -> None:
    base = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    assert metrics.rotation_error_deg(base @ turned("y", angle_deg), base) == pytest.approx(angle_deg, abs=1e-6)


def test_translation_depth_and_bearing_of_a_hand_worked_case() -> None:
    t_est = np.array([33.0, 4.0, 412.0])
    assert metrics.translation_error_m(t_est, T_GT_M) == pytest.approx(13.0)
    assert metrics.depth_error_m(t_est, T_GT_M) == pytest.approx(12.0)
    assert metrics.depth_error_rel(t_est, T_GT_M) == pytest.approx(0.03)
    assert metrics.bearing_error_deg([0.0, 1.0, 1.0], [0.0, 0.0, 5.0]) == pytest.approx(45.0)


def test_pose_needs_both_rotation_and_translation() -> None:
    near, far = T_GT_M * 1.049, T_GT_M * 1.051
    assert bool(metrics.pose_10deg_5pct(turned("x", 9.9), near, IDENTITY, T_GT_M))
    assert not bool(metrics.pose_10deg_5pct(turned("x", 10.1), near, IDENTITY, T_GT_M))
    assert not bool(metrics.pose_10deg_5pct(turned("x", 9.9), far, IDENTITY, T_GT_M))


def test_add_of_a_half_turn_is_twice_the_distance_from_the_axis() -> None:
    wing_tips = np.array([[0.0, 6.0, 0.0], [0.0, -6.0, 0.0]])
    assert metrics.add_m(turned("x", 180.0), T_GT_M, IDENTITY, T_GT_M, wing_tips) == pytest.approx(12.0)


def test_metrics_broadcast_over_a_batch() -> None:
    R = Rotation.random(4, rng=np.random.default_rng(2)).as_matrix()
    t = np.tile(T_GT_M, (4, 1))
    points = np.ones((7, 3))
    assert metrics.add_m(R, t, R, t, points).shape == (4,)
    assert metrics.pose_10deg_5pct(R, t, R, t).tolist() == [True] * 4
