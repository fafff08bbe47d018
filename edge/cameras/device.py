"""A V4L2 device: USB and CSI cameras, capture cards."""

from __future__ import annotations

import logging
import os
import threading

import cv2

from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.live import LiveSource
from edge.cameras.stamps import StampCheck
from edge.config_camera import DeviceCamera
from edge.types import CameraInfo, Frame

log = logging.getLogger(__name__)

STAMP_AGE_MAX_NS = 1_000_000_000
# V4L2: menu of V4L2_CID_EXPOSURE_AUTO, and unit of V4L2_CID_EXPOSURE_ABSOLUTE.
EXPOSURE_MANUAL = 1
EXPOSURE_UNITS_PER_MS = 10
FPS_TOLERANCE = 0.05
EXPOSURE_TOLERANCE = 0.1  # drivers round to steps
# OpenCV returns a frame's buffer when the next frame is requested: with a single buffer the driver could not store the
# next picture while this one is decoded, and would lose every other one. A third would only hold stale pictures.
BUFFERS = 2
# How long OpenCV waits for a frame; its default would be 10 s without a message or a retry.
TIMEOUT_VARIABLE, TIMEOUT_S = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", 3


class DeviceSource(LiveSource):
    """Frames with the driver's timestamps, if these are on the monotonic clock."""

    def __init__(self, settings: DeviceCamera) -> None:
        intrinsics = load_intrinsics(settings.intrinsics)
        asked_wh = (settings.width, settings.height)
        self._asked = intrinsics.scaled_to(asked_wh, "[camera] width and height ask for")
        super().__init__(settings.device, intrinsics)
        self._settings = settings
        self._latency_ns = round(settings.latency_ms * 1e6)
        self._stamps = StampCheck(STAMP_AGE_MAX_NS)
        self._undated = False  # the last frame may have waited in the driver, for as long as the model was warmed up
        self.counts["catching_up"] = 0

    def nominal(self) -> CameraInfo:
        """Properties before the camera answers: the requested picture."""
        return self._info(self._asked, None)

    def read(self, stop: threading.Event) -> Frame:
        """As in LiveSource, without frames that may have waited to be read; they use up sequence numbers too."""
        while True:
            frame = super().read(stop)
            if not self._undated:
                return frame
            self.counts["catching_up"] += 1

    def _connect(self) -> cv2.VideoCapture:
        settings = self._settings
        os.environ.setdefault(TIMEOUT_VARIABLE, str(TIMEOUT_S))
        capture = cv2.VideoCapture(settings.device, cv2.CAP_V4L2)
        if not capture.isOpened():
            return capture
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
        capture.set(cv2.CAP_PROP_FPS, settings.fps)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, BUFFERS)
        if settings.exposure_ms is not None:
            manual = capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, EXPOSURE_MANUAL)
            if not (capture.set(cv2.CAP_PROP_EXPOSURE, settings.exposure_ms * EXPOSURE_UNITS_PER_MS) and manual):
                log.warning("%s does not let its exposure be set", settings.device)
        exposure_ms = capture.get(cv2.CAP_PROP_EXPOSURE) / EXPOSURE_UNITS_PER_MS
        fourcc, fps = _fourcc(capture.get(cv2.CAP_PROP_FOURCC)), capture.get(cv2.CAP_PROP_FPS)
        size_wh = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        for complaint in complaints(settings, size_wh, fourcc, fps, exposure_ms):
            log.warning("%s %s", settings.device, complaint)
        return capture

    def _exposure_ns(self, arrival_ns: int, position_ms: float) -> int:
        # OpenCV returns the V4L2 buffer's timestamp as CAP_PROP_POS_MSEC. It is on CLOCK_MONOTONIC if the driver sets
        # V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, which OpenCV does not report; a driver without timestamps gives 0.
        stamp_ns = round(position_ms * 1e6)
        believed = self._stamps.believes(stamp_ns, arrival_ns)
        self._undated = believed is None
        if believed is False:
            self.counts["unstamped"] += 1
            stamp_ns = arrival_ns
        return stamp_ns - self._latency_ns


def complaints(
    settings: DeviceCamera, size_wh: tuple[int, int], fourcc: str, fps: float, exposure_ms: float
) -> list[str]:
    """Deviations of the device from the requested settings; whether the intrinsics fit is checked elsewhere."""
    found = []
    if min(size_wh) > 0 and size_wh != (settings.width, settings.height):
        found.append(f"gives {size_wh[0]}x{size_wh[1]}, not {settings.width}x{settings.height}")
    if fourcc != settings.fourcc:
        found.append(f"gives {fourcc or 'an unnamed format'}, not {settings.fourcc}")
    if fps > 0 and abs(fps - settings.fps) > FPS_TOLERANCE * settings.fps:
        found.append(f"gives {fps:g} frames a second, not {settings.fps:g}")
    asked_ms = settings.exposure_ms
    if asked_ms is not None and exposure_ms > 0 and abs(exposure_ms - asked_ms) > EXPOSURE_TOLERANCE * asked_ms:
        found.append(f"exposes for {exposure_ms:g} ms, not {asked_ms:g}")
    return found


def _fourcc(code: float) -> str:
    return int(code).to_bytes(4, "little", signed=False).decode("ascii", "replace").strip("\0 ") if code > 0 else ""
