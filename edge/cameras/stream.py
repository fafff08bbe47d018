"""A network stream through ffmpeg: RTSP, UDP, HTTP."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from edge.addresses import no_password
from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.live import LiveSource
from edge.cameras.losses import Losses
from edge.cameras.source import SourceLost
from edge.cameras.stamps import CAUGHT_UP_NS, StreamClock
from edge.cameras.video import is_counted, may_be_bare_jpeg, open_video
from edge.config_camera import StreamCamera
from edge.errors import InputError
from edge.types import Frame

TIMEOUT_MS = 3000
LOSSY = ("udp:", "rtp:")
KEY_FRAME = ord("I")
BEHIND_MAX_NS = 250_000_000  # a permanent backlog; a reopened stream begins with current frames
# The decoder holds back one frame fewer than it has threads, and OpenCV gives it one thread per core: the delay would
# differ from computer to computer.
DECODER_THREADS = 1
# The only way to pass options to ffmpeg through OpenCV. Unlike ffmpeg's defaults, these let no frames wait before the
# decoder.
OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
LOW_DELAY = "fflags;nobuffer|flags;low_delay"


class StreamSource(LiveSource):
    """Frames with the stream's own timestamps, mapped to our clock by the fastest arrivals (`StreamClock`)."""

    def __init__(self, settings: StreamCamera) -> None:
        super().__init__(no_password(settings.url), load_intrinsics(settings.intrinsics))
        self._settings = settings
        self._latency_ns = round(settings.latency_ms * 1e6)
        self._clock = StreamClock()
        # Over TCP nothing is lost; a step is then of the camera's own, which predicts its pictures from those it sent.
        rtsp = settings.url.startswith("rtsp")
        described = settings.url.partition("?")[0].endswith(".sdp")  # on a web server; the RTP comes in datagrams
        self._lossy = settings.url.startswith(LOSSY) or (settings.rtsp_transport == "udp" if rtsp else described)
        self._losses = Losses(self._lossy)
        self._undecodable = 0  # of what is counted, how many came before the picture read last
        self._damaged = False  # the picture read last
        self._timeless = False
        self._asked_ns = 0  # when the picture that is awaited was asked for
        self._unread_since_ns: int | None = None  # since when it is open without anything having been read
        self.counts["catching_up"] = self.counts["damaged"] = 0

    def read(self, stop: threading.Event) -> Frame:
        """The next frame. Skipped are frames that were buffered, here or in the server, as their age is unknown, and
        those that are damaged by a loss before them."""
        if self._waited_unnoticed():
            self._call_again()
        self._unread_since_ns = None
        while True:
            self._asked_ns = time.monotonic_ns()
            frame = super().read(stop)
            if not self._clock.caught_up:
                self.counts["catching_up"] += 1
            elif self._damaged:
                self.counts["damaged"] += 1
            else:
                return frame

    def _connect(self) -> cv2.VideoCapture:
        transport = f"rtsp_transport;{self._settings.rtsp_transport}|" if self._settings.url.startswith("rtsp") else ""
        self._clock, self._losses, self._damaged = StreamClock(), Losses(self._lossy), False
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, TIMEOUT_MS,
            cv2.CAP_PROP_N_THREADS, DECODER_THREADS,
        ]  # fmt: skip
        with _ffmpeg_options(transport + LOW_DELAY):
            capture = open_video(self._settings.url, limits)
        self._timeless = not transport and may_be_bare_jpeg(capture)
        self._unread_since_ns = time.monotonic_ns()
        return capture

    def _may_go_on(self) -> bool:
        """OpenCV reports a picture that its decoder refuses as it reports the end, but grabs the one after it. After a
        silence it grabs none any more."""
        return time.monotonic_ns() - self._asked_ns < TIMEOUT_MS * 1_000_000

    def _call_again(self) -> None:
        """Raises SourceLost."""
        self.close()
        try:
            self.open()
        except InputError as error:
            raise SourceLost(str(error)) from error

    def _waited_unnoticed(self) -> bool:
        """Whether pictures without timestamps are buffered here, whose age is unknown. A web camera starts with current
        ones on a new connection; the server of a bare TCP connection may exit when it is closed."""
        asked_anew = self._timeless and self._settings.url.startswith("http")
        since_ns = self._unread_since_ns
        return asked_anew and since_ns is not None and time.monotonic_ns() - since_ns >= CAUGHT_UP_NS

    def _exposure_ns(self, arrival_ns: int, position_ms: float) -> int:
        self._timeless = self._timeless and is_counted(position_ms)
        if self._capture is not None:
            key = int(self._capture.get(cv2.CAP_PROP_FRAME_TYPE)) == KEY_FRAME
            before, self._undecodable = self._undecodable, self.counts["undecodable"]
            self._damaged = self._losses.damaged(position_ms, key, after_undecodable=self._undecodable > before)
        stamp_ns = self._clock.monotonic_ns(0 if self._timeless else round(position_ms * 1e6), arrival_ns)
        if (behind_ns := self._clock.behind_ns()) > BEHIND_MAX_NS:
            raise SourceLost(f"the stream runs {behind_ns / 1e9:.1f} s behind itself")
        if stamp_ns is None:
            self.counts["unstamped"] += 1
        return (arrival_ns if stamp_ns is None else stamp_ns) - self._latency_ns


@contextmanager
def _ffmpeg_options(options: str) -> Iterator[None]:
    """Only for what is opened inside the block: a video file opened with these would lose its last frame.

    Options set by the user are kept.
    """
    if OPTIONS_VARIABLE in os.environ:
        yield
        return
    os.environ[OPTIONS_VARIABLE] = options
    try:
        yield
    finally:
        del os.environ[OPTIONS_VARIABLE]
