"""Watches whether the pictures show anything at all: a covered lens, night, or an exposure that went wrong."""

from __future__ import annotations

import numpy as np

from edge.health import Reason
from edge.types import Frame

EVERY_NS = 250_000_000  # a picture is looked at
LASTING = 4  # so many in a row are alike before it is told of, or no more
PIXELS = 240 * 135  # about so many are looked at
# Drawn aircraft in pictures exposed less and less: found in 36 of 41 if the brightest hundredth of the pixels begins at
# 46 (median) of 255, in 23 at 24, in 12 at 14, where 16 things are found that are none. And more and more: in 37 of 41
# if 57 % of the pixels are white, in 24 at 81 %.
BRIGHT_SHARE, DARK_BELOW = 0.001, 32
WHITE_FROM, WHITE_SHARE = 250, 0.8
DARK = Reason("camera_dark", "the picture is dark: is the lens covered, or the exposure too short?")
WHITE = Reason("camera_white", "most of the picture is white: is the exposure too long?")


class PictureWatch:
    """Fed by the loop with each frame."""

    def __init__(self) -> None:
        self._looked_ns: int | None = None
        self._last: Reason | None = None
        self._alike = 0
        self._told: Reason | None = None

    def seen(self, frame: Frame) -> None:
        now_ns = frame.meta.capture_ns
        if self._looked_ns is not None and 0 <= now_ns - self._looked_ns < EVERY_NS:
            return
        self._looked_ns = now_ns
        found = _found(frame)
        self._alike = self._alike + 1 if found is self._last else 1
        self._last = found
        if self._alike >= LASTING:
            self._told = found

    def reasons(self) -> tuple[Reason, ...]:
        return () if self._told is None else (self._told,)


def _found(frame: Frame) -> Reason | None:
    step_px = max(round(float(np.sqrt(np.prod(frame.size_wh) / PIXELS))), 1)
    blue, green, red = np.moveaxis(frame.image_bgr[::step_px, ::step_px], 2, 0)
    brightest = np.maximum(np.maximum(blue, green), red)
    darkest = np.minimum(np.minimum(blue, green), red)
    if float(np.mean(brightest >= DARK_BELOW)) < BRIGHT_SHARE:
        return DARK
    return WHITE if float(np.mean(darkest >= WHITE_FROM)) > WHITE_SHARE else None
