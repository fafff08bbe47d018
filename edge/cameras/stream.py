"""A network stream through ffmpeg: RTSP, UDP, HTTP."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.live import LiveSource
from edge.config_camera import StreamCamera

TIMEOUT_MS = 3000
WINDOW_NS = 5_000_000_000
JUMP_NS = 1_000_000_000
# OpenCV takes ffmpeg's options from here alone. Each unlike ffmpeg's defaults lets no frames wait in a buffer.
OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
LOW_DELAY = "fflags;nobuffer|flags;low_delay"


class StreamSource(LiveSource):
    """Stamped by the stream's own clock, as it advances between frames, laid on ours by the fastest arrivals."""

    def __init__(self, settings: StreamCamera) -> None:
        super().__init__(settings.url, load_intrinsics(settings.intrinsics))
        self._settings = settings
        self._latency_ns = round(settings.latency_ms * 1e6)
        self._clock = StreamClock()

    def _connect(self) -> cv2.VideoCapture:
        transport = f"rtsp_transport;{self._settings.rtsp_transport}|" if self._settings.url.startswith("rtsp") else ""
        self._clock = StreamClock()
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, TIMEOUT_MS]
        with _ffmpeg_options(transport + LOW_DELAY):
            return cv2.VideoCapture(self._settings.url, cv2.CAP_FFMPEG, limits)

    def _exposure_ns(self, arrival_ns: int, position_ms: float) -> int:
        stamp_ns = self._clock.monotonic_ns(round(position_ms * 1e6), arrival_ns)
        if stamp_ns is None:
            self.counts["unstamped"] += 1
        return (arrival_ns if stamp_ns is None else stamp_ns) - self._latency_ns


@contextmanager
def _ffmpeg_options(options: str) -> Iterator[None]:
    """For what is opened inside alone: a video opened later with these would lose its last frame.

    Options that the user has set stay.
    """
    if OPTIONS_VARIABLE in os.environ:
        yield
        return
    os.environ[OPTIONS_VARIABLE] = options
    try:
        yield
    finally:
        del os.environ[OPTIONS_VARIABLE]


class StreamClock:
    """Presentation times of a stream on the monotonic clock.

    A stream's clock begins anywhere, so its offset is taken from the frame that came fastest of the last five seconds:
    what the others took longer is the network's and the decoder's jitter, and leaves the stamp. What is common to all
    (encoder, network, decoder) stays in it; `latency_ms` takes that off, if it was measured.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._fastest: deque[tuple[int, int]] = deque()  # (arrival, arrival - stamp), the latter growing

    def monotonic_ns(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """The frame's time on our clock, never later than its arrival; None if the stream gives no stamp that grows."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is not None and stamp_ns <= last_ns:
            self._fastest.clear()
            return None
        delay_ns = arrival_ns - stamp_ns
        if self._fastest and abs(delay_ns - self._fastest[0][1]) > JUMP_NS:
            self._fastest.clear()
        while self._fastest and self._fastest[-1][1] >= delay_ns:
            self._fastest.pop()
        self._fastest.append((arrival_ns, delay_ns))
        while arrival_ns - self._fastest[0][0] > WINDOW_NS:
            self._fastest.popleft()
        return stamp_ns + self._fastest[0][1]
