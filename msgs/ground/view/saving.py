"""`--save`: writes a file for Rerun's viewer atomically."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr

from msgs.ground.errors import InputError

_CHUNK_BYTES = 1 << 20


class _Writer(threading.Thread):
    """Copies a pipe to `path`. If writing fails, it stores the `error` and discards the rest."""

    def __init__(self, source: int, path: Path, stop: threading.Event) -> None:
        super().__init__(name="save", daemon=True)
        self.error: OSError | None = None
        self._source, self._path, self._stop_all = source, path, stop

    def run(self) -> None:
        with open(self._source, "rb", buffering=0) as source:
            try:
                with self._path.open("wb") as file:
                    shutil.copyfileobj(source, file, _CHUNK_BYTES)
            except OSError as error:
                self.error = error
                self._stop_all.set()
                while source.read(_CHUNK_BYTES):
                    pass


@contextmanager
def saved(rec: rr.RecordingStream, path: Path, stop: threading.Event, complete: Callable[[], bool]) -> Iterator[None]:
    """Save what is logged inside to `path`, which is replaced only when everything is written.

    An incomplete recording (an exception, or not `complete`) is kept only if no file was there before. Sets `stop` on a
    write error. Raises InputError, leaving no temporary file behind.
    """
    whole = Path(os.path.realpath(path))  # keeps a symbolic link
    if os.path.exists(whole) and not whole.is_file():
        raise InputError(f"--save {path}: exists and is not a regular file")
    unfinished, replaces = whole.with_name(f".{whole.name}.part"), os.path.exists(whole)
    try:
        unfinished.touch()
    except OSError as error:
        raise _unwritable(path, error) from error
    # Rerun does not report a full disk and then hangs; so it writes to a pipe, and we write the file.
    read_end, write_end = os.pipe()
    writer = _Writer(read_end, unfinished, stop)
    writer.start()
    try:
        try:
            rec.save(f"/dev/fd/{write_end}")
        finally:
            os.close(write_end)
        broken: BaseException | None = None
        try:
            yield
        except BaseException as error:
            broken = error
        rec.disconnect()
        writer.join()
        if writer.error is not None:
            raise _unwritable(path, writer.error) from writer.error
        kept = replaces and not (broken is None and complete())
        if not kept:
            _put(unfinished, whole, path)
        if broken is not None:
            raise broken
        if kept:
            raise InputError(
                f"--save {path}: stopped before everything was drawn, or nothing was drawn; the existing file is kept"
            )
    finally:
        rec.disconnect()
        writer.join()
        unfinished.unlink(missing_ok=True)


def _put(unfinished: Path, whole: Path, asked: Path) -> None:
    try:
        os.replace(unfinished, whole)
    except OSError as error:
        raise _unwritable(asked, error) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"--save {path}: cannot be written: {error.strerror}")
