"""A dataset says how it was made in TOML that any reader takes, whatever the preset's file is called."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

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
