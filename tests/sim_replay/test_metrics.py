"""The paper's metrics: golden values worked by hand, and agreement with scipy and plain loops on random poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from sim_replay import metrics

IDENTITY = np.eye(3)
T_GT_M = np.array([30.0, 0.0, 400.0])

seeds = st.integers(0, 2**32 - 1)


def turned(axis: str, angle_deg: float) -> np.ndarray:
    return Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix()


def random_poses(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Estimates near and far from truths that lie 100 to 500 m ahead."""
    rng = np.random.default_rng(seed)
    R_gt = Rotation.random(count, rng=rng)
    R_est = Rotation.from_rotvec(rng.normal(0, 0.4, (count, 3))) * R_gt
    t_gt = np.column_stack([rng.uniform(-50, 50, (count, 2)), rng.uniform(100, 500, count)])
    return R_est.as_matrix(), t_gt + rng.normal(0, 10, (count, 3)), R_gt.as_matrix(), t_gt


def test_truth_as_estimate_scores_perfectly() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert metrics.rotation_error_deg(IDENTITY, IDENTITY) == 0
    assert metrics.translation_error_m(T_GT_M, T_GT_M) == 0
    assert metrics.depth_error_m(T_GT_M, T_GT_M) == 0
    assert metrics.bearing_error_deg(T_GT_M, T_GT_M) == pytest.approx(0.0, abs=1e-9)
    add = metrics.add_m(IDENTITY, T_GT_M, IDENTITY, T_GT_M, points)
    assert add == 0
    assert bool(metrics.add_within(add, 10.0, 0.1))
    assert bool(metrics.rot_10deg(IDENTITY, IDENTITY))
    assert bool(metrics.depth_5pct(T_GT_M, T_GT_M))
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


def test_thresholds_lie_where_the_paper_puts_them() -> None:
    near, far = T_GT_M * 1.049, T_GT_M * 1.051
    assert metrics.rot_10deg([turned("x", 9.9), turned("x", 10.1)], IDENTITY).tolist() == [True, False]
    assert metrics.depth_5pct([near, far], T_GT_M).tolist() == [True, False]
    assert bool(metrics.pose_10deg_5pct(turned("x", 9.9), near, IDENTITY, T_GT_M))
    assert not bool(metrics.pose_10deg_5pct(turned("x", 10.1), near, IDENTITY, T_GT_M))
    assert not bool(metrics.pose_10deg_5pct(turned("x", 9.9), far, IDENTITY, T_GT_M))
    assert metrics.add_within([0.99, 1.01, 4.99, 5.01], 10.0, 0.1).tolist() == [True, False, False, False]
    assert metrics.add_within([0.99, 1.01, 4.99, 5.01], 10.0, 0.5).tolist() == [True, True, True, False]


def test_a_sideways_error_spoils_the_pose_but_not_the_depth() -> None:
    beside = T_GT_M + np.array([0.06 * np.linalg.norm(T_GT_M), 0.0, 0.0])
    assert bool(metrics.depth_5pct(beside, T_GT_M))
    assert not bool(metrics.pose_10deg_5pct(IDENTITY, beside, IDENTITY, T_GT_M))


def test_add_of_a_half_turn_is_twice_the_distance_from_the_axis() -> None:
    wing_tips = np.array([[0.0, 6.0, 0.0], [0.0, -6.0, 0.0]])
    assert metrics.add_m(turned("x", 180.0), T_GT_M, IDENTITY, T_GT_M, wing_tips) == pytest.approx(12.0)


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_every_error_agrees_with_scipy_and_plain_loops(seed: int) -> None:
    R_est, t_est, R_gt, t_gt = random_poses(seed)
    points = np.random.default_rng(seed).uniform(-6, 6, (9, 3))
    for k in range(len(t_gt)):
        between = Rotation.from_matrix(R_est[k]) * Rotation.from_matrix(R_gt[k]).inv()
        angle_deg = float(np.degrees(between.magnitude()))
        apart_m = sum((a - b) ** 2 for a, b in zip(t_est[k], t_gt[k], strict=True)) ** 0.5
        range_m = sum(b**2 for b in t_gt[k]) ** 0.5
        cosine = float(t_est[k] @ t_gt[k]) / (sum(a**2 for a in t_est[k]) ** 0.5 * range_m)
        moved = [R_est[k] @ x + t_est[k] - R_gt[k] @ x - t_gt[k] for x in points]
        add = sum((d @ d) ** 0.5 for d in moved) / len(points)
        at = (R_est[k], t_est[k], R_gt[k], t_gt[k])
        assert metrics.rotation_error_deg(R_est, R_gt)[k] == pytest.approx(angle_deg, abs=1e-6)
        assert metrics.translation_error_m(t_est, t_gt)[k] == pytest.approx(apart_m)
        assert metrics.depth_error_m(t_est, t_gt)[k] == pytest.approx(abs(t_est[k, 2] - t_gt[k, 2]))
        assert metrics.bearing_error_deg(t_est, t_gt)[k] == pytest.approx(
            np.degrees(np.arccos(min(cosine, 1))), abs=1e-4
        )
        depth_rel = abs(t_est[k, 2] / t_gt[k, 2] - 1.0)
        assert metrics.depth_error_rel(t_est, t_gt)[k] == pytest.approx(depth_rel)
        assert bool(metrics.depth_5pct(t_est, t_gt)[k]) == (depth_rel < 0.05)
        assert bool(metrics.add_within(add, 4.0 * add + 0.1, 0.5))
        assert not bool(metrics.add_within(add, 2.0 * add - 0.1, 0.5))
        assert metrics.add_m(*at, points) == pytest.approx(add)
        assert metrics.add_m(R_est, t_est, R_gt, t_gt, points)[k] == pytest.approx(add)
        expected = angle_deg < 10 and apart_m / range_m < 0.05
        assert bool(metrics.pose_10deg_5pct(R_est, t_est, R_gt, t_gt)[k]) == expected
        assert bool(metrics.pose_10deg_5pct(*at)) == expected


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_errors_do_not_depend_on_the_choice_of_camera_axes(seed: int) -> None:
    R_est, t_est, R_gt, t_gt = random_poses(seed)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    points = np.random.default_rng(seed).uniform(-6, 6, (9, 3))
    plain = metrics.add_m(R_est, t_est, R_gt, t_gt, points)
    np.testing.assert_allclose(
        metrics.rotation_error_deg(turn @ R_est, turn @ R_gt), metrics.rotation_error_deg(R_est, R_gt), atol=1e-6
    )
    np.testing.assert_allclose(
        metrics.bearing_error_deg(t_est @ turn.T, t_gt @ turn.T), metrics.bearing_error_deg(t_est, t_gt), atol=1e-6
    )
    np.testing.assert_allclose(metrics.add_m(turn @ R_est, t_est @ turn.T, turn @ R_gt, t_gt @ turn.T, points), plain)


def test_calibration_of_a_hand_worked_case() -> None:
    """sigma_z 4 m, sigma_x 2 m at 400 m, rotation 0.1 rad: truth at 1.5 sigma of each."""
    covariance = np.diag([4.0, 4.0, 16.0, 0.01, 0.01, 0.01])
    t_est = np.array([0.0, 0.0, 400.0])
    deeper, aside = t_est + np.array([0.0, 0.0, 6.0]), t_est + np.array([3.0, 0.0, 0.0])
    assert [bool(metrics.depth_inside(t_est, deeper, covariance, k)) for k in (1, 2)] == [False, True]
    assert metrics.bearing_inside(t_est, aside, covariance, 1).tolist() == [False, True]
    assert metrics.bearing_inside(t_est, aside, covariance, 2).tolist() == [True, True]
    R_gt = Rotation.from_rotvec([0.0, 0.15, 0.0]).as_matrix()
    assert metrics.rotation_inside(IDENTITY, R_gt, covariance, 1).tolist() == [True, False, True]
    assert metrics.rotation_inside(IDENTITY, R_gt, covariance, 2).tolist() == [True, True, True]


def test_truth_drawn_from_the_covariance_is_inside_as_often_as_a_gaussian_is() -> None:
    """Correlated along an oblique ray, as the network's depth uncertainty makes it."""
    rng = np.random.default_rng(7)
    t_est, count = np.array([40.0, -25.0, 300.0]), 4000
    along = 0.03 * t_est
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.outer(along, along) + np.diag([0.04, 0.09, 1e-6])
    covariance[3:, 3:] = np.diag([0.05, 0.1, 0.02]) ** 2
    drawn = rng.multivariate_normal(np.zeros(6), covariance, count)
    t_gt, R_est = t_est + drawn[:, :3], Rotation.random(rng=rng)
    R_gt = (Rotation.from_rotvec(drawn[:, 3:]) * R_est).as_matrix()
    for k in (1, 2):
        expected = norm.cdf(k) - norm.cdf(-k)
        for inside in (
            metrics.depth_inside(t_est, t_gt, covariance, k),
            metrics.bearing_inside(t_est, t_gt, covariance, k)[..., 0],
            metrics.bearing_inside(t_est, t_gt, covariance, k)[..., 1],
            metrics.rotation_inside(R_est.as_matrix(), R_gt, covariance, k),
        ):
            assert inside.mean() == pytest.approx(expected, abs=0.03)


def test_recall_and_false_positives_count_what_their_names_say() -> None:
    assert metrics.recall(3, 4) == 0.75
    assert metrics.recall(0, 0) is None
    assert metrics.false_positives_per_1000(3, 54) == pytest.approx(55.5556, abs=1e-3)
    assert metrics.false_positives_per_1000(0, 54) == 0.0
    assert metrics.false_positives_per_1000(2, 0) is None


def test_a_covariance_without_an_inverse_has_no_nees_and_leaves_the_others_theirs() -> None:
    flat = np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    pose, position, rotation = metrics.nees(
        [IDENTITY] * 2, np.zeros((2, 3)), [IDENTITY] * 2, np.full((2, 3), 2.0), [flat, np.eye(6)]
    )
    np.testing.assert_array_equal(pose, [np.nan, 12.0])
    np.testing.assert_array_equal(position, [np.nan, 12.0])
    np.testing.assert_array_equal(rotation, [0.0, 0.0])
