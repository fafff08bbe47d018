"""A BOP scene played in real time: frame k is exposed at start + k / fps on the monotonic clock.

A scene made from a recording lacks pictures of frames that were not recorded: for the reader, these were dropped.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import tomllib
from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge import clock
from edge.cameras.intrinsics import load_intrinsics, pinhole
from edge.cameras.picture_file import read_8_bits
from edge.cameras.source import EndOfStream, wait_until
from edge.config_camera import FolderCamera, SequenceCamera
from edge.errors import InputError
from edge.types import Array, CameraInfo, Frame, FrameMeta

log = logging.getLogger(__name__)

DECODED_AHEAD = 2
OFF_CENTRE_SHARE = 0.2  # of the sides; that of a camera of twice or half the size lies half or a quarter of them away
DISTORTION_KEY = "dist_k1_k2_p1_p2_k3"  # of scene_camera.json; BOP itself has pinhole cameras only
SOURCE_KEY = "source"  # of sequence.toml, in scenes made from a video or a recording: what was filmed
PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})


@dataclass(frozen=True, eq=False)
class ScenePicture:
    """A picture of a BOP scene and the camera that took it."""

    path: Path
    K: Array  # [3, 3], pixel centres at integers
    distortion: tuple[float, ...]  # k1 k2 p1 p2 k3; empty: none
    frame: int | None = None  # number in the sequence, from 0; None: the picture's index


class SequenceSource:
    """Delivers no frame before its exposure time; a late reader gets the newest one exposed, as with a camera."""

    live = False

    def __init__(self, settings: SequenceCamera | FolderCamera) -> None:
        self._settings = settings
        self.counts: Counter[str] = Counter()
        self._pictures: list[ScenePicture] = []
        self._frames: list[int] = []  # frame number of each picture in the sequence
        self._image_size_wh = (0, 0)
        self._start_ns: int | None = None
        self._next = 0
        self._ahead: deque[tuple[int, Future[NDArray[np.uint8]]]] = deque()
        self._decoder: ThreadPoolExecutor | None = None

    def open(self) -> CameraInfo:
        """Read the scene's index and first picture. Raises InputError."""
        folder = self._settings.path
        self._pictures = self._list(folder)
        first = _decode(self._pictures[0].path)
        self._image_size_wh = (first.shape[1], first.shape[0])
        if self._settings.intrinsics is not None:
            given = load_intrinsics(self._settings.intrinsics).scaled_to(self._image_size_wh)
            self._pictures = [replace(p, K=given.K, distortion=given.distortion) for p in self._pictures]
        elif (np.abs((self._pictures[0].K[:2, 2] + 0.5) / self._image_size_wh - 0.5) > OFF_CENTRE_SHARE).any():
            log.warning(
                "%s: the principal point (%g, %g) is far from the middle of pictures of %dx%d: "
                "unless they were cropped, its cam_K is for another size",
                *(folder, *self._pictures[0].K[:2, 2], *self._image_size_wh),
            )
        self._frames = [index if p.frame is None else p.frame for index, p in enumerate(self._pictures)]
        self._decoder = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
        self._start_ns, self._next = self._settings.start_at_ns, 0
        self._ahead.clear()
        self._decode_ahead(self._next)
        K, distortion = self._pictures[0].K, self._pictures[0].distortion
        return CameraInfo(folder.name, self._image_size_wh, K, self._settings.fps, distortion)

    def read(self, stop: threading.Event) -> Frame:
        """The next exposed frame. Raises EndOfStream after the last, InputError on an unreadable picture."""
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        index = self._next + self._rounds_missed(self._next) * len(self._frames)
        while self._exists(index + 1) and self._exposure_ns(index + 1) <= time.monotonic_ns():
            index += 1
        if not self._exists(index):
            raise EndOfStream
        while self._ahead and self._ahead[0][0] < index:
            self._ahead.popleft()[1].cancel()
        self._decode_ahead(index)
        capture_ns = self._exposure_ns(index)
        wait_until(capture_ns, stop)
        image_bgr = self._ahead.popleft()[1].result()
        self._next = index + 1
        self._decode_ahead(self._next)
        return self._shown(self._at(index), image_bgr, FrameMeta(self._frame(index), capture_ns, time.monotonic_ns()))

    def exposed_now(self, index: int, sequence: int) -> Frame:
        """Frame `index` as if exposed now, with the sequence number `sequence`. Raises InputError."""
        frames = self._frames[-1] + 1
        wanted = index % frames if self._settings.loop else index
        if wanted not in self._frames:
            raise InputError(f"{self._settings.path} has no picture {index} among its {frames} frames")
        picture, now_ns = self._pictures[self._frames.index(wanted)], clock.monotonic_ns()
        return self._shown(picture, _decode(picture.path), FrameMeta(sequence, now_ns, now_ns))

    def close(self) -> None:
        if self._decoder is not None:
            self._decoder.shutdown(wait=True, cancel_futures=True)
            self._decoder = None

    def _list(self, folder: Path) -> list[ScenePicture]:
        """Raises InputError if the folder holds none."""
        return read_scene(folder)

    def _shown(self, picture: ScenePicture, image_bgr: NDArray[np.uint8], meta: FrameMeta) -> Frame:
        """Raises InputError for a picture that does not have the size of the first."""
        if (image_bgr.shape[1], image_bgr.shape[0]) != self._image_size_wh:
            raise InputError(f"{picture.path} differs in size from the first picture of the scene")
        return Frame(meta, image_bgr, picture.K, picture.distortion)

    def _exists(self, index: int) -> bool:
        return self._settings.loop or index < len(self._pictures)

    def _at(self, index: int) -> ScenePicture:
        return self._pictures[index % len(self._pictures)]

    def _frame(self, index: int) -> int:
        """Frame number of a picture, continuing from loop to loop."""
        rounds, within = divmod(index, len(self._frames))
        return rounds * (self._frames[-1] + 1) + self._frames[within]

    def _exposure_ns(self, index: int) -> int:
        assert self._start_ns is not None
        return self._start_ns + round(self._frame(index) * 1e9 / self._settings.fps)

    def _rounds_missed(self, index: int) -> int:
        """Whole rounds of a loop since the exposure of picture `index`. Looking for the newest one frame by frame would
        take minutes in a loop that began weeks ago."""
        late_ns = time.monotonic_ns() - self._exposure_ns(index)
        round_ns = (self._frames[-1] + 1) * 1e9 / self._settings.fps
        return max(int(late_ns / round_ns), 0) if self._settings.loop else 0

    def _decode_ahead(self, index: int) -> None:
        assert self._decoder is not None
        wanted = self._ahead[-1][0] + 1 if self._ahead else index
        while len(self._ahead) < DECODED_AHEAD and self._exists(wanted):
            self._ahead.append((wanted, self._decoder.submit(_decode, self._at(wanted).path)))
            wanted += 1


def read_scene(folder: Path) -> list[ScenePicture]:
    """Pictures of a BOP scene (bop_datasets_format: scene_camera.json, rgb/ or gray/), sorted by number.

    Raises InputError with file and key if the folder is not such a scene.
    """
    index = folder / "scene_camera.json"
    try:
        cameras = json.loads(index.read_text(encoding="utf-8"))
        lenses = {int(key): _camera(index, key, entry) for key, entry in cameras.items()}
    except OSError as error:
        raise InputError(f"{folder} is no BOP scene: scene_camera.json cannot be read: {error.strerror}") from error
    except (ValueError, AttributeError) as error:
        raise InputError(f"{index} is not as BOP writes it: {error!r}") from error
    paths = {
        int(path.stem): path
        for name in ("gray", "rgb")  # the latter wins if a frame has both
        for path in sorted((folder / name).glob("*"), reverse=True)
        if path.stem.isdecimal() and path.suffix.lower() in PICTURE_SUFFIXES
    }
    if not paths:
        raise InputError(f"{folder} has no pictures in rgb/ or gray/")
    missing = sorted(set(paths) - set(lenses))
    if missing:
        raise InputError(f"{index} has no camera for picture {missing[0]}")
    numbers = sorted(paths)
    frames = frames_of(folder, numbers)
    return [ScenePicture(paths[number], *lenses[number], frame) for number, frame in zip(numbers, frames, strict=True)]


def frames_of(folder: Path, numbers: Sequence[int]) -> list[int]:
    """Frame number of each picture in the sequence, from 0; `numbers`: of the scene's pictures, sorted.

    Pictures are consecutive frames, whatever their numbers, except in a scene made from a recording: there a missing
    number is a frame that was not recorded. Raises InputError if sequence.toml cannot be read.
    """
    path = folder / "sequence.toml"
    try:
        recorded = SOURCE_KEY in tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        recorded = False
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    return [number - numbers[0] for number in numbers] if recorded else list(range(len(numbers)))


def _camera(index: Path, key: str, entry: object) -> tuple[Array, tuple[float, ...]]:
    """K [3, 3] and distortion of one picture's entry. Raises InputError."""
    if not isinstance(entry, dict) or "cam_K" not in entry:
        raise InputError(f"{index}: {key!r} has no 'cam_K'")
    K = pinhole(_flat(entry["cam_K"]), f"{index}: 'cam_K' of {key!r}")
    distortion = _flat(entry.get(DISTORTION_KEY, ()))
    if (DISTORTION_KEY in entry and distortion.size != 5) or not np.isfinite(distortion).all():
        raise InputError(f"{index}: {DISTORTION_KEY!r} of {key!r} is not 5 finite numbers")
    return K, tuple(float(value) for value in distortion)


def _flat(numbers: object) -> Array:
    """[n]; a single NaN if these are not numbers."""
    try:
        return np.array(numbers, dtype=np.float64).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        return np.full(1, np.nan)


def _decode(path: Path) -> NDArray[np.uint8]:
    return read_8_bits(path, cv2.IMREAD_COLOR)
