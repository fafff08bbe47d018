"""The tracker against simulated flights whose noise is known: a turning target, seen from a turning own ship."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.links.outgoing import rotation_known
from edge.tracking.heading import reversal
from edge.tracking.rotation import ODD_FRAMES
from edge.tracking.tracker import COAST_MAX_S, Tracker
from edge.types import Estimate, OwnShip, TrackState
from msgs.geometry import rotation_angle

from .noisy_flights import BIAS_SHARE, FORWARD, RATE_HZ, SIZE_WH, K, box_at, flight, known, predict, update


@pytest.mark.parametrize("kind", ["ned", "ned_relative", "cam"])
@pytest.mark.parametrize(("bias_share", "at_most"), [(BIAS_SHARE, 1.05), (0.0, 0.9)], ids=["biased", "white"])
def test_tracks_are_better_than_single_frames_and_know_how_good_they_are(
    kind: str, bias_share: float, at_most: float
) -> None:
    """A bias cannot be averaged away: of these errors there is nothing to win, of white ones there is."""
    m2, raw_m2, rad2, raw_rad2, nees = [], [], [], [], []
    for seed in range(4):
        tracker = Tracker(4, FORWARD)
        for i, now in enumerate(flight(seed, frames=120, bias_share=bias_share)):
            (track,) = update(tracker, now, kind)
            if i < RATE_HZ:
                continue
            error_m = track.t_cam_target_m - now.t_cam_target_m
            error_rad = Rotation.from_matrix(now.R_cam_target @ track.R_cam_target.T).as_rotvec()
            raw_m = now.estimate.t_cam_target_m - now.t_cam_target_m
            m2.append(error_m @ error_m)
            raw_m2.append(raw_m @ raw_m)
            rad2.append(error_rad @ error_rad)
            raw_rad2.append(float(rotation_angle(now.estimate.R_cam_target, now.R_cam_target)) ** 2)
            nees.append(
                [
                    error_m @ np.linalg.solve(track.covariance[:3, :3], error_m),
                    error_rad @ np.linalg.solve(track.covariance[3:, 3:], error_rad),
                ]
            )
    assert np.sqrt(np.mean(m2) / np.mean(raw_m2)) < at_most
    assert np.sqrt(np.mean(rad2) / np.mean(raw_rad2)) < 0.7
    # Three degrees of freedom each: 3 is consistent, less is cautious, more overconfident.
    assert np.all(np.mean(nees, axis=0) < 4.5)
    if bias_share:
        assert np.all(np.mean(nees, axis=0) > 0.5)


@pytest.mark.parametrize(("kind", "tolerance_px"), [("ned", 4.0), ("ned_relative", 4.0), ("cam", 12.0)])
def test_the_box_is_predicted_while_the_own_ship_turns(kind: str, tolerance_px: float) -> None:
    tracker = Tracker(4, FORWARD)
    errors_px = []
    for i, now in enumerate(flight(5)):
        expected = predict(tracker, now, kind)
        if i > 10:
            errors_px.append(np.abs(expected[0].box_xyxy_px - now.box_xyxy_px).max())
        update(tracker, now, kind)
    assert np.percentile(errors_px, 95) < tolerance_px


def test_with_own_attitude_a_target_missed_for_a_second_is_still_where_it_is_looked_for() -> None:
    tracker = Tracker(4, FORWARD)
    for i, now in enumerate(flight(6)):
        if 90 <= i < 120:
            (expected,) = predict(tracker, now, "ned")
            (track,) = update(tracker, now, "ned", [])
            assert track.state is TrackState.COASTING
            # Within the box's own length: a search window around it holds the target.
            assert np.abs(expected.box_xyxy_px - now.box_xyxy_px).max() < now.box_xyxy_px[2] - now.box_xyxy_px[0]
        else:
            update(tracker, now, "ned")


@pytest.mark.parametrize("jitter_rad", [0.0, 2e-3])
def test_an_attitude_that_jitters_costs_no_bearing_in_the_frame_that_saw_the_target(jitter_rad: float) -> None:
    """The picture tells where the target is in the picture, whatever the autopilot says the camera's attitude is."""
    rng = np.random.default_rng(5)
    tracker = Tracker(1, FORWARD)
    off_px: dict[str, list[float]] = {"frames": [], "track": []}
    for now in flight(5):
        jitter = Rotation.from_rotvec(rng.normal(scale=jitter_rad, size=3)).as_matrix()
        told = replace(now.own_ship, R_ned_body=jitter @ now.own_ship.R_ned_body)
        (track,) = tracker.update(now.time_ns, [now.estimate], told, K, SIZE_WH)
        for name, t_cam_m in (("frames", now.estimate.t_cam_target_m), ("track", track.t_cam_target_m)):
            true_px, px = ((K @ t)[:2] / t[2] for t in (now.t_cam_target_m, t_cam_m))
            off_px[name].append(float(np.linalg.norm(px - true_px)))
    frames_px, track_px = (np.mean(off_px[name][30:]) for name in ("frames", "track"))
    assert track_px < frames_px


def test_velocity_in_ned_is_the_targets_own() -> None:
    tracker = Tracker(4, FORWARD)
    errors_mps = []
    for i, now in enumerate(flight(7)):
        (track,) = update(tracker, now, "ned")
        assert track.v_ned_target_mps is not None
        if i > 120:
            errors_mps.append(np.linalg.norm(track.v_ned_target_mps - now.v_ned_target_mps))
    assert np.median(errors_mps) < 8.0


def test_a_track_lives_through_gaining_and_losing_own_attitude_and_position() -> None:
    tracker = Tracker(4, FORWARD)
    kinds = ["cam", "ned", "ned_relative", "ned", "cam", "ned_relative", "cam"]
    for i, now in enumerate(flight(8, frames=20 * len(kinds))):
        kind = kinds[i // 20]
        (track,) = update(tracker, now, kind)
        assert track.track_id == 0
        assert (track.R_ned_target is None) == (kind == "cam")
        if i > 10:
            assert track.state is TrackState.CONFIRMED
            assert np.linalg.norm(track.t_cam_target_m - now.t_cam_target_m) < 60.0
            across = (track.t_cam_target_m / track.t_cam_target_m[2] - now.t_cam_target_m / now.t_cam_target_m[2])[:2]
            assert np.abs(across).max() * K[0, 0] < 25.0


@pytest.mark.parametrize(("score", "doubtful_below", "proof"), [(0.9, 0.8, 3), (0.96, 0.8, 2), (0.96, 0.0, 3)])
def test_states_follow_what_is_seen(score: float, doubtful_below: float, proof: int) -> None:
    """Scores that are no probabilities, without a limit of doubt, prove nothing sooner."""
    tracker = Tracker(4, FORWARD)
    states = []
    lost_at_ns = None
    last_seen_ns = 0
    for i, now in enumerate(flight(9, frames=120)):
        seen_now = [replace(now.estimate, score=score)] if i < 10 else []
        tracks = tracker.update(now.time_ns, seen_now, now.own_ship, K, SIZE_WH, doubtful_below=doubtful_below)
        states.append(tracks[0].state if tracks else None)
        last_seen_ns = now.time_ns if i < 10 else last_seen_ns
        if not tracks and lost_at_ns is None:
            lost_at_ns = now.time_ns
    assert states[:10] == [TrackState.TENTATIVE] * (proof - 1) + [TrackState.CONFIRMED] * (11 - proof)
    assert states[10] is TrackState.COASTING
    assert lost_at_ns is not None
    assert COAST_MAX_S < (lost_at_ns - last_seen_ns) / 1e9 < COAST_MAX_S + 0.1


@pytest.mark.parametrize("scores", [(0.99, 0.6), (0.6, 0.99), (0.94, 0.94)])
def test_two_sights_of_which_one_is_unsure_prove_no_target(scores: tuple[float, float]) -> None:
    tracker = Tracker(4, FORWARD)
    for now, score in zip(flight(9, frames=2), scores, strict=True):
        seen_now = [replace(now.estimate, score=score)]
        (track,) = tracker.update(now.time_ns, seen_now, now.own_ship, K, SIZE_WH, doubtful_below=0.8)
        assert track.state is TrackState.TENTATIVE


@pytest.mark.parametrize("kind", ["ned", "cam"])
@pytest.mark.parametrize("gap_s", [3.0, 10.0, 60.0])
def test_after_a_gap_in_the_frames_what_is_seen_is_a_new_target(kind: str, gap_s: float) -> None:
    tracker = Tracker(4, FORWARD)
    for now in flight(9, frames=60):
        update(tracker, now, kind)
    gap_ns = round(gap_s * 1e9)
    later = replace(
        now,
        time_ns=now.time_ns + gap_ns,
        own_ship=replace(now.own_ship, time_ns=now.own_ship.time_ns + gap_ns),
        estimate=replace(now.estimate, t_cam_target_m=now.t_cam_target_m + np.array([-60.0, -30.0, 120.0])),
    )
    assert predict(tracker, later, kind) == []
    (track,) = update(tracker, later, kind)
    assert track.state is TrackState.TENTATIVE
    np.testing.assert_allclose(track.t_cam_target_m, later.estimate.t_cam_target_m, atol=1e-6)


def test_uncertainty_grows_while_coasting() -> None:
    tracker = Tracker(4, FORWARD)
    sizes = [
        np.linalg.det(update(tracker, now, "ned", None if i < 30 else [])[0].covariance[:3, :3])
        for i, now in enumerate(flight(10, frames=60))
    ]
    assert np.all(np.diff(sizes[30:]) > 0)


@pytest.mark.parametrize(
    ("scores", "least", "most"),
    [
        ([0.99] * 90, 0.98, 1.0),
        ([0.95, 0.35] * 45, 0.6, 0.7),
        ([0.95] * 3 + [0.4] * 87, 0.4, 0.5),
        ([0.95] * 60 + [0.4] * 30, 0.59, 0.62),
        ([0.9, 0.3, 0.6], 0.599, 0.601),
    ],
)
def test_a_tracks_score_is_that_of_its_recent_frames(scores: list[float], least: float, most: float) -> None:
    tracker = Tracker(4, FORWARD)
    for now, score in zip(flight(10, frames=len(scores)), scores, strict=True):
        (track,) = update(tracker, now, "ned", [replace(now.estimate, score=score)])
    assert least <= track.score <= most


def test_what_is_not_confirmed_outlives_one_miss_and_not_two_in_a_row() -> None:
    tracker, (first, missed, second, *last) = Tracker(4, FORWARD), flight(11, frames=5)
    counts = [len(update(tracker, now, "ned", seen)) for now, seen in ((first, None), (missed, []), (second, None))]
    assert counts == [1, 1, 1]
    assert [len(update(tracker, now, "ned", [])) for now in last] == [1, 0]


def test_one_false_detection_never_becomes_a_track() -> None:
    tracker = Tracker(4, FORWARD)
    for i, now in enumerate(flight(11, frames=30)):
        tracks = update(tracker, now, "ned", None if i == 0 else [])
    assert tracks == ()


@pytest.mark.parametrize("kind", ["ned", "ned_relative", "cam"])
@settings(max_examples=20, deadline=None)
@given(steps_ns=st.lists(st.sampled_from([1, 40, 20_000, 900_000, 1_000_000, 33_333_333]), min_size=30, max_size=60))
def test_stamps_however_close_keep_every_track_finite(kind: str, steps_ns: list[int]) -> None:
    tracker = Tracker(4, FORWARD)
    for now, time_ns in zip(flight(12, frames=len(steps_ns)), np.cumsum(steps_ns).tolist(), strict=True):
        for track in update(tracker, replace(now, time_ns=time_ns), kind):
            assert np.all(np.isfinite(track.t_cam_target_m))
            assert np.all(np.linalg.eigvalsh(track.covariance) > 0.0)


def test_a_rotation_turned_over_once_is_ignored_and_one_that_stays_is_believed() -> None:
    tracker = Tracker(4, FORWARD)
    about_nose = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    for i, now in enumerate(flight(13, frames=60 + ODD_FRAMES)):
        truth = now.R_cam_target
        estimate = now.estimate
        if i == 40 or i >= 60:
            truth, estimate = truth @ about_nose, replace(estimate, R_cam_target=estimate.R_cam_target @ about_nose)
        (track,) = update(tracker, now, "ned", [estimate])
        if 20 < i < 60 or i == 65:
            assert rotation_angle(track.R_cam_target, truth if i == 65 else now.R_cam_target) < np.deg2rad(25.0)


def test_the_way_it_flies_settles_which_end_is_the_nose() -> None:
    """Every single frame tells the depth reversal; once the track's velocity is sure, its rotation is right."""
    tracker = Tracker(4, FORWARD)
    for i, now in enumerate(flight(21, frames=150)):
        along = now.t_cam_target_m / np.linalg.norm(now.t_cam_target_m)
        turned = replace(now.estimate, R_cam_target=reversal(now.estimate.R_cam_target, along))
        (track,) = update(tracker, now, "ned", [turned])
        if i == 2:
            assert rotation_angle(track.R_cam_target, now.R_cam_target) > np.deg2rad(90.0)
    assert rotation_angle(track.R_cam_target, now.R_cam_target) < np.deg2rad(15.0)


@pytest.mark.parametrize(("kind", "seen"), [("ned", True), ("ned_relative", True), ("cam", False)])
def test_a_target_that_flies_tail_first_has_no_known_rotation_and_where_it_does_not_nothing_is_doubted(
    kind: str, seen: bool
) -> None:
    """As a network takes a canard whose like it has never seen, in every frame. In `cam` nothing tells of it."""
    half_turn = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    for confused in (False, True):
        tracker, told = Tracker(4, FORWARD), []
        for now in flight(21, frames=150):
            R = now.estimate.R_cam_target @ (half_turn if confused else np.eye(3))
            (track,) = update(tracker, now, kind, [replace(now.estimate, R_cam_target=R)])
            told.append(rotation_known(track))
        share = np.mean(told[60:])
        assert share < 0.1 if confused and seen else share == 1.0


def test_in_cam_a_rotation_that_turns_over_again_and_again_is_told_as_unsure_about_that_axis() -> None:
    """Nothing but the pictures tells towards from away there; once they agree again, it is sure again."""
    tracker = Tracker(4, FORWARD)
    stds_rad = []
    for i, now in enumerate(flight(19, frames=200)):
        estimate = now.estimate
        if 40 <= i < 100 and i % 2:
            along = now.t_cam_target_m / np.linalg.norm(now.t_cam_target_m)
            estimate = replace(estimate, R_cam_target=reversal(estimate.R_cam_target, along))
        (track,) = update(tracker, now, "cam", [estimate])
        in_target = track.R_cam_target.T @ track.covariance[3:, 3:] @ track.R_cam_target
        stds_rad.append(np.sqrt(np.diag(in_target)))
    sure, torn, sure_again = stds_rad[39], stds_rad[99], stds_rad[199]
    # Either way round with about equal chance: the error is nearly pi half of the time.
    assert torn[2] > 0.3 * np.pi
    assert torn[2] > 2 * max(torn[:2])
    assert sure_again[2] < 0.5 * torn[2]
    assert sure[2] < 0.5 * torn[2]


def test_a_range_that_stays_elsewhere_is_believed_without_a_new_number() -> None:
    tracker = Tracker(4, FORWARD)
    for i, now in enumerate(flight(14, frames=60)):
        far = 2.5 if i >= 40 else 1.0
        (track,) = update(
            tracker, now, "ned", [replace(now.estimate, t_cam_target_m=far * now.estimate.t_cam_target_m)]
        )
    assert track.track_id == 0
    assert track.t_cam_target_m[2] == pytest.approx(2.5 * now.t_cam_target_m[2], rel=0.2)


def test_two_targets_keep_their_numbers_when_estimates_change_places() -> None:
    tracker = Tracker(4, FORWARD)
    ids = set()
    for i, (a, b) in enumerate(zip(flight(15), flight(16, offset_ned_m=(40.0, 30.0, -10.0)), strict=True)):
        pair = [a.estimate, b.estimate] if i % 2 else [b.estimate, a.estimate]
        tracks = update(tracker, a, "ned", pair)
        assert len(tracks) == 2
        nearest = [int(np.argmin([np.linalg.norm(t.box_xyxy_px - now.box_xyxy_px) for t in tracks])) for now in (a, b)]
        ids.add(tuple(tracks[k].track_id for k in nearest))
    assert len(ids) == 1


def test_one_target_seen_by_two_windows_is_one_track_and_no_more_targets_than_allowed() -> None:
    tracker = Tracker(2, FORWARD)
    for now in flight(17, frames=10):
        twice = [now.estimate, replace(now.estimate, score=0.5)]
        elsewhere = [
            replace(now.estimate, box_xyxy_px=now.estimate.box_xyxy_px + 100 * k, t_cam_target_m=t)
            for k, t in ((1, np.array([-50.0, -20.0, 300.0])), (2, np.array([60.0, 30.0, 300.0])))
        ]
        tracks = update(tracker, now, "ned", twice + elsewhere)
    assert [track.track_id for track in tracks] == [0, 1]


def test_an_estimate_that_is_not_finite_is_dropped_and_counted() -> None:
    tracker = Tracker(4, FORWARD)
    for now in flight(18, frames=5):
        tracks = update(tracker, now, "ned", [now.estimate, replace(now.estimate, t_cam_target_m=np.full(3, np.nan))])
    assert len(tracks) == 1
    assert tracker.not_finite == 5


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    plan=st.lists(
        st.tuples(
            st.sampled_from(["ned", "ned_relative", "cam"]),
            st.integers(1, 400),  # ms since the last frame
            st.booleans(),  # whether the target is seen
            st.floats(-9.0, 3.0),  # log10 of the covariance's scale
        ),
        min_size=3,
        max_size=25,
    ),
)
def test_covariances_stay_symmetric_positive_semi_definite(seed: int, plan: list[tuple[str, int, bool, float]]) -> None:
    rng = np.random.default_rng(seed)
    tracker = Tracker(4, FORWARD)
    time_ns = 1
    for kind, step_ms, visible, scale in plan:
        time_ns += step_ms * 1_000_000
        own = OwnShip(
            time_ns, Rotation.random(rng=rng).as_matrix(), 500 * rng.normal(size=3), 30 * rng.normal(size=3), None
        )
        factor = rng.normal(size=(6, 6))
        t_cam = np.array([20.0 * rng.normal(), 20.0 * rng.normal(), 100 + 400 * rng.random()])
        R = Rotation.random(rng=rng).as_matrix()
        estimate = Estimate(0.9, box_at(t_cam), R, t_cam, 10.0**scale * factor @ factor.T, "acquire")
        for track in tracker.update(time_ns, [estimate] if visible else [], known(kind, own), K, SIZE_WH):
            for P in (track.covariance, track.covariance_ned):
                if P is not None:
                    assert np.all(np.isfinite(P))
                    np.testing.assert_array_equal(P, P.T)
                    assert np.linalg.eigvalsh(P)[0] >= -1e-9 * np.trace(P)
            np.testing.assert_allclose(track.R_cam_target @ track.R_cam_target.T, np.eye(3), atol=1e-9)
