"""Judging a replay of known records: stamps to frames, arrival to latency, peers' counts to score.json."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from edge.types import Mount
from msgs.geometry import so3_exp
from sim_replay.datasets import open_dataset
from sim_replay.demo import LiveFigures
from sim_replay.evaluation.judge import Answer, judge_frames, score_of
from sim_replay.ground_truth import PlayedSequence, read_scene_truth
from sim_replay.matrix.verdict import wrong_poses
from sim_replay.play import Recording
from sim_replay.result import frame_views, judge, score_json
from sim_replay.score import TargetPose, Truth

START_NS = 50_000_000_000
UTC_MINUS_MONOTONIC_NS = 1_700_000_000_000_000_123
FPS = 30.0


def exposure_ns(frame: int) -> int:
    return START_NS + round(frame * 1e9 / FPS)


def pose(frame: int, x_m: float, late_ns: int = 0, rotation_known: bool = True) -> dict[str, object]:
    return {
        "event": "pose",
        "target": "t0",
        "age_ms": 14.0,
        "capture_utc_ns": exposure_ns(frame) + late_ns + UTC_MINUS_MONOTONIC_NS,
        "t_cam_target_m": [x_m, 0.0, 200.0],
        "rotation_known": rotation_known,
        "q_cam_target_wxyz": [1.0, 0.0, 0.0, 0.0],
    }


def direction(frame: int, ray_cam: np.ndarray) -> dict[str, object]:
    captured_ns = exposure_ns(frame) + UTC_MINUS_MONOTONIC_NS
    told = {"event": "direction", "target": "t1", "capture_utc_ns": captured_ns, "age_ms": 14.0}
    return told | {"ray_cam": ray_cam.tolist()}


def target_relative(frame: int, received_after_ms: float, rotation_known: bool = True) -> dict[str, object]:
    return {
        "event": "target_relative",
        "target": 0,
        "capture_utc_us": (exposure_ns(frame) + UTC_MINUS_MONOTONIC_NS) // 1000,
        "received_ns": exposure_ns(frame) + round(received_after_ms * 1e6),
        "t_cam_target_m": [-40.0 if frame == 0 else 5.0, 0.0, 200.0],
        "rotation_known": rotation_known,
        "q_cam_target_wxyz": [1.0, 0.0, 0.0, 0.0],
    }


@pytest.fixture
def sequence(dark_spot_scene: Path) -> PlayedSequence:
    mount = Mount(np.eye(3), np.zeros(3))
    return PlayedSequence(read_scene_truth(dark_spot_scene), FPS, mount, dark_spot_scene / "telemetry.csv", 0)


@pytest.fixture
def recording() -> Recording:
    """Frames 0 and 2 found, 1 and 3 missed, a pose in the empty frame 4, one from before the sequence."""
    made = Recording(START_NS, UTC_MINUS_MONOTONIC_NS, 14550, "tcp/127.0.0.1:7448")
    for record in (pose(0, -40.0), pose(2, 5.0, late_ns=900), pose(4, 0.0), pose(-9, 0.0)):
        made.take("subscriber", record)
    for record in (target_relative(0, 12.0), target_relative(2, 18.0)):
        made.take("autopilot", record)
    made.take("autopilot", {"event": "summary", "received": {"TARGET_RELATIVE": 2}, "refused": {}})
    made.take("subscriber", {"event": "summary", "received": {"uav1/target/t0/pose": 4}, "refused": {}})
    return made


def test_records_become_the_score(sequence: PlayedSequence, recording: Recording) -> None:
    result = judge(sequence, recording)
    score = score_json(sequence, result, {})
    assert json.loads(json.dumps(score, allow_nan=False)) == score
    overall = score["overall"]
    assert (score["poses"], score["stray_poses"], overall["false_poses"]) == (4, 1, 1)
    assert (overall["frames"], overall["targets"]) == (5, 4)
    assert overall["recall"] == overall["pose_10deg_5pct"] == overall["add_0_1d"] == 0.5
    assert overall["false_positives_per_1000"] == 1000.0
    assert score["latency_ms"]["p50"] == pytest.approx(15.0, abs=0.002)
    assert score["mavlink_received"] == {"TARGET_RELATIVE": 2}
    assert score["zenoh_received"] == {"uav1/target/t0/pose": 4}


def test_hidden_targets_and_frames_that_were_not_recorded_are_in_no_rate(
    sequence: PlayedSequence, recording: Recording
) -> None:
    """The target of frame 1 is hidden, and frame 4, which shows none, was not recorded."""
    truths = [replace(truth, visible=truth.frame != 1) for truth in sequence.scene.truths]
    scene = replace(sequence.scene, truths=truths, unrecorded=frozenset({4}))
    played = replace(sequence, scene=scene)
    score = score_json(played, judge(played, recording), {})
    peer = score["peers"]["subscriber"]
    assert (peer["poses"], peer["stray_poses"]) == (4, 1)
    for overall in (score["overall"], peer["overall"]):
        assert (overall["frames"], overall["targets"], overall["recall"]) == (4, 3, pytest.approx(2 / 3, abs=1e-6))


@pytest.mark.parametrize(("px_count_all", "false_alarms"), [(60, 0.0), (0, 500.0)])
def test_a_frame_is_without_a_target_if_it_is_in_an_evaluation_of_single_images(
    px_count_all: int, false_alarms: float, dark_spot_scene: Path
) -> None:
    """A pose beside the target of frame 1, which is behind something or out of view; frame 4 shows none."""
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60, "px_count_all": 60}
    hidden = {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": 0, "px_count_all": px_count_all}
    info = {str(k): [hidden if k == 1 else seen] for k in range(4)}
    (dark_spot_scene / "scene_gt_info.json").write_text(json.dumps(info))
    mount = Mount(np.eye(3), np.zeros(3))
    played = PlayedSequence(read_scene_truth(dark_spot_scene), FPS, mount, dark_spot_scene / "telemetry.csv", 0)
    made = Recording(START_NS, UTC_MINUS_MONOTONIC_NS, 14550, "tcp/127.0.0.1:7448")
    made.take("subscriber", pose(1, 5.0))
    made.take("autopilot", target_relative(1, 12.0))
    score = score_json(played, judge(played, made), {})
    beside = TargetPose(1, np.eye(3), np.array([5.0, 0.0, 200.0]))
    dataset = open_dataset(dark_spot_scene.parents[1])
    images = judge_frames(
        list(dataset.frames()), dataset.models, lambda k, _: Answer((beside,) if k == beside.frame else (), None)
    )
    for told in (score, *score["peers"].values(), score_of(dataset, {}, images)):
        assert (told["overall"]["false_poses"], told["overall"]["false_positives_per_1000"]) == (1, false_alarms)


def test_poses_of_no_frame_are_no_poses_of_a_target_that_is_visible(sequence: PlayedSequence) -> None:
    made = Recording(START_NS, UTC_MINUS_MONOTONIC_NS, 14550, "tcp/127.0.0.1:7448")
    made.take("subscriber", pose(-9, 0.0))
    told = ("the subscriber received no pose of a frame, but 1 of none", "the autopilot received no pose")
    assert wrong_poses(sequence, judge(sequence, made)) == told


def test_a_rotation_that_neither_peer_was_told_is_not_judged(sequence: PlayedSequence) -> None:
    """Both poses lie where the target is; what stands for the rotation of one is its true one, by chance."""
    made = Recording(START_NS, UTC_MINUS_MONOTONIC_NS, 14550, "tcp/127.0.0.1:7448")
    for frame, x_m, known in ((0, -40.0, False), (2, 5.0, True)):
        made.take("subscriber", pose(frame, x_m, rotation_known=known))
        made.take("autopilot", target_relative(frame, 12.0, rotation_known=known))
    for peer in score_json(sequence, judge(sequence, made), {})["peers"].values():
        overall = peer["overall"]
        assert (overall["rotations_not_known"], overall["recall"]) == (1, 0.5)
        assert overall["rot_10deg"] == overall["pose_10deg_5pct"] == overall["add_0_1d"] == 0.25
        assert overall["depth_5pct"] == 0.5
    figures = LiveFigures(sequence)
    figures.take(made, pose(0, -40.0, rotation_known=False))
    assert figures.cells()["rotation error"] == "–"
    assert figures.cells()["range error"] == "+0.0 m"


@pytest.mark.parametrize(
    ("turn_rad", "moved_m"), [([0.0, 2.0 * np.arctan(30.0 / 200.0), 0.0], [0.0] * 3), ([0.0] * 3, [60.0, 0.0, 0.0])]
)
def test_one_of_two_alike_that_leaves_takes_no_name_with_it(
    sequence: PlayedSequence, turn_rad: list[float], moved_m: list[float]
) -> None:
    """Two of one airframe, 30 m left and right at 200 m. The left one leaves, and the camera turns, or flies, to the
    other: it then stands in the picture where the left one stood, but not in the world."""
    turned, there_m = so3_exp(turn_rad), np.array(moved_m)
    left_m, right_m = np.array([-30.0, 0.0, 200.0]), np.array([30.0, 0.0, 200.0])
    shown = [[left_m, right_m], [left_m, right_m], [left_m], [left_m], [left_m]]  # in `cam`
    assert turned @ left_m + there_m == pytest.approx(right_m)
    truths = [Truth(k, np.eye(3), t_m, 1, 12.0) for k, places_m in enumerate(shown) for t_m in places_m]
    cameras = [(np.eye(3), np.zeros(3)) if k < 2 else (turned, there_m) for k in range(5)]
    alike = replace(sequence, scene=replace(sequence.scene, truths=truths, cameras_world=cameras))
    made = Recording(START_NS, UTC_MINUS_MONOTONIC_NS, 14550, "tcp/127.0.0.1:7448")
    for truth in truths:
        name = "t0" if truth.frame < 2 and truth.t_cam_target_m[0] < 0.0 else "t1"
        made.take("subscriber", {**pose(truth.frame, truth.t_cam_target_m[0]), "target": name})
    held = score_json(alike, judge(alike, made), {})["peers"]["subscriber"]["continuity"]
    assert held["identity_switches"] == 0
    assert [(target["frames"], target["tracks"]) for target in held["targets"]] == [(2, ["t0"]), (5, ["t1"])]


def test_the_overlay_gets_each_frames_own_pose_and_latency(sequence: PlayedSequence, recording: Recording) -> None:
    views = frame_views(sequence, judge(sequence, recording))
    assert [view.match is not None and view.match.estimate is not None for view in views] == [1, 0, 1, 0, 0]
    assert [view.latency_ms is not None for view in views] == [1, 0, 1, 0, 0]
    assert views[4].match is None


def test_the_overlay_gets_every_target_of_a_frame(sequence: PlayedSequence, recording: Recording) -> None:
    beside_m = np.array([-10.0, 0.0, 200.0])
    truths = [*sequence.scene.truths, Truth(0, np.eye(3), beside_m, 1, 12.0)]
    two = replace(sequence, scene=replace(sequence.scene, truths=truths))
    views = frame_views(two, judge(two, recording))
    assert [len(view.others) for view in views] == [1, 0, 0, 0, 0]


def test_inset_and_charts_of_the_overlay_stay_with_one_target(sequence: PlayedSequence, recording: Recording) -> None:
    """Another is listed before it, in frames 0, 1 and 4, the last of which is without it."""
    beside = [replace(truth, object_id=2) for truth in sequence.scene.truths[:2]]
    truths = [*beside, replace(beside[0], frame=4), *sequence.scene.truths]
    extents = sequence.scene.extents | {2: sequence.scene.extents[1]}
    two = replace(sequence, scene=replace(sequence.scene, truths=truths, extents=extents))
    views = frame_views(two, judge(two, recording))
    assert [None if view.match is None else view.match.truth.object_id for view in views] == [1, 1, 1, 1, None]
    assert [[match.truth.object_id for match, _ in view.others] for view in views] == [[2], [2], [], [], [2]]


def test_directions_are_judged_where_there_is_no_pose_and_all_of_them_are_shown(
    sequence: PlayedSequence, recording: Recording
) -> None:
    """Beside the pose of frame 0; in frame 1 alone, 0.1 degrees off; in the empty frame 4; before the sequence."""
    assert score_json(sequence, judge(sequence, recording), {})["directions"] is None
    off = so3_exp([0.0, np.deg2rad(0.1), 0.0])
    ahead = np.array([0.0, 0.0, 200.0])
    for frame, place_m in ((0, ahead - [40, 0, 0]), (1, off @ (ahead - [15, 0, 0])), (4, ahead), (-9, ahead)):
        recording.take("subscriber", direction(frame, place_m / np.linalg.norm(place_m)))
    result = judge(sequence, recording)
    told = score_json(sequence, result, {})["directions"]
    error_deg = {name: pytest.approx(0.1, abs=1e-5) for name in ("mean", "median")}
    assert told == {"targets": 1, "bearing_error_deg": error_deg, "false": 1}
    assert [len(view.directions) for view in frame_views(sequence, result)] == [1, 1, 0, 0, 1]


def test_a_frame_that_was_not_recorded_shows_the_boxes_of_the_picture_before(
    sequence: PlayedSequence, recording: Recording
) -> None:
    partly = replace(sequence, scene=replace(sequence.scene, unrecorded=frozenset({1, 3})))
    views = frame_views(partly, judge(partly, recording))
    assert [view is before for before, view in pairwise(views)] == [True, False, True, False]


def test_the_live_line_follows_the_records(sequence: PlayedSequence, recording: Recording) -> None:
    figures = LiveFigures(sequence)
    assert figures.cells()["frame"] == "waiting"
    for record in (pose(0, -40.0), pose(1, -15.0), pose(2, 6.0), target_relative(2, 18.0)):
        figures.take(recording, record)
    cells = figures.cells()
    assert cells["frame"] == "3/5"
    assert cells["range error"] == f"{np.hypot(6, 200) - np.hypot(5, 200):+.1f} m"
    assert cells["rotation error"] == "0.0°"
    assert cells["latency"] == "18.0 ms"
    assert cells["rate"] == "30.0 Hz"
    figures.take(recording, direction(2, np.array([0.6, 0.0, 0.8])))  # of another target
    assert figures.cells() == cells
    figures.take(recording, direction(3, np.array([0.6, 0.0, 0.8])))
    assert figures.cells() == cells | {
        "frame": "4/5", "range": "not known", "range error": "–", "rotation error": "–"
    }  # fmt: skip
