"""Parts of the own aircraft in the picture, such as a wing tip or a propeller: painted over before the network looks,
which takes some of them for another aircraft. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

CELL_PX = 16  # the picture's colours are taken from one pixel of each square of this side
# Sides of the boxes, in cells, that a colour is the mean of: the smallest that holds any of the surroundings counts.
REACHES = (5, 21, 81, 1001)
FARTHER = 1e-4  # weight of the next larger box


@dataclass(frozen=True, eq=False)
class OwnParts:
    """Where the own aircraft is seen in pictures of one size."""

    covered: NDArray[np.uint8]  # [H, W], 255 where it is, else 0
    _clear: NDArray[np.float32]  # [h, w], 1 for each cell whose pixel is not covered, else 0
    _near: tuple[NDArray[np.float32], ...]  # [h, w] each, share of clear cells in the box of each reach
    _bounds_xywh: tuple[int, int, int, int]

    @classmethod
    def of(cls, mask: NDArray[np.uint8], size_wh: tuple[int, int]) -> OwnParts:
        """From a mask [H, W] of the pictures' shape, above 127 where the own aircraft is; scaled to their size."""
        white = np.where(mask > 127, np.uint8(255), np.uint8(0))
        covered = np.asarray(cv2.resize(white, size_wh, interpolation=cv2.INTER_NEAREST), np.uint8)
        clear = (_sampled(covered) == 0).astype(np.float32)
        x, y, w, h = cv2.boundingRect(covered)
        return cls(covered, clear, tuple(_mean(clear, reach) for reach in REACHES), (x, y, w, h))

    @property
    def size_wh(self) -> tuple[int, int]:
        return self.covered.shape[1], self.covered.shape[0]

    @property
    def share(self) -> float:
        """How much of the picture is covered, 0 .. 1."""
        return float(np.mean(self.covered > 0))

    def hide(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A copy of a picture [H, W, 3] in which the own aircraft has the colours of what surrounds it."""
        painted = image_bgr.copy()
        x, y, w, h = self._bounds_xywh
        if w == 0:  # too thin for pictures of this size
            return painted
        cells = _sampled(image_bgr).astype(np.float32) * self._clear[..., None]
        colours, weights = np.zeros_like(cells), np.full_like(self._clear, 1e-30)
        for nth, (reach, near) in enumerate(zip(REACHES, self._near, strict=True)):
            colours += FARTHER**nth * _mean(cells, reach)
            weights += FARTHER**nth * near
        colours = (colours / weights[..., None]).clip(0.0, 255.0).astype(np.uint8)
        part = np.s_[y // CELL_PX : -(-(y + h) // CELL_PX), x // CELL_PX : -(-(x + w) // CELL_PX)]
        larger = cv2.resize(colours[part], None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_LINEAR)
        top, left = y % CELL_PX, x % CELL_PX
        inside = np.s_[y : y + h, x : x + w]
        cv2.copyTo(larger[top : top + h, left : left + w], self.covered[inside], painted[inside])
        return painted

    def touches(self, box_xyxy_px: ArrayLike) -> bool:
        """Whether any part of the own aircraft lies in a box [4] of the picture."""
        left, top, right, bottom = np.floor(np.asarray(box_xyxy_px) + 0.5).clip(-1.0, 2.0**31).astype(int)
        return bool(self.covered[max(top, 0) : bottom + 1, max(left, 0) : right + 1].any())


def _sampled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The pixel in the middle of each cell; those at the edges of the picture may be smaller."""
    rows, columns = (
        np.minimum(np.arange(CELL_PX // 2, side + CELL_PX // 2, CELL_PX), side - 1) for side in image.shape[:2]
    )
    return image[np.ix_(rows, columns)]


def _mean(cells: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Of the cells in the box around each; beyond the picture there is nothing."""
    return np.asarray(cv2.blur(cells, (reach, reach), borderType=cv2.BORDER_CONSTANT), np.float32)
