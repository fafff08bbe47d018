"""A lock file: who holds it works alone. The lock goes with the process, however that ends."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO


def take_lock(path: Path) -> IO[str] | None:
    """The file at `path`, locked until it is closed, before which its holder may remove it; None where another process
    holds it. Raises OSError."""
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
        lock.close()  # its holder removed it since it was opened: it would keep nobody out


def _is_at(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False
