"""A lock file keeps a second run out, also one that comes as the first goes."""

from __future__ import annotations

import fcntl
from contextlib import closing
from pathlib import Path
from typing import IO

import pytest

from sim_replay.cli import main
from sim_replay.lock import LOCK_FILE, take_lock


def test_one_at_a_time_holds_it(tmp_path: Path) -> None:
    first = take_lock(tmp_path / "lock")
    assert first is not None
    assert take_lock(tmp_path / "lock") is None
    first.close()
    second = take_lock(tmp_path / "lock")
    assert second is not None
    second.close()


def test_a_file_that_its_holder_removes_meanwhile_is_not_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between opening and locking it: else a third finds no file, makes one, and works beside the second."""
    path, flock = tmp_path / "lock", fcntl.flock
    leaving = [path]

    def after_its_holder_left(file: IO[str], operation: int) -> None:
        while leaving:
            leaving.pop().unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", after_its_holder_left)
    second = take_lock(path)
    assert second is not None
    assert take_lock(path) is None
    second.close()


@pytest.mark.parametrize("command", ["demo", "play", "golden", "matrix", "soak", "bench-pipeline", "faults"])
def test_two_replays_do_not_write_one_folder(tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each would remove and overwrite the other's files: of neither would the score be."""
    needed = ["--timeline", "flood"] if command == "faults" else []
    with closing(take_lock(tmp_path / LOCK_FILE)):
        assert main([command, *needed, "--out", str(tmp_path)]) == 2
    assert capsys.readouterr() == ("", f"{tmp_path}: another replay is at work there\n")


def test_a_folder_for_nothing_is_not_made(tmp_path: Path) -> None:
    assert main(["play", "--sequence", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
