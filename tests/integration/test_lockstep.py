"""Lock-step as a user runs it: the same outputs at any speed, as accepted, and a frame at a time."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sim_replay.cli import main
from sim_replay.golden import run as golden
from sim_replay.golden.run import CASES
from sim_replay.lockstep.player import POSES_JSONL
from sim_replay.ports import free_port
from sim_replay.report.flight_files import FLIGHT_JSON

BIN = Path(sys.executable).parent
LAST_FRAMES = ["--start", "4.6"]  # of 150 at 30 Hz: the last twelve


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_same_frames_give_the_same_files_at_any_speed_and_by_hand(tmp_path: Path) -> None:
    assert main(["play", "--lockstep", *LAST_FRAMES, "--out", str(tmp_path / "quick")]) == 0
    began_s = time.monotonic()
    assert main(["play", "--speed", "0.25", *LAST_FRAMES, "--out", str(tmp_path / "slow")]) == 0
    assert time.monotonic() - began_s > 11 / 30 / 0.25
    by_hand = [BIN / "uavpose-replay", "play", "--step", *LAST_FRAMES, "--out", tmp_path / "stepped"]
    stepped = subprocess.run(by_hand, input="\n\ng\n", capture_output=True, text=True, timeout=200)
    assert stepped.returncode == 0, stepped.stderr
    assert stepped.stdout.count("before frame") == 3
    assert stepped.stdout.count("t0 at") >= 8

    expected = files(tmp_path / "quick")
    assert sorted(expected) == ["mavlink.jsonl", "poses.jsonl"]
    assert files(tmp_path / "slow") == expected
    assert files(tmp_path / "stepped") == expected
    poses = [json.loads(line) for line in expected["poses.jsonl"].splitlines()]
    assert [pose["frame"] for pose in poses if pose["target"] == "t0"] == list(range(poses[0]["frame"], 150))
    assert all(pose["t_ns"] == round(pose["frame"] * 1e9 / 30) for pose in poses)
    messages = [json.loads(line) for line in expected["mavlink.jsonl"].splitlines()]
    told = [message for message in messages if message["message"] == "TARGET_RELATIVE"]
    assert [message["timestamp"] for message in told] == [pose["t_ns"] // 1000 for pose in poses]


def test_a_target_that_is_given_as_larger_is_farther_away(tmp_path: Path) -> None:
    """The aircraft of the bundled sequence has 12 m of wings and is 6.5 m long."""
    away_m = []
    for share in (0.9, 1.1):
        size = [f"{share * side_m:.2f}" for side_m in (12.0, 6.5)]
        out = tmp_path / f"{share}"
        assert main(["play", "--lockstep", *LAST_FRAMES, "--target-size", *size, "--out", str(out)]) == 0
        poses = [json.loads(line) for line in files(out)["poses.jsonl"].splitlines()]
        away_m.append(np.mean([pose["t_cam_target_m"][2] for pose in poses]))
    assert 1.01 * away_m[0] < away_m[1] < 1.22 * away_m[0]


@pytest.mark.parametrize("case", CASES)
def test_the_daemon_says_what_was_accepted(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = main(["golden", case, "--out", str(tmp_path)]), capsys.readouterr()
    assert code == 0, f"{said.out}\n{said.err}\naccept it: uavpose-replay golden --accept"
    assert said.out.strip().endswith(f"{case}: no differences")


def test_a_golden_run_that_fails_leaves_nothing_of_an_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "unknown_range"
    folder.mkdir()
    (folder / POSES_JSONL).write_text("of an earlier run\n")
    daemon = tmp_path / "bin" / "uavpose-edge"
    daemon.parent.mkdir()
    daemon.symlink_to("/bin/false")
    monkeypatch.setattr(sys, "executable", str(daemon.parent / "python"))
    assert main(["golden", "unknown_range", "--out", str(tmp_path)]) == 1
    assert "the daemon did not connect to the player" in capsys.readouterr().err
    assert list(folder.iterdir()) == []


def test_a_golden_file_that_cannot_be_read_is_written_anew_when_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    golden.golden_file("two_targets").write_text("<<<<<<< HEAD\n")  # as a merge leaves it
    play = ["golden", "two_targets", "--out", str(tmp_path / "out")]
    assert main(play) == 2
    assert "two_targets.jsonl: is not a golden file" in capsys.readouterr().err
    assert main([*play, "--accept"]) == 0
    assert {"pose", "TARGET_RELATIVE"} <= {record["kind"] for record in golden.read_golden("two_targets")[1]}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["play", "--start", "9"], "--start 9.0: must be from 0 to 4.967 s, the times of the sequence's frames"),
        (["play", "--loop", "0"], "--loop 0: must be from 1 to 10000"),
        (["play", "--loop", "1000000000", "--pause", "5"], "--loop 1000000000: must be from 1 to 10000"),
        (["play", "--pause", "150"], "--pause 150: is not one of the frames 0 to 149"),
        (["play", "--speed", "0.1"], "'0.1' is neither a number of at least 0.25 nor max"),
        (["play", "--lockstep", "--target-size", "0", "9"], "--target-size 0 9: wingspan_m must be at least 0.5"),
        (["play", "--target-size", "nan", "9"], "--target-size nan 9: wingspan_m must be at most 100"),
        (["play", "--lockstep", "--model", "none.onnx"], "model none.onnx cannot be read"),
        (["golden", "crosing"], f"golden crosing: no such case; the cases are {', '.join(CASES)}"),
    ],
)
def test_what_cannot_be_played_is_said_in_a_sentence_and_an_earlier_flight_stays(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / FLIGHT_JSON).write_text("{}")
    try:
        code = main([*arguments, "--out", str(tmp_path)])
    except SystemExit as refused:  # by argparse
        code = refused.code
    said = capsys.readouterr()
    assert (code, said.out) == (2, "")
    assert words in said.err
    assert [path.name for path in tmp_path.iterdir()] == [FLIGHT_JSON]


def test_without_a_player_the_daemon_says_so_and_names_the_key(small_scene: Path, tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    address = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    config.write_text(f'[camera]\ntype = "sequence"\npath = "{small_scene}"\nlockstep = "{address}"\n')
    ended = subprocess.run(
        [BIN / "uavpose-edge", "run", "--config", config], capture_output=True, text=True, timeout=100
    )
    assert ended.returncode == 2
    assert f"no player answers at {address}" in ended.stderr
    assert "config.toml:4: [camera] lockstep: " in ended.stderr
    assert "Traceback" not in ended.stderr
