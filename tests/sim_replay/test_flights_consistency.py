"""Whether covariances told over many flights are honest, and the own ship's errors that a replay tells them with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from edge.tracking import view
from sim_replay.bop import BopScene
from sim_replay.datasets import DatasetFrame
from sim_replay.evaluation.consistency import bounds_95, consistency
from sim_replay.evaluation.directions import directions
from sim_replay.evaluation.filtering import filtering
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.evaluation.own_ship import OwnShipErrors
from sim_replay.score import Match, TargetPose, Truth

FLIGHTS, FRAMES = 60, 5
STD = np.array([3.0, 2.0, 20.0, 0.05, 0.04, 0.1])  # m, rad


def flights(told_wider: float, targets: int = 1) -> list[JudgedFrame]:
    """Frames of one flight share their error; covariances are told so many times too wide."""
    rng = np.random.default_rng(3)
    covariance = told_wider * np.diag(STD**2)
    judged = []
    for number in range(FLIGHTS):
        scene = BopScene(Path(f"{number:06d}"))
        errors = rng.normal(scale=STD, size=(targets, 6))
        for image in range(FRAMES):
            matches = []
            for error in errors:
                truth = Truth(len(judged), np.eye(3), np.array([10.0, -5.0, 300.0]), 4, 10.0)
                R = Rotation.from_rotvec(error[3:]).as_matrix()
                estimate = TargetPose(len(judged), R, truth.t_cam_target_m + error[:3], covariance=covariance)
                matches.append(Match(truth, estimate))
            picture = DatasetFrame(number, image, np.eye(3), None, Path("none.jpg"), (), scene, ())
            judged.append(JudgedFrame(picture, tuple(matches), (), None))
    return judged


def test_bounds_are_those_of_a_printed_table() -> None:
    assert bounds_95(1) == pytest.approx((0.216, 9.348), abs=5e-4)
    assert bounds_95(10) == pytest.approx((16.791 / 10, 46.979 / 10), abs=5e-5)


def test_honest_covariances_lie_inside_and_each_flight_counts_once() -> None:
    found = consistency(flights(1.0))
    assert found is not None
    assert found["flights"] == FLIGHTS
    for part in ("position", "rotation"):
        low, high = found[part]["bounds_95"]
        assert low < found[part]["nees_mean"] < high
        assert found[part]["flights_inside"] >= 0.9


def test_two_targets_of_one_object_are_two_flights() -> None:
    found = consistency(flights(1.0, targets=2))
    assert found is not None
    assert found["flights"] == 2 * FLIGHTS


def test_a_flight_stays_its_own_when_another_of_its_object_leaves() -> None:
    """Two errors squared: nil of the left target, that leaves after two of five frames, and 3 of the right one."""
    (first, *_) = flights(1.0)
    frames = []
    for k in range(5):
        matches = []
        for x_m, error_m in ((-40.0, 0.0), (40.0, 3.0**0.5))[0 if k < 2 else 1 :]:
            truth = Truth(k, np.eye(3), np.array([x_m, 0.0, 300.0]), 4, 10.0)
            told_m = truth.t_cam_target_m + np.array([0.0, error_m, 0.0])
            matches.append(Match(truth, TargetPose(k, np.eye(3), told_m, covariance=np.eye(6))))
        frames.append(replace(first, matches=tuple(matches)))
    found = consistency(frames)
    assert found is not None
    assert (found["flights"], found["position"]["nees_mean"]) == (2, 1.5)


@pytest.mark.parametrize("told_wider", [0.25, 4.0])
def test_what_is_told_too_wide_or_too_narrow_is_out_by_that_factor(told_wider: float) -> None:
    found, honest = consistency(flights(told_wider)), consistency(flights(1.0))
    assert found is not None
    assert honest is not None
    for part in ("position", "rotation"):
        assert found[part]["nees_mean"] == pytest.approx(honest[part]["nees_mean"] / told_wider, rel=1e-3)
        low, high = found[part]["bounds_95"]
        assert not low < found[part]["nees_mean"] < high


@pytest.mark.parametrize("told_wider", [0.4, 4.0])
def test_flights_inside_and_above_their_own_bounds_are_counted(told_wider: float) -> None:
    found = consistency(flights(told_wider))
    assert found is not None
    off = (np.random.default_rng(3).normal(scale=STD, size=(FLIGHTS, 6)) / STD) ** 2 / told_wider  # as in `flights`
    low, high = chi2.ppf([0.025, 0.975], 3)
    for part, of_flights in (("position", off[:, :3].sum(axis=1)), ("rotation", off[:, 3:].sum(axis=1))):
        assert found[part]["nees_median"] == pytest.approx(np.median(of_flights), abs=1e-4)
        assert found[part]["flights_above"] == pytest.approx(np.mean(of_flights > high), abs=1e-4)
        inside = (of_flights >= low) & (of_flights <= high)
        assert found[part]["flights_inside"] == pytest.approx(np.mean(inside), abs=1e-4)


def test_nothing_is_said_where_no_pose_tells_how_sure_it_is() -> None:
    (first, *_) = flights(1.0)
    (match,) = first.matches
    bare = TargetPose(0, np.eye(3), match.truth.t_cam_target_m)
    assert (
        consistency([JudgedFrame(first.picture, (Match(match.truth, bare), Match(match.truth, None)), (), None)])
        is None
    )


def without_rotation(frame: JudgedFrame) -> JudgedFrame:
    """The same, with a rotation half a turn off in every pose, said not to be known."""
    half_turn = np.diag([-1.0, -1.0, 1.0])
    told = [replace(m.estimate, R_cam_target=half_turn, rotation_known=False) for m in frame.matches if m.estimate]
    return replace(frame, matches=tuple(Match(m.truth, pose) for m, pose in zip(frame.matches, told, strict=True)))


def test_rotations_that_are_not_known_are_held_against_nothing() -> None:
    honest = flights(1.0)
    whole = consistency(honest)
    assert whole is not None
    # The frames of one flight share their error: four of its five tell as much as all of them.
    some = consistency([without_rotation(frame) if k % FRAMES == 2 else frame for k, frame in enumerate(honest)])
    assert some == whole
    none = consistency([without_rotation(frame) for frame in honest])
    assert none == {**whole, "rotation": None}


def test_a_tracker_that_tells_no_rotation_is_held_against_what_it_was_given_by_place_alone() -> None:
    (frame, *_) = flights(1.0)
    (match,) = frame.matches
    t_m = match.truth.t_cam_target_m
    given = TargetPose(0, np.eye(3), t_m + np.array([0.0, 4.0, 0.0]))
    told = TargetPose(0, np.diag([-1.0, -1.0, 1.0]), t_m + np.array([0.0, 1.0, 0.0]), rotation_known=False)
    unturned = replace(frame, matches=(Match(match.truth, told),), measured=(Match(match.truth, given),))
    assert filtering([unturned]) == {
        "targets": 1,
        "translation_error_m": {"measured": 4.0, "track": 1.0},
        "rotation_error_deg": {"measured": None, "track": None},
    }
    R = Rotation.from_euler("z", 20.0, degrees=True).as_matrix()
    turned = replace(unturned, matches=(Match(match.truth, replace(told, R_cam_target=R, rotation_known=True)),))
    found = filtering([unturned, turned])
    assert found is not None
    assert found["rotation_error_deg"] == {"measured": 0.0, "track": pytest.approx(20.0)}


def test_what_a_tracker_was_given_is_held_against_what_it_told_of_the_same_targets() -> None:
    (frame, *_) = flights(1.0)
    (match,) = frame.matches
    truth_m = match.truth.t_cam_target_m

    def off(metres: float, degrees: float) -> TargetPose:
        R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        return TargetPose(0, R, truth_m + np.array([0.0, metres, 0.0]))

    def judged(given: TargetPose | None, told: TargetPose | None) -> JudgedFrame:
        return replace(frame, matches=(Match(match.truth, told),), measured=(Match(match.truth, given),))

    one_side = [judged(off(50.0, 90.0), None), judged(None, off(60.0, 80.0))]
    found = filtering([judged(off(4.0, 30.0), off(1.0, 2.0)), judged(off(2.0, 10.0), off(3.0, 4.0)), *one_side])
    assert found == {
        "targets": 2,
        "translation_error_m": {"measured": pytest.approx(3.0), "track": pytest.approx(2.0)},
        "rotation_error_deg": {"measured": pytest.approx(20.0), "track": pytest.approx(3.0)},
    }
    assert filtering([frame, *one_side]) is None


def test_directions_count_for_targets_without_a_pose_by_their_bearing() -> None:
    (frame, *_) = flights(1.0)
    (match,) = frame.matches
    x, y, z = match.truth.t_cam_target_m

    def seen(off_rad: float, told: bool) -> JudgedFrame:
        """A direction turned by so much about x, at twice the range; `told`: beside a pose."""
        turned = Rotation.from_euler("x", off_rad).apply([x, y, z])
        direction = TargetPose(0, np.eye(3), 2.0 * turned, rotation_known=False)
        return replace(
            frame,
            matches=(Match(match.truth, direction if told else None),),
            directions=(Match(match.truth, direction),),
        )

    false = (TargetPose(0, np.eye(3), np.array([0.0, 99.0, 9.0]), rotation_known=False),)
    beside = [replace(seen(off_rad, False), false_directions=false) for off_rad in (1e-3, 2e-3)]
    found = directions([frame, *beside, seen(6e-3, False), seen(9e-3, True)])
    across = np.hypot(y, z) / np.linalg.norm([x, y, z])
    assert found == {
        "targets": 3,
        "bearing_error_deg": {
            "mean": pytest.approx(np.degrees(3e-3 * across), abs=2e-5),
            "median": pytest.approx(np.degrees(2e-3 * across), abs=2e-5),
        },
        "false": 2,
    }
    assert directions([frame]) is None


def test_own_ship_errors_are_a_flights_own_and_of_the_size_that_the_tracker_allows_for() -> None:
    drawn = [OwnShipErrors.of_flight(f"{number:06d}") for number in range(400)]
    again = OwnShipErrors.of_flight("000003")
    assert np.array_equal(again.attitude_rad, drawn[3].attitude_rad)
    assert again.clock_s == drawn[3].clock_s
    R = Rotation.from_euler("ZYX", [80.0, 5.0, -70.0], degrees=True).as_matrix()  # a camera's axes are far from ned's
    still = np.zeros(3)
    off = np.array([Rotation.from_matrix(one.attitude(R, still) @ R.T).as_rotvec() for one in drawn])
    expected = [view.TILT_STD_RAD, view.TILT_STD_RAD, view.HEADING_STD_RAD]
    assert off.std(axis=0) == pytest.approx(expected, rel=0.15)
    moved = np.array([one.position(still, np.array([0.0, 1000.0, 0.0])) for one in drawn])
    late_m = 1000.0 * view.EXPOSURE_STD_S
    north, east = view.POSITION_STD_M, np.hypot(view.POSITION_STD_M, late_m)
    assert moved.std(axis=0) == pytest.approx([north, east, north], rel=0.15)
    jitter = np.array([Rotation.from_matrix(drawn[0].attitude(np.eye(3), still)).as_rotvec() for _ in drawn])
    for apart in (np.array([one.position_m for one in drawn]), jitter):
        assert np.corrcoef(apart, rowvar=False) == pytest.approx(np.eye(3), abs=0.2)


def test_a_late_stamp_turns_the_attitude_of_a_turning_camera_and_moves_it_on() -> None:
    errors = OwnShipErrors.of_flight("a")
    errors = OwnShipErrors(np.random.default_rng(1), np.zeros(3), errors.position_m, 0.02)
    R = errors.attitude(np.eye(3), np.array([0.0, 0.0, 1.5]))
    assert Rotation.from_matrix(R).as_rotvec() == pytest.approx([0.0, 0.0, 0.03], abs=5 * view.ATTITUDE_JITTER_RAD)
    velocity_mps = np.array([50.0, 0.0, -5.0])
    assert errors.position(np.zeros(3), velocity_mps) == pytest.approx(errors.position_m + 0.02 * velocity_mps)


def test_a_covariance_without_an_inverse_is_counted_and_left_out() -> None:
    frames = flights(1.0)
    whole = consistency(frames)

    def flat(frame: JudgedFrame, variances: Sequence[float]) -> JudgedFrame:
        (match,) = frame.matches
        assert match.estimate is not None
        return replace(frame, matches=(Match(match.truth, replace(match.estimate, covariance=np.diag(variances))),))

    in_two_flights = {0: np.zeros(6), 1: np.zeros(6), FRAMES: [0.0, 1.0, 1.0, *STD[3:] ** 2]}
    found = consistency(
        [flat(frame, in_two_flights[k]) if k in in_two_flights else frame for k, frame in enumerate(frames)]
    )
    assert found == {**whole, "singular": 3}  # a flight's frames share their error
    alone = consistency([flat(frames[0], np.zeros(6))])
    assert alone == {"flights": 1, "singular": 1, "position": None, "rotation": None}


def test_scenes_that_share_a_folder_are_flights_of_their_own() -> None:
    together = [
        replace(frame, picture=replace(frame.picture, scene=BopScene(Path("train"), frame.picture.scene_id)))
        for frame in flights(1.0)
    ]
    found = consistency(together)
    assert found is not None
    assert found["flights"] == FLIGHTS
