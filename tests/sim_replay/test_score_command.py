"""`uavpose-replay score`: options of one way of scoring are not passed over in the other; records that are none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from edge.errors import InputError
from sim_replay.cli import main
from sim_replay.play import Recording
from sim_replay.report.flight_files import RECEIVED_JSONL, RecordedFlight, read_flight, write_flight

POSE = {
    "peer": "subscriber", "event": "pose", "target": "t0", "capture_utc_ns": 5, "age_ms": 9.5, "rotation_known": True,
    "t_cam_target_m": [0.0, 0.0, 200.0], "q_cam_target_wxyz": [1.0, 0.0, 0.0, 0.0],
}  # fmt: skip


DIRECTION = {
    "peer": "subscriber", "event": "direction", "target": "t1", "capture_utc_ns": 5, "age_ms": 9.5,
    "ray_cam": [0.6, 0.0, 0.8],
}  # fmt: skip


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["FLIGHT", "--split", "test", "--every", "50"], "--split, --every: only with --dataset, not with FLIGHT"),
        (["FLIGHT", "--model", "m.onnx"], "--model: only with --dataset, not with FLIGHT"),
        (["--dataset", "DIR", "--sequence", "S"], "--sequence: only with FLIGHT, not with --dataset"),
        (["--dataset", "DIR", "--out", "O"], "--out: only with FLIGHT, not with --dataset"),
    ],
)
def test_options_of_the_other_way_are_refused(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["score", *options]) == 2
    assert capsys.readouterr().err.strip() == words


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    write_flight(tmp_path, RecordedFlight(tmp_path, {}, Recording(0, 0, 1, "tcp/127.0.0.1:1")))
    return tmp_path


def test_a_pose_that_is_one_is_taken(flight: Path) -> None:
    (flight / RECEIVED_JSONL).write_text(json.dumps(POSE) + "\n")
    assert len(read_flight(flight).recording.poses) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t_cam_target_m": None}, "it has no 't_cam_target_m'"),
        ({"capture_utc_ns": None}, "it has no 'capture_utc_us'"),
        ({"q_cam_target_wxyz": [0.0, 0.0, 0.0, 0.0]}, "a zero or non-finite quaternion is not a rotation"),
        ({"t_cam_target_m": [1.0, 2.0]}, "its pose is not three metres and a quaternion"),
        ({"t_cam_target_m": [0.0, 0.0, float("inf")]}, "a number is not finite"),
        ({"covariance": [[1.0]]}, "its covariance is not a 6×6 matrix"),
        ({"covariance": [[float("nan")] * 6] * 6}, "its covariance is not finite, or a variance is negative"),
        ({"covariance": [[-1.0] * 6] * 6}, "its covariance is not finite, or a variance is negative"),
    ],
)
def test_a_pose_that_is_none_is_told_with_its_line(flight: Path, change: dict[str, Any], words: str) -> None:
    record = {key: value for key, value in (POSE | change).items() if value is not None}
    (flight / RECEIVED_JSONL).write_text(f"{json.dumps(POSE)}\n{json.dumps(record)}\n")
    with pytest.raises(InputError) as error:
        read_flight(flight)
    assert str(error.value) == f"{flight / RECEIVED_JSONL}: line 2 is not a record of a peer: {words}"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ray_cam": None}, "it has no 'ray_cam'"),
        ({"ray_cam": [0.6, 0.8]}, "its direction is not a vector of length 1"),
        ({"ray_cam": [0.6, 0.0, 1.8]}, "its direction is not a vector of length 1"),
        ({"ray_cam": [0.6, 0.0, float("nan")]}, "its direction is not a vector of length 1"),
        ({"age_ms": float("inf")}, "a number is not finite"),
        ({"target": None}, "it has no 'target'"),
    ],
)
def test_a_direction_that_is_none_is_told_with_its_line(flight: Path, change: dict[str, Any], words: str) -> None:
    record = {key: value for key, value in (DIRECTION | change).items() if value is not None}
    (flight / RECEIVED_JSONL).write_text(f"{json.dumps(DIRECTION)}\n{json.dumps(record)}\n")
    with pytest.raises(InputError) as error:
        read_flight(flight)
    assert str(error.value) == f"{flight / RECEIVED_JSONL}: line 2 is not a record of a peer: {words}"


def test_where_a_flight_cannot_be_written_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = tmp_path / "taken"
    taken.touch()
    assert main(["demo", "--out", str(taken)]) == 2
    assert capsys.readouterr().err.strip() == f"{taken}: cannot be written: File exists"
