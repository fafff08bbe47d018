"""What a dataset says of itself any reader of TOML takes; what a worker is given and cannot use is told by its name."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

import pytest

from sim_replay.benchmark.plan import plan_dataset
from sim_replay.benchmark.preset import parse_preset
from sim_replay.cli import main

PRESET = """
name = "mine"
size_wh_px = [64, 64]
sequence_frames = [2, 2]
[splits]
test = { sequences = 1, frames = 2 }
[airframes]
only = ["light_aircraft"]
[picture]
weather = { clear = 1 }
quality = { ordinary = 1 }
"""


def test_the_command_is_told_as_it_was_given(tmp_path: Path) -> None:
    preset = tmp_path / 'of "Müller" \\new\\it\'s.toml'
    preset.write_text(PRESET)
    out = tmp_path / "data"
    words = ["generate", "--preset", str(preset), "--seed", "4"]
    assert main([*words, "--out", str(out), "--labels-only", "--workers", "1"]) == 0
    for path in (out / "dataset.toml", out / "test" / "000000" / "sequence.toml"):
        told = tomllib.loads(path.read_text(encoding="utf-8"))["command"]
        assert shlex.split(told) == ["uavpose-replay", *words, "--labels-only"]


def test_a_photograph_that_a_worker_cannot_read_is_told_as_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(PRESET)
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    (photographs / "torn.jpg").write_bytes(b"\xff\xd8 no more")
    preset = parse_preset("mine.toml", PRESET)
    # Half of the sequences take a photograph; here is a seed of one that does.
    seed = next(s for s in range(20) if plan_dataset(preset, s)[0].environment_seed // 2 % 2)
    words = ["generate", "--preset", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "data")]
    assert main([*words, "--seed", str(seed), "--backdrops", str(photographs), "--workers", "1"]) == 2
    told = capsys.readouterr().err
    assert "torn.jpg is not a readable picture" in told
    assert "--resume" not in told
