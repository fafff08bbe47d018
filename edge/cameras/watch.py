"""Detects frozen cameras, wrong timestamps and other modes: what looks like frames as before, but is not. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.health import Reason
from edge.types import Frame, FrameMeta

SAMPLED_EVERY_PX = 8  # enough to distinguish two pictures of a real sensor
DELAY_JUMP_NS = 250_000_000
STAMPS_TOLD_NS = 1_000_000_000
PUBLISHER_SILENT_NS = 1_000_000_000  # without a picture that can be used; then another may replace it
RIVALS_TOLD_NS = 5_000_000_000


class FrameWatch:
    """Compares each frame with the previous one."""

    def __init__(self) -> None:
        self._image_bgr: NDArray[np.uint8] | None = None
        self._sample: NDArray[np.uint8] | None = None
        self._capture_ns = 0
        self._delay_ns = 0

    def repeats(self, frame: Frame) -> bool:
        """Whether the picture equals the previous one in every pixel, which sensor noise rules out for a new one."""
        sample = np.ascontiguousarray(frame.image_bgr[::SAMPLED_EVERY_PX, ::SAMPLED_EVERY_PX])
        same = (
            self._sample is not None
            and self._image_bgr is not None
            and np.array_equal(sample, self._sample)
            and np.array_equal(frame.image_bgr, self._image_bgr)
        )
        self._image_bgr, self._sample = frame.image_bgr, sample
        return same

    def jumps(self, frame: Frame) -> bool:
        """Whether the exposure time goes back, lies in the future, or is suddenly much newer or older."""
        capture_ns, delay_ns = frame.meta.capture_ns, frame.meta.arrival_ns - frame.meta.capture_ns
        first = self._image_bgr is None
        jumped = delay_ns < 0 or (
            not first and (capture_ns <= self._capture_ns or abs(delay_ns - self._delay_ns) > DELAY_JUMP_NS)
        )
        self._capture_ns, self._delay_ns = capture_ns, delay_ns
        return jumped


class StampWatch:
    """Whether a camera's timestamps are worse than they were: older by DELAY_JUMP_NS at arrival, or unusable.

    Then its clock was set, or the link to it has become slower. Which of both, and whether the clock was right before,
    cannot be known here: stamps are used as they are, and a person is told for as long as it lasts.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None  # delay from stamp to arrival; None: no frame was stamped yet
        self._later_ns = 0
        self._late_since_ns: int | None = None
        self._unstamped_since_ns: int | None = None

    def take(self, meta: FrameMeta, stamped: bool) -> None:
        """Add a frame; `stamped`: it has the camera's own timestamp."""
        delay_ns, late = meta.arrival_ns - meta.capture_ns, False
        if stamped:
            self._least_ns = delay_ns if self._least_ns is None else min(self._least_ns, delay_ns)
            self._later_ns = delay_ns - self._least_ns
            late = self._later_ns > DELAY_JUMP_NS
        lost = not stamped and self._least_ns is not None
        self._late_since_ns = (self._late_since_ns or meta.arrival_ns) if late else None
        self._unstamped_since_ns = (self._unstamped_since_ns or meta.arrival_ns) if lost else None

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """What has lasted for STAMPS_TOLD_NS."""
        found = []
        if self._late_since_ns is not None and now_ns - self._late_since_ns >= STAMPS_TOLD_NS:
            text = (
                f"camera: pictures are {self._later_ns / 1e9:.1f} s older than they were; its clock or link has changed"
            )
            found.append(Reason("camera_late", text))
        if self._unstamped_since_ns is not None and now_ns - self._unstamped_since_ns >= STAMPS_TOLD_NS:
            text = "camera timestamps have become unusable: times of arrival are used instead"
            found.append(Reason("camera_unstamped", text))
        return tuple(found)


class ModeWatch:
    """Whether a camera gives pictures of another size than its first.

    They are taken for the same view, scaled. But many sensors read out only a part in their smaller modes, and then all
    ranges are wrong. Which of both it is cannot be known here: a person is told for as long as it lasts.
    """

    def __init__(self) -> None:
        self._first_wh: tuple[int, int] | None = None
        self._last_wh: tuple[int, int] | None = None

    def take(self, frame: Frame) -> None:
        self._last_wh = frame.size_wh
        self._first_wh = self._first_wh or self._last_wh

    def reasons(self) -> tuple[Reason, ...]:
        if self._first_wh is None or self._last_wh is None or self._last_wh == self._first_wh:
            return ()
        now, before = ("x".join(map(str, size_wh)) for size_wh in (self._last_wh, self._first_wh))
        text = f"camera: pictures are {now}, no longer {before}; ranges are right only if they show the same view"
        return (Reason("camera_size", text),)


class RivalWatch:
    """Whether pictures of another publisher arrive beside those in use: of another camera, or of a recording.

    Which of the two is used is chance: it may be the one that the calibration and the mount are not of.
    """

    def __init__(self) -> None:
        self._others = 0
        self._arrival_ns = 0
        self._told_ns: int | None = None

    def take(self, meta: FrameMeta, others: int) -> None:
        """Add a frame; `others`: how many pictures of other publishers have arrived so far."""
        beside = meta.arrival_ns - self._arrival_ns < PUBLISHER_SILENT_NS
        if others > self._others and beside:
            self._told_ns = meta.arrival_ns
        self._others, self._arrival_ns = others, meta.arrival_ns

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        if self._told_ns is None or now_ns - self._told_ns > RIVALS_TOLD_NS:
            return ()
        text = "camera: somebody else sends pictures on its topic too; only those of the first are used"
        return (Reason("camera_contested", text),)
