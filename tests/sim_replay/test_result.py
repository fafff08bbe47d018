"""Judging a replay of known records: stamps to frames, arrival to latency, peers' counts to score.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge.types import Mount
from sim_replay.demo import LiveFigures
from sim_replay.ground_truth import PlayedSequence, read_scene_truth
from sim_replay.play import Recording
from sim_replay.result import frame_views, judge, score_json

START_NS = 50_000_000_000
UTC_MINUS_MONOTONIC_NS = 1_700_000_000_000_000_123
FPS = 30.0


def exposure_ns(frame: int) -> int:
    return START_NS + round(frame * 1e9 / FPS)


def pose(frame: int, x_m: float, late_ns: int = 0) -> dict[str, object]:
    return {
        "event": "pose",
        "target": "t0",
        "age_ms": 14.0,
        "capture_utc_ns": exposure_ns(frame) + late_ns + UTC_MINUS_MONOTONIC_NS,
        "t_cam_target_m": [x_m, 0.0, 200.0],
        "q_cam_target_wxyz": [1.0, 0.0, 0.0, 0.0],
    }


def target_relative(frame: int, received_after_ms: float) -> dict[str, object]:
    return {
        "event": "target_relative",
        "target": 0,
        "capture_utc_us": (exposure_ns(frame) + UTC_MINUS_MONOTONIC_NS) // 1000,
        "received_ns": exposure_ns(frame) + round(received_after_ms * 1e6),
        "t_cam_target_m": [-40.0 if frame == 0 else 5.0, 0.0, 200.0],
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


def test_the_overlay_gets_each_frames_own_pose_and_latency(sequence: PlayedSequence, recording: Recording) -> None:
    views = frame_views(sequence, judge(sequence, recording))
    assert [view.match is not None and view.match.estimate is not None for view in views] == [1, 0, 1, 0, 0]
    assert [view.latency_ms is not None for view in views] == [1, 0, 1, 0, 0]
    assert views[4].match is None


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
