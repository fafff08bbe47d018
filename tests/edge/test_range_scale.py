"""Range of a track whose frames now and then take the target for an aircraft of another size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.tracking.range_scale import RangeScale
from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, OwnShip, Track, TrackState

K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 540.0], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
LOOKING_NORTH = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
LOG_RANGE_STD = 0.1


def sight(t_cam_m: np.ndarray, log_range_error: float) -> Estimate:
    center = (K @ t_cam_m)[:2] / t_cam_m[2]
    covariance = np.diag([0.04, 0.04, 0.0, 0.01, 0.01, 0.01])
    covariance[:3, :3] += LOG_RANGE_STD**2 * np.outer(t_cam_m, t_cam_m)
    box = np.concatenate([center - 35, center + 35])
    return Estimate(0.9, box, np.eye(3), t_cam_m * np.exp(log_range_error), covariance, "track")


def follow(
    log_range_errors: np.ndarray,
    rate_hz: float,
    own_ship_known: bool,
    range_m: float = 200.0,
    opening_mps: float = 6.0,
    missed: range = range(0),
    doubted: int | None = None,
    resized: int | None = None,
) -> list[tuple[Track, np.ndarray]]:
    """Tracks and truths of a target ahead that draws away, or closes, and to the right; `missed` frames show none, and
    before frame `doubted` the camera's timestamps are found to have jumped, before `resized` another size is given."""
    tracker = Tracker(1, LOOKING_NORTH)
    flown = []
    for i, error in enumerate(log_range_errors):
        t_s = i / rate_hz
        t_cam = np.array([4.0 * t_s, 0.0, range_m + opening_mps * t_s])
        own_m = np.array([20.0 * t_s, 0.0, -100.0])
        own = OwnShip(1 + round(t_s * 1e9), np.eye(3), own_m, np.array([20.0, 0.0, 0.0]), None)
        found = [] if i in missed else [sight(t_cam, float(error))]
        if i == doubted:
            tracker.doubt_motion()
        if i == resized:
            tracker.doubt_ranges()
        (track,) = tracker.update(own.time_ns, found, own if own_ship_known else None, K, SIZE_WH)
        flown.append((track, t_cam))
    return flown


def looking_at(ray_m: np.ndarray) -> np.ndarray:
    """R_ned_cam [3, 3] of an upright camera that is turned to ray_m [3]."""
    z = ray_m / np.linalg.norm(ray_m)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def range_std(track: Track) -> float:
    """Share of the range."""
    t = track.t_cam_target_m
    return float(np.sqrt(t @ track.covariance[:3, :3] @ t) / (t @ t))


@pytest.mark.parametrize("own_ship_known", [True, False], ids=["ned", "cam"])
@pytest.mark.parametrize("seed", range(3))
def test_frames_of_another_size_do_not_move_the_track(seed: int, own_ship_known: bool) -> None:
    """Of 30 % of the frames that read 40 % short the mean is 14 % short; the track is not."""
    rng = np.random.default_rng(seed)
    errors = rng.normal(scale=0.02, size=120)
    errors[5:][rng.random(115) < 0.3] += np.log(0.6)
    assert np.mean(errors) < -0.1
    flown = follow(errors, 30.0, own_ship_known)
    off = [np.log(np.linalg.norm(track.t_cam_target_m) / np.linalg.norm(truth)) for track, truth in flown[30:]]
    assert np.mean(np.abs(off)) < 0.05


@pytest.mark.parametrize("own_ship_known", [True, False], ids=["ned", "cam"])
@pytest.mark.parametrize("closing_mps", [80.0, 100.0])
def test_a_target_that_comes_head_on_is_not_told_farther_than_it_is(closing_mps: float, own_ship_known: bool) -> None:
    """At 100 m its range shrinks by all of itself in a second; frames that are right must not be outvoted by those
    of when it was farther away."""
    for seed in range(3):
        errors = np.random.default_rng(seed).normal(scale=0.02, size=121)
        flown = follow(errors, 30.0, own_ship_known, 100.0 + 4.0 * closing_mps, -closing_mps)
        last_m = [np.linalg.norm([track.t_cam_target_m, truth], axis=1) for track, truth in flown[-30:]]
        assert max(abs(np.log(told_m / true_m)) for told_m, true_m in last_m) < 0.07


@pytest.mark.parametrize("own_ship_known", [True, False], ids=["ned", "cam"])
def test_a_target_whose_velocity_was_forgotten_is_not_told_where_it_was_before(own_ship_known: bool) -> None:
    """Without a velocity, the ranges of a second ago, half as far again, say nothing of where it is now."""
    for seed in range(3):
        errors = np.random.default_rng(seed).normal(scale=0.02, size=90)
        flown = follow(errors, 30.0, own_ship_known, 450.0, -100.0, doubted=60)
        last_m = [np.linalg.norm([track.t_cam_target_m, truth], axis=1) for track, truth in flown[60:]]
        assert max(abs(np.log(told_m / true_m)) for told_m, true_m in last_m) < 0.1


@pytest.mark.parametrize("kind", ["ned", "ned_relative", "cam"])
@pytest.mark.parametrize("abeam_m", [100.0, 150.0])
def test_a_target_that_passes_abeam_is_told_where_it_is(abeam_m: float, kind: str) -> None:
    """Its range stands still there, and was twice as far a second ago: frames that are right must not be outvoted.
    Without own attitude, a camera that follows it does not see that it passes."""
    velocity_mps, own_mps = np.array([-80.0, 0.0, 0.0]), np.array([20.0, 0.0, 0.0])
    for seed in range(3):
        tracker = Tracker(1, Mount(np.eye(3), np.zeros(3)))
        for i, error in enumerate(np.random.default_rng(seed).normal(scale=0.02, size=180)):
            t_s = i / 30.0
            own_m, target_m = t_s * own_mps, np.array([300.0, abeam_m, -5.0]) + t_s * velocity_mps
            R_ned_cam = looking_at(target_m - own_m)
            t_cam = R_ned_cam.T @ (target_m - own_m)
            own = OwnShip(1 + round(t_s * 1e9), R_ned_cam, own_m, own_mps, None)
            if kind == "ned_relative":
                own = replace(own, t_ned_body_m=None, v_ned_body_mps=None)
            told = None if kind == "cam" else own
            (track,) = tracker.update(own.time_ns, [sight(t_cam, float(error))], told, K, SIZE_WH)
            told_m, true_m = np.linalg.norm([track.t_cam_target_m, t_cam], axis=1)
            assert t_s < 0.5 or abs(np.log(told_m / true_m)) < 0.07


@pytest.mark.parametrize("own_ship_known", [True, False], ids=["ned", "cam"])
@pytest.mark.parametrize("closing_mps", [-60.0, 60.0, 100.0])
def test_a_young_track_that_was_missed_is_taken_up_where_it_is_seen(closing_mps: float, own_ship_known: bool) -> None:
    """After five sights its speed is hardly known; 1.7 s later it is at as little as 0.4 or as much as twice the range
    that was predicted, which is far beyond where a difference of log ranges is one of ranges."""
    missed = range(5, 56)
    errors = np.random.default_rng(1).normal(scale=0.02, size=60)
    flown = follow(errors, 30.0, own_ship_known, 120.0 if closing_mps < 0.0 else 290.0, -closing_mps, missed)
    for (track, truth), error in zip(flown[missed.stop :], errors[missed.stop :], strict=True):
        assert track.measured_ns == track.time_ns
        assert track.t_cam_target_m == pytest.approx(np.exp(error) * truth, rel=0.1, abs=1.0)
    if own_ship_known:
        assert track.v_ned_target_mps is not None
        assert track.v_ned_target_mps[0] == pytest.approx(20.0 - closing_mps, abs=12.0)


@pytest.mark.parametrize("turned_deg", [10.0, 15.0, 20.0])
def test_in_cam_a_target_missed_while_the_camera_turned_is_told_where_it_is_seen(turned_deg: float) -> None:
    tracker = Tracker(1, LOOKING_NORTH)
    for i, error in enumerate(np.random.default_rng(1).normal(scale=0.02, size=40)):
        angle = np.deg2rad(turned_deg) * np.clip((i - 20) / 15.0, 0.0, 1.0)
        t_cam = 200.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        found = [] if 20 < i < 35 else [sight(t_cam, float(error))]
        (track,) = tracker.update(1 + round(i * 1e9 / 20), found, None, K, SIZE_WH)
        if i >= 35:
            assert track.measured_ns == track.time_ns
            told_px, true_px = ((K @ t)[:2] / t[2] for t in (track.t_cam_target_m, t_cam))
            assert np.abs(told_px - true_px).max() < 5.0
            assert np.linalg.norm(track.t_cam_target_m) == pytest.approx(200.0, rel=0.1)


def test_in_cam_a_camera_that_swings_does_not_change_the_range() -> None:
    """At up to 70 degrees a second across the sight line: a target that flew so fast would have been farther away."""
    tracker = Tracker(1, LOOKING_NORTH)
    for i, error in enumerate(np.random.default_rng(1).normal(scale=0.02, size=120)):
        angle = 0.4 * np.sin(np.pi * i / 30.0)
        t_cam = 200.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        (track,) = tracker.update(1 + round(i * 1e9 / 30), [sight(t_cam, float(error))], None, K, SIZE_WH)
        assert i < 15 or np.linalg.norm(track.t_cam_target_m) == pytest.approx(200.0, rel=0.06)


@pytest.mark.parametrize("kind", ["ned", "ned_relative"])
@pytest.mark.parametrize("beside_m", [10.0, 20.0])
def test_what_comes_into_sight_far_ahead_is_not_the_target_that_has_just_passed(beside_m: float, kind: str) -> None:
    """Beside the camera a few metres are a good part of the range, and their logarithm is as uncertain as that of any
    range ahead; the metres are not."""
    for seed in range(4):
        tracker = Tracker(4, LOOKING_NORTH)
        for i, error in enumerate(np.random.default_rng(seed).normal(scale=0.04, size=34)):
            t_s = i / 20.0
            passing = np.array([beside_m, 0.0, 80.0 - 60.0 * t_s])
            follows = passing + np.array([-10.0, 2.0, 100.0])
            found = [] if 0.0 < passing[2] < 40.0 else [sight(passing if passing[2] > 0.0 else follows, float(error))]
            v_mps = np.array([20.0, 0.0, 0.0])
            own = OwnShip(1 + round(t_s * 1e9), np.eye(3), t_s * v_mps, v_mps, None)
            if kind == "ned_relative":
                own = replace(own, t_ned_body_m=None, v_ned_body_mps=None)
            tracks = tracker.update(own.time_ns, found, own, K, SIZE_WH)
            if passing[2] <= 0.0:
                (seen,) = (track for track in tracks if track.measured_ns == track.time_ns)
                assert seen.track_id == 1
                assert seen.t_cam_target_m == pytest.approx(follows, rel=0.2)
        assert seen.state is TrackState.CONFIRMED


@pytest.mark.parametrize("seed", range(3))
def test_a_track_that_began_at_the_wrong_size_finds_the_right_one(seed: int) -> None:
    errors = np.random.default_rng(seed).normal(scale=0.02, size=90)
    errors[:3] += np.log(0.6)
    track, truth = follow(errors, 30.0, True)[-1]
    assert np.linalg.norm(track.t_cam_target_m) == pytest.approx(np.linalg.norm(truth), rel=0.06)
    # The jump to the right range is no speed: northwards it flies 26 m/s.
    assert track.v_ned_target_mps is not None
    assert track.v_ned_target_mps[0] == pytest.approx(26.0, abs=12.0)


def test_an_error_that_all_frames_share_stays_in_the_covariance_at_any_frame_rate() -> None:
    stds = {rate: range_std(follow(np.full(round(4 * rate), 0.1), rate, True)[-1][0]) for rate in (5.0, 60.0)}
    for std in stds.values():
        assert 0.8 * LOG_RANGE_STD < std < 1.3 * LOG_RANGE_STD
    assert stds[5.0] == pytest.approx(stds[60.0], rel=0.2)


def test_one_frame_that_is_too_sure_of_itself_makes_no_range_sure() -> None:
    scale = RangeScale.begin(0, 5.0, LOG_RANGE_STD**2)
    common = []
    for frame in range(1, 121):
        told_std = LOG_RANGE_STD if frame < 30 else 0.1 * LOG_RANGE_STD
        scale = scale.seen(frame * 33_000_000, 5.0, told_std**2, 5.0, (0.0, 0.0))
        common.append(scale.common_variance)
    assert common[29] > 0.9 * common[28], "that of one frame"
    assert common[119] < 0.1 * common[28], "that of three seconds"


def test_where_frames_disagree_more_than_the_network_says_the_track_is_less_sure() -> None:
    rng = np.random.default_rng(4)
    calm, torn = (range_std(follow(rng.normal(scale=scale, size=90), 30.0, True)[-1][0]) for scale in (0.03, 0.2))
    assert torn > 2.5 * calm


@pytest.mark.parametrize("own_ship_known", [True, False], ids=["ned", "cam"])
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_another_size_given_in_flight_holds_from_the_next_detection_and_is_no_speed(
    factor: float, own_ship_known: bool
) -> None:
    errors = np.random.default_rng(2).normal(scale=0.02, size=120)
    errors[:60] += np.log(factor)
    flown = follow(errors, 30.0, own_ship_known, missed=range(60, 62), resized=60)
    assert min(range_std(track) for track, _ in flown[60:62]) > 0.5, "missed, it is at no range that is known"
    for track, truth in flown[62:]:
        assert track.state is TrackState.CONFIRMED
        assert np.linalg.norm(track.t_cam_target_m) == pytest.approx(np.linalg.norm(truth), rel=0.1)
        if own_ship_known:
            assert track.v_ned_target_mps is not None
            assert track.covariance_ned is not None
            off_mps = track.v_ned_target_mps - [26.0, 4.0, 0.0]
            assert off_mps @ np.linalg.solve(track.covariance_ned[3:6, 3:6], off_mps) < 11.3
    if own_ship_known:
        assert track.covariance_ned is not None
        assert np.sqrt(np.diag(track.covariance_ned)[3:5]).max() < 20.0, "from two seconds, it is known again"
