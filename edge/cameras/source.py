"""The interface of all cameras: open, read, close. There is one small file per kind."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Protocol

from edge.types import CameraInfo, Frame


class EndOfStream(Exception):
    """The recording is over; no frame will follow."""


class SourceLost(Exception):
    """The camera does not answer; opening it again may help."""


class Source(Protocol):
    """A source of frames, driven by one thread at a time."""

    live: bool  # a real camera, not a recording: a repeated picture is then a fault
    counts: Counter[str]  # faults by reason, with every reason present from the start

    def open(self) -> CameraInfo:
        """Prepare for `read`. Raises SourceLost if a later attempt may succeed, InputError if none will."""

    def read(self, stop: threading.Event) -> Frame:
        """Wait for the next frame. Raises EndOfStream (also when `stop` is set), SourceLost or InputError."""

    def close(self) -> None:
        """Release the device or file; it may be opened again."""


def wait_until(time_ns: int, stop: threading.Event) -> None:
    """Sleep until the monotonic clock reaches `time_ns`. Raises EndOfStream if `stop` is set meanwhile."""
    while (left_ns := time_ns - time.monotonic_ns()) > 0:
        if stop.wait(left_ns / 1e9):
            break
    if stop.is_set():
        raise EndOfStream
