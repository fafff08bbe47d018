"""Detects frozen cameras and jumping timestamps: repeated pictures look like frames, but are not new. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.types import Frame

SAMPLED_EVERY_PX = 8  # enough to distinguish two pictures of a real sensor
DELAY_JUMP_NS = 250_000_000


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
