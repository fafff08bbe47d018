"""The filter of a target's position and motion: each step against what it must amount to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.tracking import motion as ekf
from edge.tracking.motion import Motion
from edge.tracking.range_scale import RangeScale
from edge.tracking.view import View
from edge.types import Array, Estimate, OwnShip

from .test_tracker_parts import LOOKING_NORTH, K

MS = 1_000_000
STILL = OwnShip(1, np.eye(3), np.zeros(3), np.zeros(3), None)
RELATIVE = replace(STILL, t_ned_body_m=None, v_ned_body_mps=None)


def seen_at(t_cam_m: list[float], across_std_m: float = 0.2) -> Estimate:
    t_m, covariance = np.array(t_cam_m), 0.01 * np.eye(6)
    along = np.outer(t_m, t_m) / (t_m @ t_m)
    covariance[:3, :3] = across_std_m**2 * (np.eye(3) - along) + 0.1**2 * np.outer(t_m, t_m)
    return Estimate(0.9, np.zeros(4), np.eye(3), t_m, covariance, "track")


@pytest.mark.parametrize("own_ship", [STILL, RELATIVE], ids=["ned", "ned_relative"])
@pytest.mark.parametrize("dt_ms", [20, 400, 2_000])
def test_errors_grow_as_the_motion_itself_carries_them(own_ship: OwnShip, dt_ms: int) -> None:
    """Against differences of the motion in each of its numbers; its own noise is what grows out of no error at all."""
    view = View.of(0, own_ship, LOOKING_NORTH)
    begun = ekf.begin(seen_at([5.0, -3.0, 250.0]), K, view)
    turn_radps = 0.3 if begun.kind == "ned" else 0.0
    flying = replace(begun, v_mps=np.array([12.0, -20.0, 3.0]), turn_rate_radps=turn_radps)

    def state(motion: Motion) -> Array:
        return np.array([*motion.t_m, *motion.v_mps, motion.turn_rate_radps])

    def later(offset: Array) -> Array:
        moved = replace(
            flying,
            t_m=flying.t_m + offset[:3],
            v_mps=flying.v_mps + offset[3:6],
            turn_rate_radps=flying.turn_rate_radps + offset[6],
        )
        return state(ekf.propagate(moved, dt_ms * MS))

    step = 1e-5
    J = np.column_stack([(later(step * e) - later(-step * e)) / (2.0 * step) for e in np.eye(7)])
    if begun.kind != "ned":
        J[:6, 6] = 0.0  # it has no turn rate
    root = np.random.default_rng(1).normal(size=(7, 7)) * [3.0, 3.0, 3.0, 5.0, 5.0, 2.0, 0.1]
    P = root.T @ root
    with_errors, without = (ekf.propagate(replace(flying, P=one), dt_ms * MS).P for one in (P, np.zeros((7, 7))))
    scale = np.sqrt(np.diag(with_errors))
    np.testing.assert_allclose((with_errors - without - J @ P @ J.T) / np.outer(scale, scale), 0.0, atol=1e-7)
    assert np.all(np.linalg.eigvalsh(without)[1 if begun.kind != "ned" else 0 :] > 0.0)


def test_errors_grow_in_many_steps_as_in_one() -> None:
    begun = ekf.begin(seen_at([5.0, -3.0, 250.0]), K, View.of(0, RELATIVE, LOOKING_NORTH))
    at_once = steps = replace(begun, v_mps=np.array([12.0, -20.0, 3.0]))
    for step in range(1, 31):
        steps = ekf.propagate(steps, step * 33 * MS)
    at_once = ekf.propagate(at_once, 990 * MS)
    np.testing.assert_allclose(steps.t_m, at_once.t_m)
    np.testing.assert_allclose(steps.P, at_once.P, rtol=1e-9, atol=1e-9)


def test_where_it_was_not_detected_a_target_is_as_sure_as_that_frame_s_attitude_and_its_speed_as_its_range() -> None:
    """0.1 rad are 25 m at 250 m; a range known within 9 %, in all frames alike, leaves as much of the speed unknown.
    Both are those relative to the own ship."""
    own = replace(STILL, t_ned_body_m=np.array([900.0, 400.0, -80.0]), v_ned_body_mps=np.array([20.0, 0.0, 0.0]))
    begun = ekf.begin(seen_at([0.0, 0.0, 250.0]), K, View.of(0, own, LOOKING_NORTH))
    flying = ekf.propagate(replace(begun, v_mps=np.array([70.0, 0.0, 0.0]), P=np.zeros((7, 7))), 1)
    exact, vague = (View.of(1, replace(own, attitude_std_rad=std), LOOKING_NORTH) for std in (0.0, 0.1))
    more = ekf.covariance_in_cam(flying, vague) - ekf.covariance_in_cam(flying, exact)
    np.testing.assert_allclose(more, np.diag([625.0, 625.0, 0.0]), atol=1e-6)
    share2 = 0.8 * (0.1**2 + 0.01**2)  # what frames have in common of the network's variance and the model's
    told = ekf.covariance(flying, exact)
    np.testing.assert_allclose(
        told[[0, 0, 3], [0, 3, 3]], share2 * np.array([250.0**2, 250.0 * 50.0, 50.0**2]), rtol=0.01
    )


@pytest.mark.parametrize(("aside_m", "moved_m"), [(5.0, 2.5), (20.0, 6.8), (40.0, 4.6)])
def test_what_is_seen_far_beside_where_it_was_expected_moves_a_track_little(aside_m: float, moved_m: float) -> None:
    """Both are sure within 3 m, so the middle is taken; beyond chi-square's 99 % (11.34 for three degrees of freedom)
    less and less of the way, as the measurement's variance is raised in proportion to the squared distance. At 20 m:
    20^2 / 18 = 22.2, 9 m^2 become 17.6, and of the 20 m the share 9 / (9 + 17.6) is taken over."""
    view = View.of(33 * MS, STILL, LOOKING_NORTH)
    begun = ekf.begin(seen_at([0.0, 0.0, 300.0]), K, view)
    predicted = replace(begun, seen_ns=0, P=np.diag([900.0, 9.0, 9.0, 25.0, 25.0, 25.0, 0.01]))
    sight = seen_at([aside_m, 0.0, 300.0], across_std_m=3.0)
    corrected = ekf.correct(predicted, ekf.innovation(predicted, sight, K, view), view)
    assert corrected.t_m[1] == pytest.approx(moved_m, rel=0.05)


@pytest.mark.parametrize("farther", [0.6, 1.6])
def test_a_track_far_from_its_frames_is_corrected_as_if_it_had_been_among_them(farther: float) -> None:
    """Moved along its ray with all that scales with the range; its velocity is as much less sure as it was moved."""
    view = View.of(500 * MS, replace(STILL, attitude_std_rad=0.02), LOOKING_NORTH)
    begun = ekf.begin(seen_at([10.0, 4.0, 250.0]), K, view)
    scale = RangeScale.begin(0, float(np.log(farther * np.linalg.norm(begun.t_m))), 0.01)
    for frame in range(1, 10):
        scale = scale.seen(frame * 50 * MS, scale.recent[0][1], 0.01, scale.recent[0][1], (0.0, 0.0))
    P = np.diag([100.0, 4.0, 4.0, 9.0, 9.0, 9.0, 0.01])
    off = replace(begun, seen_ns=450 * MS, P=P, scale=scale)

    sizes = np.array([farther, farther, farther, 1.0, 1.0, 1.0, 1.0])
    among_P = np.outer(sizes, sizes) * P
    among_P[3:6, 3:6] += np.log(farther) ** 2 * np.diag([80.0, 80.0, 12.0]) ** 2
    among = replace(off, t_m=farther * off.t_m, P=among_P)

    estimate = seen_at([farther * 10.0 + 0.3, farther * 4.0 - 0.2, farther * 250.0])
    one, other = (ekf.correct(track, ekf.innovation(track, estimate, K, view), view) for track in (off, among))
    np.testing.assert_allclose(one.t_m, other.t_m, atol=1e-3)
    np.testing.assert_allclose(one.v_mps, other.v_mps, atol=1e-3)
    np.testing.assert_allclose(one.P, other.P, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(ekf.covariance_in_cam(one, view), ekf.covariance_in_cam(other, view), rtol=1e-3)


@pytest.mark.parametrize("from_silent", [True, False])
def test_where_the_own_speed_is_not_told_a_velocity_is_not_known_relative_to_the_own_ship(from_silent: bool) -> None:
    silent, relative = (View.of(0, one, LOOKING_NORTH) for one in (replace(STILL, v_ned_body_mps=None), RELATIVE))
    old, new = (silent, relative) if from_silent else (relative, silent)
    sure = replace(ekf.begin(seen_at([0.0, 0.0, 200.0]), K, old), P=np.eye(7))
    assert np.all(np.diag(ekf.reframe(sure, old, new, 0.0).P)[3:6] > 50.0**2)
    told, relative = View.of(0, STILL, LOOKING_NORTH), View.of(0, RELATIVE, LOOKING_NORTH)
    np.testing.assert_allclose(np.diag(ekf.reframe(sure, told, relative, 0.0).P)[3:6], 1.0)
