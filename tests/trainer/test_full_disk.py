"""A disk that is full ends a command in a sentence, and what was whole before it stays so.

A limit on the size of files stands for the disk.
"""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import synthetic_sampler
import tiny

from trainer.checkpoint import save_weights
from trainer.cli import main
from trainer.config import ConfigError, parse_config
from trainer.train import run_training

ROOM_BYTES = 200_000  # less than any file of the tiny network


@contextmanager
def full_disk() -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM_BYTES, limits[1]))
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


def test_training_ends_with_the_files_reason_and_goes_on_from_its_last_checkpoint(tmp_path: Path) -> None:
    def train(resume: bool, max_steps: int) -> int:
        config = parse_config(tiny.TOML, "tiny.toml")
        opener = synthetic_sampler.opener
        return run_training(
            config, tiny.TOML, tmp_path, open_sampler=opener, resume=resume, max_steps=max_steps
        ).samples

    assert train(resume=False, max_steps=1) == 4
    before = files(tmp_path)
    with full_disk(), pytest.raises(ConfigError, match=r"weights\.pt: cannot be written: File too large"):
        train(resume=True, max_steps=1)
    after = files(tmp_path)
    assert after.keys() == before.keys()
    assert [after[name] == before[name] for name in ("weights.pt", "resume.pt")] == [True, True]
    assert train(resume=True, max_steps=1) == 8


def test_commands_that_write_networks_say_so_and_leave_no_torn_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(weights(tmp_path / name, seed)) for seed, name in enumerate(("one", "two"))]
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
