"""The tracker's parts by themselves: rotations one at a time, and who belongs to whom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from edge.estimator.lens import Lens
from edge.tracking import so3
from edge.tracking.association import best_pairs
from edge.tracking.boxes import BoxModel
from edge.tracking.doubles import TURNS_MIN, Doubles
from edge.tracking.merged import less_sure, shown_at_once
from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, OwnShip, TrackState

component = st.floats(-1.0, 1.0)
K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 540.0], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
LOOKING_NORTH = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))


@settings(deadline=None)
@given(st.tuples(component, component, component), st.floats(0.0, np.pi) | st.floats(0.0, 1e-3))
def test_exp_and_log_are_those_of_scipy(axis: tuple[float, ...], angle: float) -> None:
    w = np.array(axis)
    norm = np.linalg.norm(w)
    w = angle * w / norm if norm > 1e-3 else np.array([0.0, 0.0, angle])
    R = so3.exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
    assert np.linalg.norm(so3.log(R)) <= np.pi + 1e-9
    np.testing.assert_allclose(so3.exp(so3.log(R)), R, atol=1e-9)
    np.testing.assert_allclose(so3.skew(w) @ [1.0, 2.0, 3.0], np.cross(w, [1.0, 2.0, 3.0]), atol=1e-12)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5))
def test_pairs_are_the_cheapest_of_the_most(seed: int, targets: int, estimates: int) -> None:
    """Against SciPy's assignment, in which an impossible pair costs more than all others together."""
    rng = np.random.default_rng(seed)
    cost = np.where(rng.random((targets, estimates)) < 0.4, np.inf, rng.uniform(0.0, 50.0, (targets, estimates)))
    pairs = best_pairs(cost)
    filled = np.where(np.isinf(cost), 1e4, cost)
    best = filled[linear_sum_assignment(filled)]
    assert len(pairs) == np.sum(best < 1e4)
    assert sum(cost[i, j] for i, j in pairs) == pytest.approx(best[best < 1e4].sum())
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)


def sight(rng: np.random.Generator, t_m: np.ndarray, R_cam_target: np.ndarray) -> Estimate:
    noise_m = rng.normal(size=3) * [0.2, 0.2, 0.03 * t_m[2]]
    R = Rotation.from_rotvec(rng.normal(scale=0.08, size=3)).as_matrix() @ R_cam_target
    center = (K @ t_m)[:2] / t_m[2]
    covariance = np.diag([0.04, 0.04, (0.03 * t_m[2]) ** 2, 0.0064, 0.0064, 0.0064])
    return Estimate(0.9, np.concatenate([center - 35, center + 35]), R, t_m + noise_m, covariance, "track")


@pytest.mark.parametrize("seed", range(3))
def test_two_that_cross_keep_their_numbers_though_one_hides_the_other(seed: int) -> None:
    """At nearly one range, seen from the side, opposite ways; while they overlap only the nearer one is seen."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(4, LOOKING_NORTH)
    east, west = (Rotation.from_euler("z", yaw, degrees=True).as_matrix() for yaw in (70, -110))
    R_cam_ned = LOOKING_NORTH.R_body_cam.T
    number = {}
    for i in range(90):
        t = i / 30.0
        places = {"east": np.array([-37.5 + 25 * t, 1.0, 200.0]), "west": np.array([37.5 - 25 * t, -1.0, 212.0])}
        both = [sight(rng, places["east"], R_cam_ned @ east), sight(rng, places["west"], R_cam_ned @ west)]
        hidden = abs(places["east"][0] - places["west"][0]) < 3.5
        own = OwnShip(1 + round(t * 1e9), np.eye(3), np.zeros(3), np.zeros(3), None)
        tracks = tracker.update(own.time_ns, both[:1] if hidden else both[:: 1 if i % 2 else -1], own, K, SIZE_WH)
        if i in (30, 89):
            assert len(tracks) == 2
            for name, place in places.items():
                nearest = min(tracks, key=lambda one: float(np.linalg.norm(one.t_cam_target_m - place)))
                assert number.setdefault(name, nearest.track_id) == nearest.track_id
    assert number["east"] != number["west"]


OWN_SHIPS = {
    "ned": OwnShip(1, np.eye(3), np.zeros(3), np.zeros(3), None),
    "ned_relative": OwnShip(1, np.eye(3), None, None, None),
    "cam": None,
}
NORTH_EAST = LOOKING_NORTH.R_body_cam.T @ Rotation.from_euler("z", 70, degrees=True).as_matrix()


def tracked(kind: str, seen: Callable[[float], list[np.ndarray]], until_s: float) -> list[tuple[float, int]]:
    """At each frame the time, s, and how many tracks there are of what is seen at these places [3] in `cam`."""
    rng, tracker, counts = np.random.default_rng(0), Tracker(4, LOOKING_NORTH), []
    for i in range(round(30 * until_s)):
        own, time_ns = OWN_SHIPS[kind], 1 + round(i * 1e9 / 30)
        own = own and replace(own, time_ns=time_ns)
        tracks = tracker.update(time_ns, [sight(rng, place, NORTH_EAST) for place in seen(i / 30)], own, K, SIZE_WH)
        counts.append((i / 30, len(tracks)))
    return counts


@pytest.mark.parametrize(("kind", "apart_m"), [("cam", 8.0), ("ned", 8.0), ("ned", 4.0), ("ned_relative", 8.0)])
def test_of_two_side_by_side_the_one_that_goes_is_soon_lost(kind: str, apart_m: float) -> None:
    stays, goes = np.array([0.0, 0.0, 200.0]), np.array([apart_m, 0.0, 204.0])
    counts = tracked(kind, lambda t: [stays, goes] if t < 2.0 else [stays], 7.0)
    assert {count for t, count in counts if 0.5 < t < 2.0} == {2}
    assert {count for t, count in counts if t > 5.0} == {1}


def test_of_three_side_by_side_of_whom_one_or_other_is_missed_in_each_frame_none_is_dropped() -> None:
    three = [np.array([8.0 * i, 0.0, 200.0 + 4.0 * i]) for i in range(3)]

    def seen(t: float) -> list[np.ndarray]:
        return [place for i, place in enumerate(three) if t < 1.0 or i != round(30 * t) % 3]

    assert {count for t, count in tracked("cam", seen, 9.0) if t > 0.5} == {3}


@pytest.mark.parametrize("seed", range(4))
def test_two_that_are_often_missed_at_few_frames_a_second_are_two(seed: int) -> None:
    missed = np.random.default_rng(seed).random((90, 2)) < 0.5
    missed[:6] = False
    rng, tracker = np.random.default_rng(0), Tracker(4, LOOKING_NORTH)
    for i in range(90):
        places = [np.array([8.0 * k, 0.0, 200.0]) for k in range(2) if not missed[i, k]]
        seen = [sight(rng, place, NORTH_EAST) for place in places]
        tracks = tracker.update(1 + i * 200_000_000, seen, None, K, SIZE_WH)
        assert len([track for track in tracks if track.measured_ns == track.time_ns]) == len(places)


@pytest.mark.parametrize(("chosen_id", "stays"), [(None, 0), (0, 0), (1, 1)])
def test_of_two_targets_that_are_one_aircraft_the_older_stays_unless_the_other_is_chosen(
    chosen_id: int | None, stays: int
) -> None:
    """It is seen here and there by turns, at places that each had a target of its own before."""
    rng, tracker, frames = np.random.default_rng(0), Tracker(4, LOOKING_NORTH), []
    here, there = np.array([0.0, 0.0, 200.0]), np.array([8.0, 0.0, 200.0])
    for i in range(150):
        places = [here] if i < 10 else [here, there] if i < 60 else [(here, there)[i // 15 % 2]]
        seen = [sight(rng, place, NORTH_EAST) for place in places]
        tracks = tracker.update(1 + round(i * 1e9 / 30), seen, None, K, SIZE_WH, (), chosen_id)
        frames.append([track.track_id for track in tracks])
    assert frames[10:120] == [[0, 1]] * 110
    assert next(tracked for tracked in frames[120:] if len(tracked) < 2) == [stays]


def test_two_that_take_turns_for_very_long_at_few_frames_a_second_are_one_at_last() -> None:
    doubles, found = Doubles(), []
    for second in range(30):
        one, other = ((0, 1), (1, 5)) if second % 2 else ((1, 5), (0, 1))
        found.append(doubles.among({one}, [(one, other)], second * 10**9))
    assert not any(found[: TURNS_MIN - 1])
    assert all(found[TURNS_MIN - 1 :])
    assert doubles.among({(0, 1), (1, 5)}, [], 30 * 10**9) == []
    assert doubles.among({(0, 1)}, [((0, 1), (1, 5))], 31 * 10**9) == [], "both were seen at once"


@pytest.mark.parametrize(("pause_s", "one"), [(1.9, True), (2.1, False)])
def test_turns_taken_too_long_ago_are_no_sign_of_one_aircraft(pause_s: float, one: bool) -> None:
    doubles, pair = Doubles(), ((0, 1), (1, 5))
    for tenth in range(2 * TURNS_MIN + 1):
        found = doubles.among({pair[0]}, [pair], tenth * 10**8)
    assert found == [pair]
    assert doubles.among({pair[0]}, [pair], 4 * 10**9 + round(pause_s * 1e9)) == [pair] * one


@pytest.mark.parametrize(("share", "both"), [(0.3, True), (0.2, False)])
def test_a_detection_may_show_a_second_target_too_of_whose_box_it_covers_a_quarter(share: float, both: bool) -> None:
    estimate = sight(np.random.default_rng(0), np.array([0.0, 0.0, 200.0]), np.eye(3))
    first = estimate.box_xyxy_px
    second = first + np.tile([(1.0 - share) * (first[2] - first[0]), 0.0], 2)
    assert shown_at_once([estimate], [first, second], [False, False]) == ({0: [0, 1]} if both else {})


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_one_that_lies_between_two_is_less_sure_across_the_line_of_sight_alone(degrees: float) -> None:
    """Anywhere between them, evenly distributed; where they are says nothing against its range."""
    at_m = 200.0 * np.array([np.sin(np.deg2rad(degrees)), 0.0, np.cos(np.deg2rad(degrees))])
    estimate = replace(sight(np.random.default_rng(0), at_m, np.eye(3)), t_cam_target_m=at_m)
    boxes = [estimate.box_xyxy_px + np.tile([x_px, 0.0], 2) for x_px in (-20.0, 20.0)]
    left, right = (np.linalg.solve(K, [*(0.5 * (box[:2] + box[2:])), 1.0]) for box in boxes)
    apart_rad = np.arccos(left @ right / np.linalg.norm(left) / np.linalg.norm(right))
    added = less_sure(estimate, boxes, K).covariance - estimate.covariance
    assert added[:3, :3] @ at_m == pytest.approx(0.0, abs=1e-9)
    assert np.trace(added[:3, :3]) == pytest.approx((apart_rad * 200.0) ** 2 / 3.0, rel=0.001)
    assert not added[3:].any()


@pytest.mark.parametrize("knock_px", [80.0, 200.0])
def test_after_a_knock_of_the_camera_one_aircraft_is_one_target_again(knock_px: float) -> None:
    knock_m = np.array([knock_px * 200.0 / K[0, 0], 0.0, 0.0])
    counts = tracked("cam", lambda t: [np.array([0.0, 0.0, 200.0]) + knock_m * (t >= 2.0)], 7.0)
    assert {count for t, count in counts if t > 5.0} == {1}


def test_a_target_that_leaves_the_picture_is_not_looked_for_and_taken_up_again_when_it_is_back() -> None:
    rng = np.random.default_rng(1)
    tracker = Tracker(4, LOOKING_NORTH)
    R_cam_target = LOOKING_NORTH.R_body_cam.T @ Rotation.from_euler("z", 30, degrees=True).as_matrix()
    for i in range(90):
        t = i / 30.0
        yaw = np.deg2rad(40.0) * np.sin(np.pi * t / 3.0) ** 8  # the own ship turns away and back
        R_ned_body = Rotation.from_euler("z", yaw).as_matrix()
        R = (R_ned_body @ LOOKING_NORTH.R_body_cam).T
        t_cam = R @ np.array([200.0 + 5.0 * t, 0.0, 0.0])
        one = sight(rng, t_cam, R @ LOOKING_NORTH.R_body_cam @ R_cam_target)
        visible = bool(np.all(one.box_xyxy_px[:2] > 0) and np.all(one.box_xyxy_px[2:] < SIZE_WH))
        own = OwnShip(1 + round(t * 1e9), R_ned_body, np.zeros(3), np.zeros(3), None)
        expected = tracker.predict(own.time_ns, own, K, SIZE_WH)
        if i > 3 and abs(one.box_xyxy_px[0] + 35) > 60:
            assert bool(expected) == bool(one.box_xyxy_px[2] > 0)
        tracks = tracker.update(own.time_ns, [one] if visible else [], own, K, SIZE_WH)
        assert [track.track_id for track in tracks] == [0]
    assert tracks[0].state is TrackState.CONFIRMED


def test_in_cam_no_ned_pose_is_told() -> None:
    rng = np.random.default_rng(2)
    tracker = Tracker(4, LOOKING_NORTH)
    estimate = sight(rng, np.array([0.0, 0.0, 200.0]), np.eye(3))
    for i in range(4):
        (track,) = tracker.update(i + 1, [replace(estimate, score=0.8)], None, K, SIZE_WH)
        told = (track.R_ned_target, track.t_ned_target_m, track.v_ned_target_mps, track.covariance_ned)
        assert all(one is None for one in told)


WIDE_K = np.array([[1000.0, 0.0, 959.5], [0.0, 1000.0, 539.5], [0.0, 0.0, 1.0]])
BARREL = (-0.3, 0.1, 0.001, -0.001, -0.015)
FOLDING = (-0.3, 0.0, 0.0, 0.0)  # shows nothing farther than 46 degrees off the axis
HALF_SPAN_M = np.array([[-6.0, 0.0, 0.0], [0.0, -2.0, 0.0], [6.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


def seen_through(distortion: tuple[float, ...], t_m: np.ndarray) -> np.ndarray:
    """The box [4] on the frame of a target that is spread out across the optical axis, by OpenCV."""
    points, _ = cv2.projectPoints(t_m + HALF_SPAN_M, np.zeros(3), np.zeros(3), WIDE_K, np.array(distortion))
    (left, _), (_, top), (right, _), (_, bottom) = points[:, 0]
    return np.array([left, top, right, bottom])


def off_axis(degrees: float, range_m: float = 200.0) -> np.ndarray:
    angle = np.deg2rad(degrees)
    return np.array([range_m * np.sin(angle), 20.0, range_m * np.cos(angle)])


def expected_after_a_turn(
    before_deg: float, after_deg: float, distortion: tuple[float, ...], box_xyxy_px: np.ndarray
) -> list[np.ndarray]:
    """Where a target is looked for that was seen `before_deg` off the axis, in that box, once the camera has turned."""
    tracker = Tracker(4, LOOKING_NORTH)
    covariance = np.diag([0.04, 0.04, 16.0, 0.0064, 0.0064, 0.0064])
    estimate = Estimate(0.9, box_xyxy_px, np.eye(3), off_axis(before_deg), covariance, "track")
    own = OwnShip(1, np.eye(3), np.zeros(3), np.zeros(3), None)
    (track,) = tracker.update(own.time_ns, [estimate], own, WIDE_K, SIZE_WH, distortion)
    assert np.isfinite(track.box_xyxy_px).all()
    R_ned_body = Rotation.from_euler("z", before_deg - after_deg, degrees=True).as_matrix()
    turned = replace(own, time_ns=40_000_000, R_ned_body=R_ned_body)
    return [track.box_xyxy_px for track in tracker.predict(turned.time_ns, turned, WIDE_K, SIZE_WH, distortion)]


@given(st.tuples(st.floats(-40.0, 40.0), st.floats(-20.0, 20.0), st.floats(60.0, 500.0)))
def test_a_box_goes_and_grows_with_its_target_s_origin_though_that_is_not_its_middle(t_m: tuple[float, ...]) -> None:
    """As that of a flat thing which stands upright to the optical axis; the camera's pixels are not square."""
    lens = Lens(WIDE_K * [[1.0, 1.0, 1.0], [1.0, 1.3, 1.0], [1.0, 1.0, 1.0]], ())
    corners_m = np.array([[-2.0, -1.0, 0.0], [7.0, 3.0, 0.0]])

    def seen(at_m: np.ndarray) -> np.ndarray:
        points = (corners_m + at_m) @ lens.K.T
        return np.ravel(points[:, :2] / points[:, 2:])

    before_m = np.array([10.0, -5.0, 200.0])
    box = BoxModel.measured(seen(before_m), before_m, lens)
    np.testing.assert_allclose(box.box_xyxy_px(np.array(t_m), lens), seen(np.array(t_m)), atol=1e-6)


@pytest.mark.parametrize(("before_deg", "after_deg"), [(35, 25), (35, 5), (30, -30), (0, 40)])
def test_a_target_is_looked_for_where_the_lens_shows_it(before_deg: float, after_deg: float) -> None:
    """It stands still and the camera turns; without the lens the box is off by its own width."""
    seen = seen_through(BARREL, off_axis(before_deg))
    (box,) = expected_after_a_turn(before_deg, after_deg, BARREL, seen)
    np.testing.assert_allclose(box, seen_through(BARREL, off_axis(after_deg)), atol=1.0)


def test_a_target_that_the_lens_does_not_show_is_not_looked_for() -> None:
    """60 degrees off the axis the lens's polynomial has folded back into the picture."""
    assert np.all(seen_through(FOLDING, off_axis(60)) < [*SIZE_WH, *SIZE_WH])
    assert expected_after_a_turn(30, 60, FOLDING, seen_through(FOLDING, off_axis(30))) == []


@pytest.mark.parametrize("right_px", [1700.0, 1750.0, 1919.5])
def test_a_box_that_reaches_where_the_lens_cannot_be_inverted_is_remembered_where_its_target_is(
    right_px: float,
) -> None:
    """44 degrees off the axis, where the picture ends at column 1662 and the box is told too large."""
    told = seen_through(FOLDING, off_axis(44))
    told[2] = right_px
    (box,) = expected_after_a_turn(44, 20, FOLDING, told)
    center = 0.5 * (box[:2] + box[2:])
    true = seen_through(FOLDING, off_axis(20))
    assert np.all(np.abs(center - 0.5 * (true[:2] + true[2:])) < 0.5 * (true[2:] - true[:2]))
    assert np.all(box[2:] - box[:2] < 2.0 * (told[2:] - told[:2]))
