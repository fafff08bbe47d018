"""A disk that is full ends a command in a sentence, and what was whole before it stays so.

A limit on the size of files stands for the disk.
"""

from __future__ import annotations

import re
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import synthetic_sampler
import tiny

from trainer.checkpoint import save_weights
from trainer.cli import main
from trainer.config import ConfigError, parse_config
from trainer.train import run_training
from trainer.trainer import Trainer

ROOM_BYTES = 200_000  # less than any file of the tiny network


@contextmanager
def full_disk(room_bytes: int = ROOM_BYTES) -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def weights(folder: Path, seed: int) -> Path:
    save_weights(folder / "weights.pt", tiny.network(seed), tiny.TOML, {"seed": 3, "samples": 9})
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def train(out: Path, **options: Any) -> Trainer:
    config, opener = parse_config(tiny.TOML, "tiny.toml"), synthetic_sampler.opener
    return run_training(config, tiny.TOML, out, open_sampler=opener, max_steps=1, **options)


def test_training_ends_with_the_files_reason_and_goes_on_from_its_last_checkpoint(tmp_path: Path) -> None:
    assert train(tmp_path).samples == 4
    before = files(tmp_path)
    with full_disk(), pytest.raises(ConfigError, match=r"weights\.pt: cannot be written: File too large"):
        train(tmp_path, resume=True)
    after = files(tmp_path)
    assert after.keys() == before.keys()
    assert [after[name] == before[name] for name in ("weights.pt", "resume.pt")] == [True, True]
    with full_disk(100), pytest.raises(ConfigError, match=r"config\.toml: cannot be written: File too large"):
        train(tmp_path, resume=True)
    assert files(tmp_path) == after
    assert train(tmp_path, resume=True).samples == 8


def test_the_weights_of_a_run_whose_first_checkpoint_found_no_room_are_kept_and_another_run_begins_with_them(
    tmp_path: Path,
) -> None:
    out, saved = tmp_path / "run", tmp_path / "run" / "weights.pt"
    room_bytes = (weights(tmp_path / "like", seed=0) / "weights.pt").stat().st_size * 2
    with full_disk(room_bytes), pytest.raises(ConfigError, match=r"resume\.pt: cannot be written: File too large"):
        train(out)
    before = files(out)
    told = f"{out}: already contains weights, but no resume.pt to continue from; give another --out, and --start-from "
    for resume in (False, True):
        with pytest.raises(ConfigError, match=re.escape(f"{told}{saved} ")):
            train(out, resume=resume)
    assert files(out) == before
    assert train(tmp_path / "other", start_from=saved).samples_before == 4


def test_commands_that_write_networks_say_so_and_leave_no_torn_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(weights(tmp_path / name, seed=0)) for name in ("one", "two")]
    commands = {
        "mean": ["average", *runs, "--out", str(tmp_path / "mean")],
        "models": ["export", "--unmeasured", "--checkpoint", runs[0], "--out", str(tmp_path / "models")],
    }
    for name, command in commands.items():
        assert main(command) == 0
        before = files(tmp_path / name)
        with full_disk():
            assert main(command) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        assert told.startswith(f"uavpose-trainer: {tmp_path / name}")
        assert told.endswith(": cannot be written: File too large")
        assert files(tmp_path / name) == before
