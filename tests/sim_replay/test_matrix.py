"""`matrix`: every combination in one table, wrong ones in the exit code; at another speed a flight is the same."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from msgs.geometry import R_from_q_wxyz, rotation_angle, so3_exp
from sim_replay.cli import main
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.gimbal import track_of
from sim_replay.ground_truth import read_sequence
from sim_replay.matrix.cells import Cell
from sim_replay.matrix.command import table
from sim_replay.pace import at_speed
from sim_replay.telemetry import read_telemetry
from tests.edge.toy_model import write_toy_model
from tests.sim_replay.toy_flight import write_toy_flight

IMPOSSIBLE = """
title = "A state that there is not"

[[step]]
do = "expect_state"
pattern = "e[u]phoric"
within_s = 1.0
"""


@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_at_another_speed_each_frame_is_taken_from_the_same_place(speed: float, tmp_path: Path) -> None:
    sequence = read_sequence(BUNDLED_SEQUENCE)
    faster = at_speed(sequence, speed, tmp_path)
    once, again = read_telemetry(sequence.telemetry_csv), read_telemetry(faster.telemetry_csv)
    for frame in range(5, 145, 20):
        before = once.at(sequence.frame0_ns + round(frame * 1e9 / sequence.fps))
        after = again.at(faster.frame0_ns + round(frame * 1e9 / faster.fps))
        np.testing.assert_allclose(after.t_ned_body_m, before.t_ned_body_m, atol=2e-3)
        assert rotation_angle(R_from_q_wxyz(after.q_ned_body_wxyz), R_from_q_wxyz(before.q_ned_body_wxyz)) < 1e-5
        np.testing.assert_allclose(after.v_ned_body_mps, speed * before.v_ned_body_mps, atol=2e-2)


@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0])
def test_at_another_speed_the_gimbal_looks_the_same_way_at_each_frame(speed: float, tmp_path: Path) -> None:
    sequence = replace(read_sequence(BUNDLED_SEQUENCE), frame0_ns=7_000_000_000)
    R_cam_ned = [so3_exp(np.array([0.0, 0.0, 0.02 * frame])) for frame in range(len(sequence.scene.images))]
    sequence = replace(sequence, gimbal=track_of(R_cam_ned, sequence.frame0_ns, sequence.fps))
    faster = at_speed(sequence, speed, tmp_path)
    assert sequence.gimbal is not None
    assert faster.gimbal is not None
    for frame in range(0, 150, 20):
        before = sequence.gimbal.at(sequence.frame0_ns + round(frame * 1e9 / sequence.fps))
        after = faster.gimbal.at(faster.frame0_ns + round(frame * 1e9 / faster.fps))
        assert rotation_angle(R_from_q_wxyz(after), R_from_q_wxyz(before)) < 1e-5


def test_velocity_at_another_speed_is_how_the_place_changes(tmp_path: Path) -> None:
    flown = read_telemetry(at_speed(read_sequence(BUNDLED_SEQUENCE), 2.0, tmp_path).telemetry_csv)
    step_ns = 200_000_000
    for t_ns in (500_000_000, 1_500_000_000):
        moved_m = flown.at(t_ns + step_ns).t_ned_body_m - flown.at(t_ns - step_ns).t_ned_body_m
        np.testing.assert_allclose(moved_m / (2e-9 * step_ns), flown.at(t_ns).v_ned_body_mps, atol=0.5)


def test_a_flight_is_scored_and_a_fault_that_is_not_met_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timeline = tmp_path / "impossible.toml"
    timeline.write_text(IMPOSSIBLE)
    code = main(["matrix", "--fault", "none", "--fault", str(timeline), "--out", str(tmp_path / "out"), "--json"])
    said = capsys.readouterr()
    flight, fault = json.loads(said.out)
    assert (flight["sequence"], flight["fault"], fault["fault"]) == ("crossing", "none", str(timeline))
    assert 0.0 <= flight["found"] <= 1.0
    # A machine under load may carry no pose in time; the table must then say so.
    assert (flight["poses"] == 0) == ("the autopilot received no pose" in flight["wrong"])
    assert fault["poses"] > 0
    assert fault["found"] is None
    assert "e[u]phoric" in fault["wrong"][0]
    assert fault["wrong"][0] in " ".join(said.err.split())
    assert code == 1
    assert json.loads((tmp_path / "out" / "matrix.json").read_text()) == [flight, fault]


def test_names_with_brackets_are_shown_as_they_are() -> None:
    shown = io.StringIO()
    Console(file=shown, width=160).print(table([Cell("hawks[a]/000001", 1.0, "faults[b].toml", ("none",))]))
    assert {"hawks[a]/000001", "faults[b].toml", "WRONG"} <= set(shown.getvalue().split())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--speed", "9"], "--speed 9"),
        (["--fault", "no-such-thing"], "no-such-thing"),
        (["--take", "0"], "--take 0"),
        (["--sequence", "nowhere"], "nowhere"),
        (["--dataset", str(BUNDLED_SEQUENCE), "--take", "2"], "holds 1 test sequences"),
    ],
)
def test_what_cannot_be_flown_is_named(
    arguments: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["matrix", *arguments, "--out", str(tmp_path)]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("false_alarm", [False, True])
def test_an_empty_sky_is_judged_by_its_false_poses(
    false_alarm: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sky = write_toy_flight(tmp_path / "sky", target=false_alarm, labelled=True)
    model = write_toy_model(tmp_path / "toy.onnx")
    flown = ["--sequence", str(sky), "--model", str(model)]
    faults = ["--fault", "none", "--fault", "mavlink-cut"]
    code = main(["matrix", *flown, *faults, "--out", str(tmp_path / "matrix"), "--json"])
    told = capsys.readouterr()
    (cell,) = json.loads(told.out)
    assert "sky: shows no target" in told.err
    assert (cell["poses"] > 0, code) == (false_alarm, int(false_alarm))
    played = main(["play", *flown, "--out", str(tmp_path / "play")])
    said = capsys.readouterr().err
    assert played == code
    for peer in ("subscriber", "autopilot"):
        assert (f"the {peer} received" in said) is false_alarm
        assert any(f"the {peer} received" in one for one in cell["wrong"]) is false_alarm


def test_faults_alone_of_an_empty_sky_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sky = write_toy_flight(tmp_path / "sky", target=False, labelled=True)
    assert main(["matrix", "--sequence", str(sky), "--fault", "mavlink-cut", "--out", str(tmp_path / "out")]) == 2
    assert "no sequence shows a target" in capsys.readouterr().err


def test_a_fault_that_the_host_does_not_allow_is_refused_before_anything_is_flown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = write_toy_flight(tmp_path / "toy")
    model, out = write_toy_model(tmp_path / "toy.onnx"), tmp_path / "out"
    monkeypatch.setenv("PATH", str(tmp_path))  # no unshare, as on a host that lets nobody mount
    faults = ["--fault", "none", "--fault", "disk-full"]
    assert main(["matrix", "--sequence", str(sequence), "--model", str(model), *faults, "--out", str(out)]) == 2
    told = capsys.readouterr()
    assert "--fault disk-full: needs a host that lets a user mount" in told.err
    assert told.out == ""
    assert not out.exists()


def test_what_was_flown_is_kept_when_a_later_sequence_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sound, torn = write_toy_flight(tmp_path / "sound"), write_toy_flight(tmp_path / "torn")
    (torn / "rgb/000000.png").write_bytes(b"no picture")
    model, out = write_toy_model(tmp_path / "toy.onnx"), tmp_path / "out"
    sequences = ["--sequence", str(sound), "--sequence", str(torn)]
    assert main(["matrix", *sequences, "--model", str(model), "--out", str(out)]) == 2
    assert "000000.png" in capsys.readouterr().err
    (flown,) = json.loads((out / "matrix.json").read_text())
    assert (flown["sequence"], flown["wrong"]) == ("sound", [])
    assert flown["poses"] > 0
