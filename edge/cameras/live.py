"""Common base of V4L2 devices and network streams: OpenCV reads them, and both may disappear and return."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.cameras.intrinsics import Intrinsics
from edge.cameras.source import EndOfStream, SourceLost
from edge.cameras.video import UNDECODABLE_MAX
from edge.clock import SleepWatch
from edge.errors import InputError
from edge.types import CameraInfo, Frame, FrameMeta


class LiveSource(ABC):
    """Frames as they arrive. Subclasses define how the camera is opened (`_connect`) and timed (`_exposure_ns`)."""

    live = True

    def __init__(self, name: str, intrinsics: Intrinsics) -> None:
        self._name = name
        self._intrinsics = intrinsics
        self._capture: cv2.VideoCapture | None = None
        self._sequence = 0
        self._fitted = intrinsics
        self._sleep = SleepWatch()
        self.counts: Counter[str] = Counter(unstamped=0, undecodable=0)

    def nominal(self) -> CameraInfo:
        """Properties before the camera answers: those of the calibration."""
        return self._info(self._intrinsics, None)

    def open(self) -> CameraInfo:
        """Raises SourceLost if the camera does not answer, InputError if the intrinsics do not fit its picture."""
        capture = self._connect()
        if not capture.isOpened():
            capture.release()
            raise SourceLost(f"{self._name} does not open")
        size_wh = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if min(size_wh) <= 0:
            capture.release()
            raise SourceLost(f"{self._name} does not say the size of its picture")
        try:
            self._fitted = self._intrinsics.scaled_to(size_wh)
        except InputError:
            capture.release()
            raise
        self._capture = capture
        self._sleep.slept_ns()  # until now, nothing has waited to be read
        fps = capture.get(cv2.CAP_PROP_FPS)
        return self._info(self._fitted, fps if fps > 0 else None)

    def read(self, stop: threading.Event) -> Frame:
        """The next frame that can be decoded; others are skipped and counted, and use up sequence numbers.

        Raises SourceLost if none arrives, or none that can be decoded, or if the computer has slept meanwhile.
        """
        assert self._capture is not None
        why, missed = "", 0
        for _ in range(UNDECODABLE_MAX):
            grabbed = self._capture.grab()
            arrival_ns = time.monotonic_ns()
            if stop.is_set():
                raise EndOfStream
            if not grabbed:
                missed += 1
                if missed == UNDECODABLE_MAX or not self._may_go_on():
                    raise SourceLost("the camera gives no more frames")
                continue
            if (slept_ns := self._sleep.slept_ns()) > 0:
                # What waited meanwhile, here or in a stream's server, is old, but not by the monotonic clock.
                raise SourceLost(f"the computer has slept for {slept_ns / 1e9:.1f} s")
            position_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
            image_bgr, why = _retrieved(self._capture)
            sequence = self._sequence + missed
            self._sequence = sequence + 1
            self.counts["undecodable"] += missed
            missed = 0
            if image_bgr is None:
                self.counts["undecodable"] += 1
                continue
            size_wh = (image_bgr.shape[1], image_bgr.shape[0])
            if size_wh != self._fitted.image_size_wh:
                self._fitted = self._refitted(size_wh)
            meta = FrameMeta(sequence, self._exposure_ns(arrival_ns, position_ms), arrival_ns)
            return Frame(meta, image_bgr, self._fitted.K, self._fitted.distortion)
        raise SourceLost(f"{UNDECODABLE_MAX} pictures in a row cannot be decoded{why}")

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _info(self, fitted: Intrinsics, fps: float | None) -> CameraInfo:
        return CameraInfo(self._name, fitted.image_size_wh, fitted.K, fps, fitted.distortion)

    def _refitted(self, size_wh: tuple[int, int]) -> Intrinsics:
        """Raises SourceLost if the intrinsics do not fit: when reopened, the camera may be in its usual mode again."""
        try:
            return self._intrinsics.scaled_to(size_wh)
        except InputError as error:
            raise SourceLost(f"a picture of another shape: {error}") from error

    def _may_go_on(self) -> bool:
        """Whether a picture may follow although none was grabbed."""
        return False

    @abstractmethod
    def _connect(self) -> cv2.VideoCapture:
        """Try to open the camera."""

    @abstractmethod
    def _exposure_ns(self, arrival_ns: int, position_ms: float) -> int:
        """Monotonic time of the exposure of the frame just grabbed; position_ms is OpenCV's CAP_PROP_POS_MSEC."""


def _retrieved(capture: cv2.VideoCapture) -> tuple[NDArray[np.uint8] | None, str]:
    """The picture just grabbed, or None and why it cannot be decoded, for example corrupted by a cable or a radio."""
    try:
        retrieved, image_bgr = capture.retrieve()
    except cv2.error as error:
        return None, f": {error}"
    return (np.asarray(image_bgr, dtype=np.uint8) if retrieved and image_bgr is not None else None), ""
