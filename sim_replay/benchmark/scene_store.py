"""A scene folder that may be interrupted at any time: finished frames stay readable, only the current one is lost.

While a scene is being generated, `.part/` in its folder contains a journal, one line for each finished frame, and
whatever else is needed to continue. Images are moved into place complete, then listed in the journal, then in the
indices. A finished scene has no `.part/` and contains exactly the same files as one generated without interruption.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.bop import BopFrame, SceneWriter
from sim_replay.bop.write import write_picture

INDICES = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
PICTURES = ("rgb", "mask", "mask_visib")
LAST_FILE = "sequence.toml"  # its presence means that the scene is finished

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def is_finished(folder: Path) -> bool:
    """Whether every frame of the scene and its other files are there."""
    return (folder / LAST_FILE).is_file()


class SceneStore:
    """One scene being generated, by one process at a time; use it in a `with` statement.

    Args:
        pictures: Whether images and masks are stored; without them only the indices are.
        keep_raw: Keep each image losslessly until the scene is finished, to pass the sequence through a video codec.
    """

    def __init__(self, folder: Path, jpeg_quality: int, pictures: bool = True, keep_raw: bool = False) -> None:
        self.folder, self._jpeg_quality = folder, jpeg_quality
        self._pictures, self._keep_raw = pictures, keep_raw
        self._part = folder / ".part"
        self._entries: dict[int, dict[str, str]] = {}
        self._lock: IO[str] | None = None

    def __enter__(self) -> SceneStore:
        for name in PICTURES if self._pictures else ():
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self._part.mkdir(parents=True, exist_ok=True)
        self._lock = (self._part / "lock").open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)  # the interrupted process may still be at its last frame
        self._entries = dict(_journal_entries(self._part / "journal.jsonl"))
        if self._keep_raw:  # a missing or truncated image is rendered again
            self._entries = {number: entry for number, entry in self._entries.items() if self._raw(number) is not None}
        text = "".join(_journal_line(number, entry) for number, entry in self._entries.items())
        replace_text(self._part / "journal.jsonl", text)
        self._write_indices()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._lock is not None:
            self._lock.close()

    @property
    def done(self) -> frozenset[int]:
        """Numbers of the frames that need not be generated again."""
        return frozenset(self._entries)

    def add(
        self, frame: BopFrame, image_bgr: Image | None, masks_visib: Sequence[Mask] = (), masks: Sequence[Mask] = ()
    ) -> None:
        """Store one frame; once this returns, it survives any interruption. Without pictures, the image may be None."""
        fresh = self._part / "frame"
        shutil.rmtree(fresh, ignore_errors=True)
        with SceneWriter(fresh, self._jpeg_quality) as writer:
            shown = np.zeros((1, 1, 3), np.uint8) if image_bgr is None else image_bgr
            writer.add(frame, shown, masks_visib, masks)
        entry = {name: _only_entry(fresh / name) for name in INDICES}
        if self._pictures and image_bgr is not None:
            for name in PICTURES:
                for path in (fresh / name).iterdir():
                    os.replace(path, self.folder / name / path.name)
            if self._keep_raw:
                self._store_raw(frame.image_id, image_bgr)
        with (self._part / "journal.jsonl").open("a", encoding="utf-8") as journal:
            journal.write(_journal_line(frame.image_id, entry))
        self._entries[frame.image_id] = entry
        self._write_indices()

    def raw_images(self) -> Iterator[Image]:
        """The images kept so far, in order."""
        for number in sorted(self._entries):
            pixels = self._raw(number)
            if pixels is None:
                raise OSError(f"{self._raw_path(number)} is not a readable picture")
            yield np.asarray(pixels, np.uint8)

    def replace_images(self, images: Iterator[Image]) -> None:
        """Replace the stored images by these, in order."""
        fresh = self._part / "replaced.jpg"
        for number, image in zip(sorted(self._entries), images, strict=True):
            write_picture(fresh, image, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])
            os.replace(fresh, self.folder / "rgb" / f"{number:06d}.jpg")

    def finish(self, files: Mapping[str, Callable[[Path], None]], last: str) -> None:
        """Write the scene's other files, each by its function, then LAST_FILE with the text `last`; clean up."""
        for name, write in files.items():
            write(self.folder / name)
        replace_text(self.folder / LAST_FILE, last)
        shutil.rmtree(self._part)

    def _raw_path(self, number: int) -> Path:
        return self._part / "raw" / f"{number:06d}.png"

    def _store_raw(self, number: int, image_bgr: Image) -> None:
        path = self._raw_path(number)
        path.parent.mkdir(exist_ok=True)
        write_picture(path, image_bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])

    def _raw(self, number: int) -> Image | None:
        """None if there is no readable one."""
        path = self._raw_path(number)
        return cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None  # type: ignore[return-value]

    def _write_indices(self) -> None:
        for name in INDICES:
            lines = ",\n".join(f'  "{number}": {self._entries[number][name]}' for number in sorted(self._entries))
            replace_text(self.folder / name, "{\n" + lines + "\n}\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file atomically: at any time, a reader sees the old one or the new one."""
    fresh = path.with_name(f".{path.name}.new")
    fresh.write_text(text, encoding="utf-8")
    os.replace(fresh, path)


def _only_entry(path: Path) -> str:
    (entry,) = json.loads(path.read_text(encoding="utf-8")).values()
    return json.dumps(entry)


def _journal_line(number: int, entry: Mapping[str, str]) -> str:
    return json.dumps({"frame": number, **entry}) + "\n"


def _journal_entries(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """The complete lines of a journal; a truncated one is ignored."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            record: dict[str, Any] = json.loads(line)
            yield int(record["frame"]), {name: str(record[name]) for name in INDICES}
        except (ValueError, KeyError, TypeError):
            continue
