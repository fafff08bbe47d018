"""A lock file that gives its holder exclusive access, to a folder for example. The lock ends with the process, however
that ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from edge.errors import InputError

LOCK_FILE = ".lock"


@contextmanager
def alone_in(folder: Path, who: str) -> Iterator[None]:
    """Makes a folder and keeps every other process out that asks for this. One that was made and is still empty in the
    end is removed. Raises InputError if another `who` is at work there, or the folder cannot be written."""
    path, made = folder / LOCK_FILE, not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = take_lock(path)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    if lock is None:
        raise InputError(f"{folder}: another {who} is at work there")
    with lock:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            if made:
                with suppress(OSError):  # it is not empty
                    folder.rmdir()


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
