"""Live cameras through OpenCV: a V4L2 device or a network stream. Both may vanish and come back."""

from __future__ import annotations

import threading
import time

import cv2
import numpy as np

from edge.cameras.intrinsics import Intrinsics, Undistorter, load_intrinsics
from edge.cameras.source import EndOfStream, SourceLost
from edge.config import DeviceCamera, StreamCamera
from edge.types import CameraInfo, Frame, FrameMeta

STREAM_TIMEOUT_MS = 3000
DRIVER_STAMP_AGE_MAX_NS = 1_000_000_000


class LiveSource:
    """Frames as they arrive, stamped with their exposure as well as the camera tells it."""

    def __init__(self, settings: DeviceCamera | StreamCamera) -> None:
        self._settings = settings
        self._intrinsics = load_intrinsics(settings.intrinsics)
        self._latency_ns = round(settings.latency_ms * 1e6)
        self._capture: cv2.VideoCapture | None = None
        self._sequence = 0
        self._fitted: Intrinsics | None = None

    def nominal(self) -> CameraInfo:
        """What is known before the camera answers: the calibration's."""
        name = self._settings.device if isinstance(self._settings, DeviceCamera) else self._settings.url
        return CameraInfo(name, self._intrinsics.image_size_wh, self._intrinsics.K, None)

    def open(self) -> CameraInfo:
        """Raises SourceLost while the camera does not answer, InputError if the intrinsics do not fit its picture."""
        if isinstance(self._settings, DeviceCamera):
            name, capture = self._settings.device, open_device(self._settings)
        else:
            name, capture = self._settings.url, open_stream(self._settings)
        if not capture.isOpened():
            capture.release()
            raise SourceLost(f"{name} does not open")
        size_wh = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if min(size_wh) <= 0:
            capture.release()
            raise SourceLost(f"{name} does not say the size of its picture")
        self._capture = capture
        self._fit(size_wh)
        assert self._fitted is not None
        fps = capture.get(cv2.CAP_PROP_FPS)
        return CameraInfo(name, size_wh, self._fitted.K, fps if fps > 0 else None)

    def read(self, stop: threading.Event) -> Frame:
        """The next frame. Raises SourceLost when none comes."""
        assert self._capture is not None
        assert self._fitted is not None
        grabbed = self._capture.grab()
        arrival_ns = time.monotonic_ns()
        if stop.is_set():
            raise EndOfStream
        driver_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC) if isinstance(self._settings, DeviceCamera) else 0.0
        try:
            retrieved, image_bgr = self._capture.retrieve() if grabbed else (False, None)
        except cv2.error as error:
            raise SourceLost(f"a picture cannot be decoded: {error}") from error
        if not retrieved or image_bgr is None:
            raise SourceLost("the camera gives no more frames")
        size_wh = (image_bgr.shape[1], image_bgr.shape[0])
        if size_wh != self._fitted.image_size_wh:
            self._fit(size_wh)
        meta = FrameMeta(self._sequence, exposure_ns(arrival_ns, driver_ms, self._latency_ns), arrival_ns)
        self._sequence += 1
        return Frame(meta, self._undistort(np.asarray(image_bgr, dtype=np.uint8)), self._fitted.K)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _fit(self, size_wh: tuple[int, int]) -> None:
        self._fitted = self._intrinsics.scaled_to(size_wh)
        self._undistort = Undistorter(self._fitted)


def open_device(settings: DeviceCamera) -> cv2.VideoCapture:
    """A V4L2 device at the asked format, one buffer deep so that no stale frame waits in the driver."""
    capture = cv2.VideoCapture(settings.device, cv2.CAP_V4L2)
    if capture.isOpened():
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
        capture.set(cv2.CAP_PROP_FPS, settings.fps)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture


def open_stream(settings: StreamCamera) -> cv2.VideoCapture:
    """A network stream through ffmpeg, with limits on how long it may stay silent."""
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, STREAM_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, STREAM_TIMEOUT_MS]
    return cv2.VideoCapture(settings.url, cv2.CAP_FFMPEG, limits)


def exposure_ns(arrival_ns: int, driver_ms: float, latency_ns: int) -> int:
    """Monotonic time of exposure: the driver's stamp where it is plausible, else arrival; less the measured latency.

    V4L2 stamps buffers on the monotonic clock; a driver without stamps gives 0, one with another clock gives a time
    far from now.
    """
    driver_ns = round(driver_ms * 1e6)
    stamped = 0 <= arrival_ns - driver_ns <= DRIVER_STAMP_AGE_MAX_NS
    return (driver_ns if stamped else arrival_ns) - latency_ns
