"""A video file, played at its own rate on the monotonic clock."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter

import cv2
import numpy as np

from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.source import EndOfStream, wait_until
from edge.config_camera import FileCamera
from edge.errors import InputError
from edge.types import CameraInfo, Frame, FrameMeta

# What is skipped is decoded all the same: a video that decodes slower than its rate never catches up.
SKIPPING_MAX_NS = 250_000_000


class FileSource:
    """Frame k is taken as exposed at start + k / fps; frames a late reader missed are skipped, as with a camera.

    Where skipping takes too long, the frame is an old one and says so by its stamp.
    """

    live = False

    def __init__(self, settings: FileCamera) -> None:
        self._settings = settings
        self._capture: cv2.VideoCapture | None = None
        self._start_ns: int | None = None
        self._next = 0
        self.counts: Counter[str] = Counter()

    def open(self) -> CameraInfo:
        """Raises InputError: no video, no frame rate, or intrinsics that do not fit."""
        path = self._settings.path
        if not path.is_file():
            raise InputError(f"{path} does not exist")
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise InputError(f"{path} is not a readable video")
        self._fps = self._capture.get(cv2.CAP_PROP_FPS)
        if not math.isfinite(self._fps) or not 0 < self._fps <= 1000:
            raise InputError(f"{path} does not say its frame rate")
        self._frames = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))  # not above 0: not known
        size_wh = (
            int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        self._intrinsics = load_intrinsics(self._settings.intrinsics).scaled_to(size_wh)
        self._start_ns, self._next = None, 0
        return CameraInfo(path.name, size_wh, self._intrinsics.K, self._fps, self._intrinsics.distortion)

    def read(self, stop: threading.Event) -> Frame:
        """The next frame, not before its time. Raises EndOfStream after the last, InputError if none can be read."""
        assert self._capture is not None
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        skipping_until_ns = time.monotonic_ns() + SKIPPING_MAX_NS
        while self._follows(self._next) and self._exposure_ns(self._next + 1) <= (now_ns := time.monotonic_ns()):
            if stop.is_set() or now_ns >= skipping_until_ns or not self._capture.grab():
                break
            self._next += 1
        capture_ns = self._exposure_ns(self._next)
        wait_until(capture_ns, stop)
        read, image_bgr = self._capture.read()
        if not read:
            if self._next == 0:
                raise InputError(f"{self._settings.path} has no readable frame")
            raise EndOfStream
        meta = FrameMeta(self._next, capture_ns, time.monotonic_ns())
        self._next += 1
        image = np.asarray(image_bgr, dtype=np.uint8)
        return Frame(meta, image, self._intrinsics.K, self._intrinsics.distortion)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _follows(self, index: int) -> bool:
        """Whether another frame comes after this one: the last is not skipped, however late the reader."""
        return self._frames <= 0 or index + 1 < self._frames

    def _exposure_ns(self, index: int) -> int:
        assert self._start_ns is not None
        return self._start_ns + round(index * 1e9 / self._fps)
