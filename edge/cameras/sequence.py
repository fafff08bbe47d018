"""A BOP scene played in real time: frame k is exposed at start + k / fps on the monotonic clock."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.cameras.intrinsics import Undistorter, load_intrinsics
from edge.cameras.source import EndOfStream, wait_until
from edge.config import SequenceCamera
from edge.errors import InputError
from edge.types import Array, CameraInfo, Frame, FrameMeta

DECODED_AHEAD = 2


class SequenceSource:
    """Hands no frame over before its exposure; a reader that is late finds the newest exposed, as with a camera."""

    def __init__(self, settings: SequenceCamera) -> None:
        self._settings = settings
        self._paths: list[Path] = []
        self._K: list[Array] = []
        self._undistort: Undistorter | None = None
        self._image_size_wh = (0, 0)
        self._start_ns: int | None = None
        self._next = 0
        self._ahead: deque[tuple[int, Future[NDArray[np.uint8]]]] = deque()
        self._decoder: ThreadPoolExecutor | None = None

    def open(self) -> CameraInfo:
        """Read the scene's index and first picture. Raises InputError."""
        folder = self._settings.path
        self._paths, self._K = read_scene(folder)
        first = _decode(self._paths[0])
        self._image_size_wh = (first.shape[1], first.shape[0])
        if self._settings.intrinsics is not None:
            intrinsics = load_intrinsics(self._settings.intrinsics).scaled_to(self._image_size_wh)
            self._K = [intrinsics.K] * len(self._paths)
            self._undistort = Undistorter(intrinsics)
        self._decoder = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
        self._start_ns, self._next = self._settings.start_at_ns, 0
        self._ahead.clear()
        self._decode_ahead(self._next)
        return CameraInfo(folder.name, self._image_size_wh, self._K[0], self._settings.fps)

    def read(self, stop: threading.Event) -> Frame:
        """The next exposed frame. Raises EndOfStream after the last, InputError on an unreadable picture."""
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        index = self._next
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
        if (image_bgr.shape[1], image_bgr.shape[0]) != self._image_size_wh:
            raise InputError(f"{self._path(index)} differs in size from the first picture of the scene")
        self._next = index + 1
        self._decode_ahead(self._next)
        meta = FrameMeta(index, capture_ns, time.monotonic_ns())
        return Frame(meta, image_bgr, self._K[index % len(self._K)])

    def close(self) -> None:
        if self._decoder is not None:
            self._decoder.shutdown(wait=True, cancel_futures=True)
            self._decoder = None

    def _exists(self, index: int) -> bool:
        return self._settings.loop or index < len(self._paths)

    def _path(self, index: int) -> Path:
        return self._paths[index % len(self._paths)]

    def _exposure_ns(self, index: int) -> int:
        assert self._start_ns is not None
        return self._start_ns + round(index * 1e9 / self._settings.fps)

    def _decode_ahead(self, index: int) -> None:
        assert self._decoder is not None
        wanted = self._ahead[-1][0] + 1 if self._ahead else index
        while len(self._ahead) < DECODED_AHEAD and self._exists(wanted):
            self._ahead.append((wanted, self._decoder.submit(self._picture, self._path(wanted))))
            wanted += 1

    def _picture(self, path: Path) -> NDArray[np.uint8]:
        image_bgr = _decode(path)
        return self._undistort(image_bgr) if self._undistort is not None else image_bgr


def read_scene(folder: Path) -> tuple[list[Path], list[Array]]:
    """Pictures of a BOP scene in order and K [3, 3] of each (bop_datasets_format: scene_camera.json).

    Raises InputError when the folder is no such scene.
    """
    index = folder / "scene_camera.json"
    try:
        cameras = json.loads(index.read_text(encoding="utf-8"))
        K = {int(key): np.array(value["cam_K"], dtype=np.float64).reshape(3, 3) for key, value in cameras.items()}
    except OSError as error:
        raise InputError(f"{folder} is no BOP scene: scene_camera.json cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{index} is not as BOP writes it: {error!r}") from error
    pictures = {int(path.stem): path for path in (folder / "rgb").glob("*") if path.stem.isdigit()}
    if not pictures:
        raise InputError(f"{folder} has no pictures in rgb/")
    missing = sorted(set(pictures) - set(K))
    if missing:
        raise InputError(f"{index} has no camera for picture {missing[0]}")
    order = sorted(pictures)
    return [pictures[i] for i in order], [K[i] for i in order]


def _decode(path: Path) -> NDArray[np.uint8]:
    image_bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image_bgr is None:
        raise InputError(f"{path} is not a readable picture")
    return np.asarray(image_bgr, dtype=np.uint8)
