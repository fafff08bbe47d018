"""The folder of recordings: numbered files, and the room that they may take."""

from __future__ import annotations

import logging
import re
import shutil
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from msgs.mcap_file import McapFile, finish_unfinished, is_written

log = logging.getLogger(__name__)

WhenFull = Literal["oldest", "stop"]
Tell = Callable[[int, str], None]


@dataclass(frozen=True)
class RecordingLimits:
    """When to start a new file, and how much disk space all files may use."""

    file_bytes_max: int = 256 * 1024**2
    file_seconds_max: float = 600.0
    total_bytes_max: int | None = None  # of all files of this recorder; None: limited only by free_bytes_min
    free_bytes_min: int = 1024**3  # to be left free on the disk
    when_full: WhenFull = "oldest"  # remove the oldest recordings, or stop


class Store:
    """The folder of numbered files, the oldest removed first. Numbered, since a clock may be wrong or be set back.

    Other recorders may write into it at the same time: their files count, but are not removed until they are closed.
    """

    def __init__(self, folder: Path, stem: str, limits: RecordingLimits, tell: Tell) -> None:
        self._folder = folder
        self._stem = stem
        self._limits = limits
        self._tell = tell
        # Down to the last letter: files of a vehicle called `<stem>_000001` are not ours.
        self._name = re.compile(rf"{re.escape(stem)}_(\d{{6,}})_\d{{8}}T\d{{6}}Z\.mcap")

    def files(self) -> list[Path]:
        """This recorder's files, oldest first."""
        numbered = [
            (int(match[1]), path) for path in self._folder.iterdir() if (match := self._name.fullmatch(path.name))
        ]
        return [path for _, path in sorted(numbered)]

    def finish_unfinished(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        for path in self.files():
            try:
                finish_unfinished(path)
            except OSError as error:
                # A file that cannot be repaired must not prevent recording.
                log.warning("%s is left unfinished: %s", path, error)

    def new_file(self) -> McapFile:
        """The next in number. Raises OSError."""
        while True:
            files = self.files()
            last = self._name.fullmatch(files[-1].name) if files else None
            number = int(last[1]) + 1 if last is not None else 0
            began = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
            with suppress(FileExistsError):  # another recorder has just begun this one
                return McapFile(self._folder / f"{self._stem}_{number:06d}_{began}.mcap")

    def make_room(self) -> None:
        """Enforce the limits, by removing the oldest files if allowed. Raises OSError if there is no room.

        Nothing is removed if removing all files would not suffice, as on a disk filled by other data.
        """
        if (short := self._bytes_short()) <= 0:
            return
        files = deque(self._removable()) if self._limits.when_full == "oldest" else deque[Path]()
        removed = []
        try:
            while short > 0:
                if sum(map(_size_of, files)) < short:
                    raise OSError("no room left for recordings")
                path = files.popleft()
                with suppress(OSError):  # if it cannot be removed, the next may be
                    path.unlink()
                    removed.append(path.name)
                short = self._bytes_short()
        finally:
            if removed:
                text = f"old recordings removed to make room: {len(removed)}, up to {removed[-1]}"
                self._tell(logging.INFO, text)

    def _removable(self) -> list[Path]:
        """This recorder's closed files, oldest first."""
        removable = []
        for path in self.files():
            with suppress(OSError):
                if not is_written(path):
                    removable.append(path)
        return removable

    def _bytes_short(self) -> int:
        """Bytes that must be removed to meet all limits."""
        short = self._limits.free_bytes_min - shutil.disk_usage(self._folder).free
        if (total_max := self._limits.total_bytes_max) is not None:
            short = max(short, sum(map(_size_of, self.files())) - total_max)
        return short


def _size_of(path: Path) -> int:
    """Size in bytes; 0 if it cannot be read."""
    with suppress(OSError):
        return path.lstat().st_size
    return 0
