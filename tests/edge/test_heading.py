"""Which way an aircraft heads: outlines leave two answers, the track one."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.tracking.heading import depth_reversed, flown_nose_first
from edge.types import Estimate

# A symmetric aircraft: nose, tail, wing tips, fin.
POINTS_M = np.array([[4.0, 0, 0], [-4, 0, 0], [0, 6, 0.2], [0, -6, 0.2], [-3.5, 0, -1.5]])
SURE = 1e-6 * np.eye(3)
finite = st.floats(-1.0, 1.0)


def estimate(R: np.ndarray, t_m: np.ndarray, covariance: np.ndarray | None = None) -> Estimate:
    return Estimate(0.9, np.array([0.0, 0, 1, 1]), R, t_m, np.eye(6) if covariance is None else covariance, "track")


@settings(deadline=None, max_examples=50)
@given(st.tuples(finite, finite, finite, finite), st.tuples(finite, finite))
def test_the_depth_reversal_has_the_same_outline(q: tuple[float, ...], side: tuple[float, float]) -> None:
    """Far away, each point's image is that of the point mirrored left to right; doing it twice gives the first back."""
    R = Rotation.from_quat([q[0], q[1], q[2], q[3] + 3.0]).as_matrix()
    t_m = 1e6 * np.array([0.3 * side[0], 0.3 * side[1], 1.0])
    along = t_m / np.linalg.norm(t_m)
    one = estimate(R, t_m)
    other = depth_reversed(one, along)
    np.testing.assert_allclose(other.R_cam_target @ other.R_cam_target.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(other.R_cam_target) > 0
    project = lambda R, points: ((p := points @ R.T + t_m)[:, :2] / p[:, 2:]) * 1e6  # noqa: E731
    mirrored = POINTS_M * [1, -1, 1]
    np.testing.assert_allclose(project(other.R_cam_target, mirrored), project(R, POINTS_M), atol=1e-3)
    np.testing.assert_allclose(depth_reversed(other, along).R_cam_target, R, atol=1e-12)


def test_a_nose_against_the_track_is_turned_about() -> None:
    """Seen flying away with its nose told 30 degrees off towards us: the answer is 30 degrees off away from us."""
    t_m = np.array([0.0, 0.0, 200.0])
    # Level, cam's y down: body x forward in the cam's x-z plane.
    towards = np.array([[np.cos(a := np.deg2rad(-60)), -np.sin(a), 0], [0, 0, 1], [np.sin(a), np.cos(a), 0]])
    towards = np.column_stack([towards[:, 0], np.cross([0, 1.0, 0], towards[:, 0]), [0, 1.0, 0]])
    turned = flown_nose_first(estimate(towards, t_m), np.array([20.0, 0.0, 30.0]), SURE)
    np.testing.assert_allclose(turned.R_cam_target[:, 0], [np.cos(a), 0, -np.sin(a)], atol=1e-12)
    np.testing.assert_allclose(turned.R_cam_target[:, 2], [0, 1, 0], atol=1e-12)


def test_nothing_is_turned_on_an_unsure_or_slow_track() -> None:
    t_m = np.array([0.0, 0.0, 200.0])
    R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])  # nose straight at us
    told = estimate(R, t_m)
    away = np.array([0.0, 0.0, 30.0])
    assert flown_nose_first(told, away, SURE) is not told
    assert flown_nose_first(told, away, 15.0**2 * np.eye(3)) is told
    assert flown_nose_first(told, 0.1 * away, SURE) is told
    assert flown_nose_first(told, -away, SURE) is told


@settings(deadline=None, max_examples=30)
@given(st.tuples(finite, finite, finite))
def test_the_covariance_turns_with_the_rotation(w: tuple[float, float, float]) -> None:
    """An error of the one is told as the same error of the other: checked by turning a disturbed rotation."""
    rng = np.random.default_rng(3)
    R, t_m = Rotation.random(random_state=7).as_matrix(), np.array([20.0, -10.0, 200.0])
    along = t_m / np.linalg.norm(t_m)
    error = 1e-3 * np.array([*rng.normal(size=3), *w])
    disturbed = Rotation.from_rotvec(error[3:]).as_matrix() @ R
    one = depth_reversed(estimate(R, t_m, np.outer(error, error)), along)
    other = depth_reversed(estimate(disturbed, t_m), along)
    moved = Rotation.from_matrix(other.R_cam_target @ one.R_cam_target.T).as_rotvec()
    expected = np.concatenate([error[:3], moved])
    np.testing.assert_allclose(one.covariance, np.outer(expected, expected), atol=1e-12)
