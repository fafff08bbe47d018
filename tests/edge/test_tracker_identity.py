"""Who is who: what is seen after a target was missed, beside one that went, and where there is no free slot."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.tracking.tracker import Tracker
from edge.types import Array, Estimate, Mount, OwnShip, Track, TrackState
from msgs.geometry import rotation_angle

from .noisy_flights import SIZE_WH, K, known, seen

LOOKING_NORTH = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
R_CAM_TARGET = LOOKING_NORTH.R_body_cam.T
TURNED = R_CAM_TARGET @ np.diag([-1.0, -1.0, 1.0])  # flying the other way


class Flight:
    """Frames of a camera that stands still, at 30 a second unless told otherwise."""

    def __init__(self, kind: str, max_targets: int = 4, rate_hz: float = 30.0) -> None:
        self.kind, self.rate_hz = kind, rate_hz
        self.tracker, self.rng, self.frames = Tracker(max_targets, LOOKING_NORTH), np.random.default_rng(0), 0

    def sight(self, t_m: Array, score: float = 0.95, R_cam_target: Array = R_CAM_TARGET) -> Estimate:
        return replace(seen(self.rng, t_m, R_cam_target, 0.0), score=score)

    def frame(self, *sights: Estimate, chosen_id: int | None = None, doubtful_below: float = 0.0) -> tuple[Track, ...]:
        time_ns = 1 + round(self.frames * 1e9 / self.rate_hz)
        self.frames += 1
        own = known(self.kind, OwnShip(time_ns, np.eye(3), np.zeros(3), np.zeros(3), None))
        return self.tracker.update(time_ns, list(sights), own, K, SIZE_WH, (), chosen_id, doubtful_below)


def towards(degrees: float, range_m: float) -> Array:
    return range_m * np.array([np.sin(np.deg2rad(degrees)), 0.0, np.cos(np.deg2rad(degrees))])


@pytest.mark.parametrize("kind", ["cam", "ned_relative", "ned"])
@pytest.mark.parametrize(
    ("missed_s", "degrees", "range_m"),
    [(0.3, 10.0, 250.0), (0.5, 10.0, 300.0), (1.0, 20.0, 350.0), (1.5, 20.0, 150.0), (1.9, 25.0, 450.0)],
)
def test_another_aircraft_is_not_taken_for_one_that_was_missed(
    kind: str, missed_s: float, degrees: float, range_m: float
) -> None:
    flight = Flight(kind)
    for _ in range(60):
        flight.frame(flight.sight(towards(-5.0, 250.0)))
    for _ in range(round(missed_s * 30)):
        flight.frame()
    for count in range(1, 6):
        tracks = flight.frame(flight.sight(towards(degrees - 5.0, range_m), R_cam_target=TURNED))
        (told,) = (track for track in tracks if track.measured_ns == track.time_ns)
        assert told.track_id == 1
        assert (told.state is TrackState.TENTATIVE) == (count < 3)
        assert np.linalg.norm(told.t_cam_target_m) == pytest.approx(range_m, rel=0.02)


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 4.0])
def test_a_turning_camera_with_few_frames_a_second_keeps_what_it_sees_in_each(rate_hz: float) -> None:
    flight = Flight("cam", rate_hz=rate_hz)
    for index in range(30):
        turned_deg = 16.0 * np.sin(2.0 * np.pi * index / rate_hz / 5.0)  # at up to 20 degrees a second
        tracks = flight.frame(flight.sight(towards(turned_deg, 600.0)))
        assert [track.track_id for track in tracks if track.measured_ns == track.time_ns] == [0] or index < 4
    (seen,) = (track for track in tracks if track.measured_ns == track.time_ns)
    assert seen.state is TrackState.CONFIRMED


@pytest.mark.parametrize("kind", ["cam", "ned_relative", "ned"])
def test_of_two_seen_where_one_was_the_one_that_is_turned_like_it_is_taken_for_it(kind: str) -> None:
    """Another aircraft, which flies across its way, comes into sight nearer to where the first was expected."""
    flight, expected_m = Flight(kind), np.array([0.0, 0.0, 250.0])
    for _ in range(30):
        flight.frame(flight.sight(expected_m))
    across = R_CAM_TARGET @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    own, other = (replace(flight.sight(expected_m), t_cam_target_m=np.array([x_m, 0.0, 250.0])) for x_m in (-1.0, 0.8))
    tracks = flight.frame(replace(other, R_cam_target=across), own)
    (told,) = (track for track in tracks if track.track_id == 0)
    assert told.t_cam_target_m[0] < -0.1
    assert rotation_angle(told.R_cam_target, R_CAM_TARGET) < np.deg2rad(15.0)


@pytest.mark.parametrize("kind", ["ned_relative", "ned"])
def test_where_the_network_takes_each_of_two_for_turned_like_the_other_they_are_told_apart_by_place(kind: str) -> None:
    flight, places = Flight(kind), [np.array([-0.75, 0.0, 250.0]), np.array([0.75, 0.0, 250.0])]
    rotations = [R_CAM_TARGET, R_CAM_TARGET @ Rotation.from_euler("z", 90, degrees=True).as_matrix()]

    def sights(swapped: bool) -> list[Estimate]:
        turned = rotations[::-1] if swapped else rotations
        seen = [flight.sight(t_m, R_cam_target=R) for t_m, R in zip(places, turned, strict=True)]
        pixels = [np.tile([sign * 40.0, 0.0], 2) for sign in (-1.0, 1.0)]  # so that neither hides the other
        return [
            replace(one, t_cam_target_m=t_m, box_xyxy_px=one.box_xyxy_px + px)
            for one, t_m, px in zip(seen, places, pixels, strict=True)
        ]

    for _ in range(30):
        flight.frame(*sights(False))
    for _ in range(3):
        tracks = flight.frame(*sights(True))
        assert [np.sign(track.t_cam_target_m[0]) for track in tracks] == [-1.0, 1.0]
        assert [track.t_cam_target_m[0] for track in tracks] == pytest.approx([-0.75, 0.75], abs=0.2)


def test_only_what_is_seen_elsewhere_in_its_box_time_after_time_takes_a_target_s_place() -> None:
    """Six times in a row, and of several the likeliest."""
    flight = Flight("ned")
    here, far, farther = towards(0.0, 250.0), towards(0.0, 700.0), towards(0.0, 1_000.0)

    def elsewhere() -> tuple[Estimate, ...]:
        box = flight.sight(here).box_xyxy_px
        return tuple(replace(flight.sight(t_m, score), box_xyxy_px=box) for t_m, score in ((farther, 0.6), (far, 0.9)))

    def ranges_m(*sights: Estimate) -> list[float]:
        return [float(np.linalg.norm(track.t_cam_target_m)) for track in flight.frame(*sights)]

    for _ in range(30):
        flight.frame(flight.sight(here))
    for _ in range(3):
        for _ in range(5):
            assert ranges_m(*elsewhere()) == pytest.approx([250.0], rel=0.1)
        assert ranges_m(flight.sight(here)) == pytest.approx([250.0], rel=0.1)
    told = [ranges_m(*elsewhere()) for _ in range(6)]
    assert told[4] == pytest.approx([250.0], rel=0.1)
    assert told[5] == pytest.approx([700.0], rel=0.02)


def test_a_missed_target_is_not_moved_to_another_aircraft_for_which_there_is_no_slot() -> None:
    flight = Flight("ned", max_targets=1)
    for _ in range(30):
        flight.frame(flight.sight(towards(-5.0, 250.0)))
    for _ in range(30):
        (track,) = flight.frame(flight.sight(towards(10.0, 250.0)))
        assert track.t_cam_target_m == pytest.approx(towards(-5.0, 250.0), abs=10.0)
        assert track.state is TrackState.COASTING


@pytest.mark.parametrize("kind", ["cam", "ned_relative", "ned"])
@pytest.mark.parametrize(
    ("rate_hz", "apart_m"), [(3.0, 20.0), (3.0, 40.0), (5.0, 20.0), *product((10.0, 30.0), (8.0, 12.0, 20.0))]
)
def test_of_two_abreast_the_one_that_goes_takes_nothing_of_the_other(kind: str, rate_hz: float, apart_m: float) -> None:
    flight, stays, goes = Flight(kind, rate_hz=rate_hz), np.array([apart_m, 0.0, 250.0]), np.array([0.0, 0.0, 250.0])
    for _ in range(round(2 * rate_hz)):
        flight.frame(flight.sight(goes), flight.sight(stays), chosen_id=0)
    for _ in range(round(4 * rate_hz)):
        tracks = flight.frame(flight.sight(stays), chosen_id=0)
        assert [track.track_id for track in tracks if track.measured_ns == track.time_ns] == [1]
    assert [track.track_id for track in tracks] == [1]


@pytest.mark.parametrize(("missed_frames", "x_m", "is_id"), [(3, 0.0, 0), (5, 12.0, 1)])
def test_beside_one_that_went_what_is_seen_is_the_one_seen_shortly_before_and_later_the_nearer(
    missed_frames: int, x_m: float, is_id: int
) -> None:
    """Number 1 was last seen 12 m to the right, 1.3 s ago: turning as a camera may, it has been anywhere since."""
    flight = Flight("cam")
    stays, went = np.array([0.0, 0.0, 250.0]), np.array([12.0, 0.0, 250.0])
    for _ in range(60):
        flight.frame(flight.sight(stays), flight.sight(went))
    for _ in range(40 - missed_frames):
        flight.frame(flight.sight(stays))
    for _ in range(missed_frames):
        flight.frame()
    tracks = flight.frame(flight.sight(np.array([x_m, 0.0, 250.0])))
    assert [track.track_id for track in tracks if track.measured_ns == track.time_ns] == [is_id]


@pytest.mark.parametrize(
    ("score", "doubtful_below", "chosen_id", "held"),
    [
        (0.95, 0.8, None, [0.65, 0.95]),
        (0.75, 0.8, None, [0.6, 0.65]),
        (0.95, 0.0, None, [0.6, 0.65]),
        (0.95, 0.8, 1, [0.6, 0.95]),
    ],
    ids=["aircraft", "bird", "not calibrated", "selected"],
)
def test_birds_give_way_to_an_aircraft(
    score: float, doubtful_below: float, chosen_id: int | None, held: list[float]
) -> None:
    flight, birds = Flight("ned", max_targets=2), [towards(-8.0, 200.0), towards(8.0, 200.0)]
    for _ in range(10):
        flight.frame(flight.sight(birds[0], 0.65), flight.sight(birds[1], 0.6))
    last = [flight.sight(birds[0], 0.65), flight.sight(birds[1], 0.6)]
    tracks = flight.frame(
        *last, flight.sight(towards(0.0, 300.0), score), chosen_id=chosen_id, doubtful_below=doubtful_below
    )
    assert sorted(track.score for track in tracks) == pytest.approx(held)


@pytest.mark.parametrize(("chosen_id", "seen_ids"), [(None, [0]), (0, [])])
def test_without_own_attitude_a_slot_is_not_kept_for_what_could_be_anywhere(
    chosen_id: int | None, seen_ids: list[int]
) -> None:
    flight = Flight("cam", max_targets=1)
    for _ in range(30):
        flight.frame(flight.sight(towards(0.0, 250.0)))
    for _ in range(20):
        flight.frame()
    (kept,) = flight.frame(flight.sight(towards(15.0, 250.0), 0.6), doubtful_below=0.8)
    assert kept.born_ns == 1, "a bird takes the slot of no aircraft"
    tracks = flight.frame(flight.sight(towards(15.0, 250.0)), chosen_id=chosen_id, doubtful_below=0.8)
    assert [track.track_id for track in tracks if track.born_ns == track.time_ns] == seen_ids
    assert len(tracks) == 1


def test_what_is_pointed_at_keeps_the_slot_that_was_made_for_it() -> None:
    flight = Flight("ned", max_targets=2)
    for _ in range(10):
        flight.frame(flight.sight(towards(-8.0, 200.0)), flight.sight(towards(8.0, 200.0)))
    pointed_at, other = flight.sight(towards(0.0, 300.0), 0.6), flight.sight(towards(-15.0, 300.0), 0.9)
    flight.tracker.make_room(pointed_at)
    tracks = flight.frame(flight.sight(towards(-8.0, 200.0)), pointed_at, other, doubtful_below=0.8)
    assert sorted(track.score for track in tracks) == pytest.approx([0.6, 0.95])


@pytest.mark.parametrize(
    ("kind", "speed_mps"),
    [*product(("cam", "ned"), (3.0, 6.0, 12.0)), *product(("ned_relative",), (6.0, 12.0))],
)
def test_one_detection_of_two_aircraft_that_cross_is_taken_for_neither(kind: str, speed_mps: float) -> None:
    """Where their outlines overlap, the network finds one aircraft between them, as wide as both."""
    flight, nees = Flight(kind), []
    for index in range(-90, 91):
        way_m = speed_mps * index / flight.rate_hz
        truth = np.array([[way_m, -0.7, 250.0], [-way_m, 0.7, 250.0]])
        sights = [flight.sight(t_m) for t_m in truth]
        if abs(way_m) < 3.0:
            boxes = np.array([one.box_xyxy_px for one in sights])
            union = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
            sights = [replace(flight.sight(truth.mean(axis=0)), box_xyxy_px=union)]
        tracks = flight.frame(*sights)
        if index > -60:
            errors_m = [track.t_cam_target_m - truth[track.track_id] for track in tracks]
            nees += [
                error_m @ np.linalg.solve(track.covariance[:3, :3], error_m)
                for error_m, track in zip(errors_m, tracks, strict=True)
            ]
    assert [track.track_id for track in tracks] == [0, 1]
    assert max(nees) < 16.3


@pytest.mark.parametrize(("kind", "x_m", "y_m"), [("cam", -10.0, -5.0), ("ned", 10.0, 5.0)])
def test_one_that_flew_by_the_camera_hides_none_ahead(kind: str, x_m: float, y_m: float) -> None:
    """Behind the camera it has no box, and without own attitude it is soon predicted anywhere around the camera."""
    flight, ahead_m, across_m = Flight(kind, rate_hz=10.0), np.array([0.0, 0.0, 400.0]), []
    for index in range(55):
        near_m = np.array([x_m, y_m, 250.0 - 7.0 * index])
        tracks = flight.frame(flight.sight(ahead_m), *([flight.sight(near_m)] if near_m[2] > 25.0 else []))
        (told,) = (track for track in tracks if track.t_cam_target_m[2] > 300.0)
        across_m.append(float(np.sqrt(told.covariance[:2, :2].diagonal().max())))
    assert max(across_m[20:]) < 1.2 * across_m[20]


@pytest.mark.parametrize(("kind", "rate_hz", "frames"), [("ned", 30.0, 30), ("cam", 1.0, 1)])
def test_one_detection_of_two_is_taken_for_neither_though_their_ranges_begin_anew_or_their_motion_is_unknown(
    kind: str, rate_hz: float, frames: int
) -> None:
    """Neither says that they are seen anywhere but where they were."""
    flight, truth = Flight(kind, rate_hz=rate_hz), np.array([[-3.0, 0.0, 90.0], [3.0, 0.0, 90.0]])
    for _ in range(frames):
        tracks = flight.frame(*(flight.sight(t_m) for t_m in truth))
    flight.tracker.doubt_ranges()
    boxes = np.array([track.box_xyxy_px for track in tracks])
    union = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
    tracks = flight.frame(replace(flight.sight(truth.mean(axis=0)), box_xyxy_px=union))
    (told,) = (track for track in tracks if track.measured_ns == track.time_ns)
    assert np.sqrt(told.covariance[0, 0]) > 2.0


def test_an_aircraft_that_rolls_and_shows_its_wings_is_not_taken_for_two() -> None:
    """Twice as high in the picture from one frame to the next: its box is that at once, and its place as sure."""
    flight, t_m = Flight("ned"), towards(0.0, 250.0)
    for _ in range(30):
        (before,) = flight.frame(flight.sight(t_m))
    for _ in range(5):
        level = flight.sight(t_m)
        half_px = 0.5 * (level.box_xyxy_px[3] - level.box_xyxy_px[1])
        higher = level.box_xyxy_px + np.array([0.0, -half_px, 0.0, half_px])
        (track,) = flight.frame(replace(level, box_xyxy_px=higher))
        assert track.box_xyxy_px == pytest.approx(higher, abs=2.0)
        assert np.all(np.diag(track.covariance)[:2] < 1.5 * np.diag(before.covariance)[:2])
