"""How sure a track is told to be: in ned, after a doubted stamp, and where one frame is carried over into another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.tracking import motion as ekf
from edge.tracking import rotation, so3
from edge.tracking.motion import STALE_ATTITUDE_RADPS
from edge.tracking.tracker import Tracker
from edge.tracking.view import View
from edge.types import OwnShip, Track

from .test_tracker_parts import LOOKING_NORTH, NORTH_EAST, SIZE_WH, K, sight

MS = 1_000_000
STILL = OwnShip(1, np.eye(3), np.zeros(3), np.zeros(3), None)
AHEAD_M = np.array([200.0, 0.0, 0.0])


def follow(tracker: Tracker, frames: int = 20) -> tuple[Track, OwnShip]:
    """The track of a target that crosses 200 m ahead, and the own ship at the last frame."""
    rng = np.random.default_rng(0)
    for k in range(frames):
        own = replace(STILL, time_ns=1 + 33 * k * MS)
        seen = sight(rng, np.array([0.3 * k, 0.0, 200.0]), NORTH_EAST)
        (track,) = tracker.update(own.time_ns, [seen], own, K, SIZE_WH)
    return track, own


def test_an_attitude_in_ned_is_no_surer_than_in_the_camera() -> None:
    track, _ = follow(Tracker(1, LOOKING_NORTH))
    R_ned_cam = LOOKING_NORTH.R_body_cam
    assert track.covariance_ned is not None
    in_cam = np.diag(R_ned_cam @ track.covariance[3:, 3:] @ R_ned_cam.T)
    assert np.all(np.diag(track.covariance_ned[6:, 6:]) > 0.99 * in_cam)


def test_a_velocity_across_a_doubted_stamp_is_forgotten_once_more_after_it() -> None:
    tracker = Tracker(1, LOOKING_NORTH)
    _, own = follow(tracker)
    tracker.doubt_motion()
    own = replace(own, time_ns=own.time_ns + 1_000 * MS)
    seen = sight(np.random.default_rng(1), np.array([6.0, 0.0, 200.0]), NORTH_EAST)
    (track,) = tracker.update(own.time_ns, [seen], own, K, SIZE_WH)
    assert track.covariance_ned is not None
    assert np.all(np.sqrt(np.diag(track.covariance_ned)[3:5]) > 50.0)


def test_a_velocity_that_is_forgotten_leaves_the_place_as_sure_as_it_was() -> None:
    view = View.of(0, STILL, LOOKING_NORTH)
    motion = ekf.begin(sight(np.random.default_rng(4), np.array([20.0, -10.0, 200.0]), NORTH_EAST), K, view)
    flying = replace(motion, v_mps=np.array([3.0, 25.0, 0.0]), turn_rate_radps=0.3)
    forgotten = ekf.unknown_motion(flying, view)
    np.testing.assert_allclose(forgotten.t_m, motion.t_m)
    before, after = ekf.covariance_in_cam(motion, view), ekf.covariance_in_cam(forgotten, view)
    np.testing.assert_allclose(after, before, rtol=1e-9)
    in_a_second = ekf.propagate(forgotten, 1_000 * MS)
    np.testing.assert_allclose(in_a_second.t_m, motion.t_m)
    assert np.all(np.sqrt(np.diag(in_a_second.P)[:2]) > 50.0)


@pytest.mark.parametrize("to", [replace(STILL, origin_epoch=1), replace(STILL, axes_epoch=1)])
def test_a_turn_from_before_another_origin_or_north_is_not_gone_on_with(to: OwnShip) -> None:
    old, new = View.of(0, STILL, LOOKING_NORTH), View.of(0, to, LOOKING_NORTH)
    motion = ekf.begin(sight(np.random.default_rng(5), np.array([20.0, -10.0, 200.0]), NORTH_EAST), K, old)
    turning = replace(motion, v_mps=np.array([0.0, 25.0, 0.0]), turn_rate_radps=0.6)
    moved = ekf.reframe(turning, old, new, 0.0)
    np.testing.assert_allclose(ekf.propagate(moved, 1_000 * MS).t_m, moved.t_m + np.array([0.0, 25.0, 0.0]), atol=1e-9)


def own_ship_variances(own_ship: OwnShip) -> np.ndarray:
    """[9] of a target 200 m north: what the own ship's errors do to its place, velocity and attitude."""
    return np.diag(View.of(0, own_ship, LOOKING_NORTH).own_ship_covariance(AHEAD_M, np.zeros(3)))


def test_an_attitude_gone_on_from_leaves_a_target_s_place_and_attitude_in_doubt() -> None:
    more = own_ship_variances(replace(STILL, attitude_std_rad=0.1)) - own_ship_variances(STILL)
    np.testing.assert_allclose(more[:3], [0.0, 20.0**2, 20.0**2], atol=1e-6)
    np.testing.assert_allclose(more[6:], 0.1**2)


@pytest.mark.parametrize("attitude_known", [True, False])
def test_a_target_first_seen_at_an_attitude_hardly_known_is_the_one_that_the_next_frames_show(
    attitude_known: bool,
) -> None:
    """The first attitude is off by 0.05 rad: 10 m at 200 m. If that is not known of it, there are two targets."""
    tracker, rng = Tracker(4, LOOKING_NORTH), np.random.default_rng(8)
    turned = so3.exp(np.array([0.0, 0.0, 0.05]))
    for k in range(4):
        own = replace(STILL, time_ns=1 + 33 * k * MS)
        if k == 0:
            own = replace(own, R_ned_body=turned, attitude_std_rad=0.0 if attitude_known else 0.05)
        tracks = tracker.update(own.time_ns, [sight(rng, np.array([0.0, 0.0, 200.0]), NORTH_EAST)], own, K, SIZE_WH)
    assert len(tracks) == (2 if attitude_known else 1)
    assert tracks[-1].t_ned_target_m == pytest.approx(AHEAD_M, rel=0.1, abs=1.0)


@pytest.mark.parametrize("attitude_std_rad", [0.0, 0.02, 0.1])
def test_a_sight_makes_a_place_as_much_surer_as_the_attitude_in_that_frame_is_known(attitude_std_rad: float) -> None:
    """Across the sight line the inverses of the variances add up: that of the prediction, 9 m2, and that of the
    measurement with the error of the attitude at 200 m."""
    view = View.of(33 * MS, replace(STILL, attitude_std_rad=attitude_std_rad), LOOKING_NORTH)
    estimate = sight(np.random.default_rng(9), np.array([0.0, 0.0, 200.0]), NORTH_EAST)
    estimate = replace(estimate, t_cam_target_m=np.array([0.0, 0.0, 200.0]))
    begun = ekf.begin(estimate, K, view)
    predicted = replace(begun, seen_ns=0, P=np.diag([400.0, 9.0, 9.0, 25.0, 25.0, 25.0, 0.01]))
    corrected = ekf.correct(predicted, ekf.innovation(predicted, estimate, K, view), view)
    one_px_rad, jitter_rad = 1.0 / K[0, 0], 1e-3
    measured_m2 = 0.04 + 200.0**2 * (one_px_rad**2 + jitter_rad**2 + attitude_std_rad**2)
    np.testing.assert_allclose(np.diag(corrected.P)[1:3], 1.0 / (1.0 / 9.0 + 1.0 / measured_m2), rtol=1e-3)
    # In that frame's camera, the place is as sure as it was seen, whatever the attitude.
    seen_m2 = 1.0 / (1.0 / (9.0 + measured_m2 - 0.05) + 1.0 / 0.05)
    np.testing.assert_allclose(np.diag(ekf.covariance_in_cam(corrected, view))[:2], seen_m2, rtol=1e-3)


def test_a_place_told_from_the_own_ship_has_none_of_the_own_place_s_error() -> None:
    relative = own_ship_variances(replace(STILL, t_ned_body_m=None, v_ned_body_mps=None))
    assert relative[0] < 1e-9, "along the sight line neither attitude nor own place counts"
    assert own_ship_variances(STILL)[0] > 1.0


def test_a_camera_whose_speed_is_not_told_has_that_at_which_it_came() -> None:
    """As where a recorded scene is tracked anew: it holds places alone."""
    silent = replace(STILL, v_ned_body_mps=None)
    before = View.of(0, silent, LOOKING_NORTH)
    moved = replace(silent, t_ned_body_m=np.array([2.0, -1.0, 0.5]))
    np.testing.assert_allclose(View.of(100 * MS, moved, LOOKING_NORTH, before).v_frame_cam_mps, [20.0, -10.0, 5.0])
    assert View.of(900 * MS, moved, LOOKING_NORTH, before).v_frame_cam_mps is None
    relative = View.of(0, replace(silent, t_ned_body_m=None), LOOKING_NORTH)
    for other in (View.of(0, replace(silent, origin_epoch=1), LOOKING_NORTH), relative, None):
        assert View.of(100 * MS, moved, LOOKING_NORTH, other).v_frame_cam_mps is None


def test_a_camera_turns_at_the_rate_between_two_attitudes_that_are_close_and_mean_the_same() -> None:
    """Any other rate is made up, and the attitude would be doubted by it times the exposure time's error."""
    turned, still = replace(STILL, R_ned_body=so3.exp(np.array([0.0, 0.0, 0.1]))), View.of(0, STILL, LOOKING_NORTH)
    assert View.of(100 * MS, turned, LOOKING_NORTH, still).turning_radps == pytest.approx(1.0)
    in_cam = View.of(0, None, LOOKING_NORTH)
    other_north = View.of(0, replace(STILL, axes_epoch=1), LOOKING_NORTH)
    for before, time_ms in ((still, 0), (still, 600), (in_cam, 100), (other_north, 100), (None, 100)):
        view = View.of(time_ms * MS, turned, LOOKING_NORTH, before)
        assert view.turning_radps == 0.0
        assert view.attitude_variance == pytest.approx(1e-3**2)


def test_a_frame_change_by_an_old_attitude_leaves_the_target_in_doubt_across_the_sight_line() -> None:
    in_ned, in_cam = View.of(0, STILL, LOOKING_NORTH), View.of(0, None, LOOKING_NORTH)
    estimate = sight(np.random.default_rng(2), np.array([20.0, -10.0, 200.0]), NORTH_EAST)
    motion, attitude = ekf.begin(estimate, K, in_ned), rotation.begin(estimate, in_ned)
    fresh, stale = (ekf.reframe(motion, in_ned, in_cam, age_s) for age_s in (0.0, 1.0))
    across = so3.skew(fresh.t_m)
    more = (stale.P - fresh.P)[ekf.POSITION, ekf.POSITION]
    np.testing.assert_allclose(more, STALE_ATTITUDE_RADPS**2 * across @ across.T, atol=1e-6)
    assert np.sqrt(np.linalg.eigvalsh(more)[-1]) == pytest.approx(STALE_ATTITUDE_RADPS * np.linalg.norm(fresh.t_m))
    turned, long_turned = (rotation.reframe(attitude, ekf.between(in_ned, in_cam), age_s) for age_s in (0.0, 1.0))
    np.testing.assert_allclose(long_turned.P - turned.P, STALE_ATTITUDE_RADPS**2 * np.eye(3), atol=1e-9)


def test_only_where_own_attitude_is_lost_its_age_makes_a_target_less_sure() -> None:
    """Half a second at 0.5 rad/s: 50 m at 200 m. Where it is gained, it is that of this frame."""
    tracker = Tracker(1, LOOKING_NORTH)
    _, own = follow(tracker)
    later = replace(own, time_ns=own.time_ns + 500 * MS)
    (kept,), (lost,) = (tracker.predict(later.time_ns, one, K, SIZE_WH) for one in (later, None))
    more = lost.covariance - kept.covariance
    np.testing.assert_allclose(np.diag(more)[3:], 0.25**2, atol=1e-4)
    np.testing.assert_allclose(np.diag(more)[:2], 50.0**2, rtol=0.1)
    tracker.update(later.time_ns, [], None, K, SIZE_WH)
    again = replace(later, time_ns=later.time_ns + 500 * MS)
    (still_lost,), (gained,) = (tracker.predict(again.time_ns, one, K, SIZE_WH) for one in (None, again))
    np.testing.assert_allclose(gained.covariance, still_lost.covariance, rtol=0.01, atol=0.05)


def test_what_all_frames_share_is_mirrored_with_the_rotation_when_the_other_side_is_taken() -> None:
    """Along a sight line halfway between north and up, the mirror swaps north and down."""
    view = View.of(0, STILL, LOOKING_NORTH)
    begun = rotation.begin(sight(np.random.default_rng(3), np.array([0.0, 0.0, 200.0]), NORTH_EAST), view)
    wrong = replace(begun, P=np.diag([1.0, 2.0, 3.0]), common=np.diag([4.0, 5.0, 6.0]), picked=-3.0)
    along = np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0)
    other = rotation.weighed(wrong, along, None, 0.033, settled=False)
    assert other.log_odds == pytest.approx(3.0)
    np.testing.assert_allclose(other.P, np.diag([3.0, 2.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(other.common, np.diag([6.0, 5.0, 4.0]), atol=1e-12)


def test_what_the_own_ship_flew_since_the_last_frame_counts_where_the_origin_changes_meanwhile() -> None:
    tracker, rng, flying = Tracker(1, LOOKING_NORTH), np.random.default_rng(6), np.array([25.0, 0.0, 0.0])

    def own_at(time_s: float) -> OwnShip:
        return replace(STILL, time_ns=1 + round(time_s * 1e9), t_ned_body_m=time_s * flying, v_ned_body_mps=flying)

    for k in range(60):  # the target keeps its place in ned
        own = own_at(k / 30)
        tracker.update(
            own.time_ns, [sight(rng, np.array([0.0, 0.0, 300.0 - 25.0 * k / 30]), NORTH_EAST)], own, K, SIZE_WH
        )
    later = own_at(59 / 30 + 1.5)
    same = tracker.predict(later.time_ns, later, K, SIZE_WH)[0].t_cam_target_m
    elsewhere = replace(later, t_ned_body_m=np.array([-700.0, 80.0, 10.0]), origin_epoch=1)
    moved = tracker.predict(later.time_ns, elsewhere, K, SIZE_WH)[0].t_cam_target_m
    np.testing.assert_allclose(moved, same, atol=1e-6)


def test_a_velocity_from_before_own_attitude_was_known_is_told_as_unsure() -> None:
    """In `cam`, a camera that turns makes a target that stands still fly by at 87 m/s."""
    tracker, rng, turning_radps = Tracker(1, LOOKING_NORTH), np.random.default_rng(7), 0.35
    for k in range(40):
        yaw = turning_radps * (k / 30 - 0.65)
        R_ned_body = so3.exp(np.array([0.0, 0.0, yaw]))
        own = replace(STILL, time_ns=1 + 33 * k * MS, R_ned_body=R_ned_body)
        t_cam_m = (R_ned_body @ LOOKING_NORTH.R_body_cam).T @ np.array([250.0, 0.0, 0.0])
        seen = sight(rng, t_cam_m, NORTH_EAST)
        (track,) = tracker.update(own.time_ns, [seen], own if k == 39 else None, K, SIZE_WH)
    assert track.v_ned_target_mps is not None
    assert track.covariance_ned is not None
    v_mps, P_v = track.v_ned_target_mps, track.covariance_ned[3:6, 3:6]
    assert np.linalg.norm(v_mps) > 50.0
    assert v_mps @ np.linalg.solve(P_v, v_mps) < 3.0
