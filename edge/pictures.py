"""The camera's pictures for viewers and recordings: JPEG, encoded in a separate thread; the loop never waits.

Live ones are few and small, encoded only while there is a viewer; recorded ones have the configured rate and quality.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.types import Frame

LIVE_BYTES_MAX = 150_000
LIVE_QUALITIES = (80, 60, 40, 20)  # the first that fits
# Then these, with optimised Huffman tables, which take longer: with the usual ones 4K is 130 kB at the lowest quality.
LIVE_TIGHT_QUALITIES = (20, 10, 5)
RECORDED_QUALITY = 90
WAITING_MAX = 4  # frames
STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True, eq=False)
class Picture:
    """One encoded frame and where it goes."""

    capture_ns: int  # monotonic
    jpeg: bytes
    live: bool  # to viewers
    recorded: bool  # to disk


class PictureLink(Protocol):
    """A receiver of pictures."""

    def wants_picture(self) -> bool:
        """Whether there is a viewer."""

    def records_picture(self) -> bool:
        """Whether a recording is in progress."""

    def publish_picture(self, picture: Picture) -> None:
        """Accept a picture; never waits."""


class Rate:
    """When the next one is due; counted from the last due time, so that the mean rate is met although frames come at
    other times."""

    def __init__(self, hz: float) -> None:
        self._period_ns = round(1e9 / hz) if hz > 0 else None
        self._due_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        if self._period_ns is None or (self._due_ns is not None and now_ns < self._due_ns):
            return False
        last_due_ns = now_ns if self._due_ns is None else max(self._due_ns, now_ns - self._period_ns)
        self._due_ns = last_due_ns + self._period_ns
        return True


class Pictures:
    """Encodes what is due; `show` is called by the loop with each frame."""

    def __init__(self, link: PictureLink, live_max_hz: float, recorded_max_hz: float) -> None:
        self._link = link
        self._live = Rate(live_max_hz)
        self._recorded = Rate(recorded_max_hz)
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Frame, bool, bool]] = deque(maxlen=WAITING_MAX)
        self._counters: Counter[str] = Counter()
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="pictures", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def show(self, frame: Frame) -> None:
        """Queue a frame for the thread if due; if the thread cannot keep up, the oldest is dropped and counted."""
        capture_ns = frame.meta.capture_ns
        live = self._link.wants_picture() and self._live.due(capture_ns)
        recorded = self._link.records_picture() and self._recorded.due(capture_ns)
        if not live and not recorded:
            return
        with self._changed:
            self._counters["replaced"] += len(self._waiting) == WAITING_MAX
            self._waiting.append((frame, live, recorded))
            self._changed.notify()

    def stop(self) -> None:
        """Encode and hand over what is queued, then stop. May be called twice."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(STOP_TIMEOUT_S)

    def counters(self) -> dict[str, int]:
        with self._changed:
            return dict(self._counters)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or bool(self._waiting))
                if not self._waiting:
                    return
                frame, live, recorded = self._waiting.popleft()
            if recorded:
                self._hand_over(frame, jpeg(frame.image_bgr, RECORDED_QUALITY), live=False, recorded=True)
            if live:
                self._hand_over(frame, small_jpeg(frame.image_bgr), live=True, recorded=False)

    def _hand_over(self, frame: Frame, data: bytes | None, *, live: bool, recorded: bool) -> None:
        if data is None:
            with self._changed:
                self._counters["not_encoded"] += 1
            return
        self._link.publish_picture(Picture(frame.meta.capture_ns, data, live, recorded))


def jpeg(image_bgr: NDArray[np.uint8], quality: int, tight: bool = False) -> bytes | None:
    """[H, W, 3] as JPEG, with optimised Huffman tables if `tight`; None if it cannot be encoded (libjpeg takes at
    most 65,500 pixels per side)."""
    try:
        settings = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, int(tight)]
        done, data = cv2.imencode(".jpg", image_bgr, settings)
    except cv2.error:
        return None
    return data.tobytes() if done else None


def small_jpeg(image_bgr: NDArray[np.uint8]) -> bytes | None:
    """The best quality within LIVE_BYTES_MAX, at full resolution so that overlays fit; None: no quality fits."""
    for quality, tight in (*((q, False) for q in LIVE_QUALITIES), *((q, True) for q in LIVE_TIGHT_QUALITIES)):
        data = jpeg(image_bgr, quality, tight)
        if data is not None and len(data) <= LIVE_BYTES_MAX:
            return data
    return None
