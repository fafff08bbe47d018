"""A lock file that gives its holder exclusive access. The lock ends with the process, however that ends."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO


def take_lock(path: Path) -> IO[str] | None:
    """The file at `path`, locked until it is closed; its holder may remove it before that. None if another process
    holds it. Raises OSError.
    """
    while True:
        lock = path.open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(path, lock):
                return lock
        except BlockingIOError:
            lock.close()
            return None
        except OSError:
            lock.close()
            raise
        lock.close()  # removed by its holder since it was opened: this lock would exclude nobody


def _is_at(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
