"""A lock file keeps a second run out, also one that comes as the first goes."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO

import pytest

from sim_replay.lock import take_lock


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
