"""Between the frame's pixels and the network's: whole frames fitted, windows cut, K following exactly. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.types import Array

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class PixelMap:
    """Frame pixels c to network pixels c' = (c + 0.5) * scale - 0.5 + offset, each axis; pixel centres at integers."""

    scale_xy: tuple[float, float]
    offset_xy: tuple[float, float]

    def to_network(self, points_px: ArrayLike) -> Array:
        """[..., 2] frame pixels to network pixels."""
        return (np.asarray(points_px, dtype=np.float64) + 0.5) * self.scale_xy - 0.5 + self.offset_xy

    def to_frame(self, points_px: ArrayLike) -> Array:
        """[..., 2] network pixels to frame pixels."""
        return (np.asarray(points_px, dtype=np.float64) + 0.5 - self.offset_xy) / self.scale_xy - 0.5

    def box_to_frame(self, center_px: ArrayLike, size_px: ArrayLike) -> Array:
        """Centre and size [..., 2] in network pixels to box_xyxy_px [..., 4] on the frame."""
        center = self.to_frame(center_px)
        half = 0.5 * np.asarray(size_px, dtype=np.float64) / self.scale_xy
        return np.concatenate([center - half, center + half], axis=-1)

    def intrinsics(self, K: ArrayLike) -> Array:
        """K [3, 3] of the frame to K of the network's pixels: the same camera, other pixels."""
        (sx, sy), (ox, oy) = self.scale_xy, self.offset_xy
        to_network = np.array([[sx, 0.0, 0.5 * sx - 0.5 + ox], [0.0, sy, 0.5 * sy - 0.5 + oy], [0.0, 0.0, 1.0]])
        return to_network @ np.asarray(K, dtype=np.float64)


@dataclass(frozen=True)
class Window:
    """Frame pixels left .. left + width - 1, top .. top + height - 1; it may reach beyond the frame."""

    left: int
    top: int
    width: int
    height: int

    def pixel_map(self, size_wh: tuple[int, int]) -> PixelMap:
        sx, sy = size_wh[0] / self.width, size_wh[1] / self.height
        return PixelMap((sx, sy), (-self.left * sx, -self.top * sy))


def fit_frame(
    image_bgr: Image, size_wh: tuple[int, int], fit: Literal["letterbox", "squash"]
) -> tuple[Image, PixelMap]:
    """The whole frame [H, W, 3] on the network's [h, w, 3]: aspect kept and centred on black, or squashed."""
    height, width = image_bgr.shape[:2]
    inner_wh = size_wh
    if fit == "letterbox":
        scale = min(size_wh[0] / width, size_wh[1] / height)
        inner_wh = (max(round(width * scale), 1), max(round(height * scale), 1))
    left, top = (size_wh[0] - inner_wh[0]) // 2, (size_wh[1] - inner_wh[1]) // 2
    out = np.zeros((size_wh[1], size_wh[0], 3), dtype=np.uint8)
    out[top : top + inner_wh[1], left : left + inner_wh[0]] = _resize(image_bgr, inner_wh)
    return out, PixelMap((inner_wh[0] / width, inner_wh[1] / height), (float(left), float(top)))


def window_around(
    box_xyxy_px: ArrayLike, window_scale: float, size_wh: tuple[int, int], image_size_wh: tuple[int, int]
) -> Window:
    """The window of the network's aspect around a box, its shorter side window_scale times the box's longer.

    It is moved into the frame where it fits there: real pixels say more than a border. It never outgrows the frame's
    longer side: the box of a target predicted at arm's length has no bounds, and the memory for its window has.
    """
    x0, y0, x1, y1 = np.asarray(box_xyxy_px, dtype=np.float64)
    side = min(window_scale * max(x1 - x0, y1 - y0, 1.0), float(max(image_size_wh)))
    shorter = min(size_wh)
    width, height = max(round(side * size_wh[0] / shorter), 2), max(round(side * size_wh[1] / shorter), 2)
    # Outermost pixel centres lie half a pixel inside the box's edges.
    left = round(0.5 * (x0 + x1) - 0.5 * (width - 1))
    top = round(0.5 * (y0 + y1) - 0.5 * (height - 1))
    return Window(_inside(left, width, image_size_wh[0]), _inside(top, height, image_size_wh[1]), width, height)


def cut(image_bgr: Image, window: Window, size_wh: tuple[int, int]) -> Image:
    """The window's pixels at the network's size [h, w, 3]; beyond the frame its border is repeated."""
    height, width = image_bgr.shape[:2]
    rows = slice(max(window.top, 0), min(window.top + window.height, height))
    columns = slice(max(window.left, 0), min(window.left + window.width, width))
    pixels: Image = image_bgr[rows, columns]
    if pixels.shape[:2] != (window.height, window.width):
        margins = (
            rows.start - window.top,
            window.top + window.height - rows.stop,
            columns.start - window.left,
            window.left + window.width - columns.stop,
        )
        pixels = np.asarray(cv2.copyMakeBorder(pixels, *margins, cv2.BORDER_REPLICATE), dtype=np.uint8)
    return _resize(pixels, size_wh)


def _inside(start: int, length: int, limit: int) -> int:
    if length >= limit:
        return -((length - limit) // 2)
    return min(max(start, 0), limit - length)


def _resize(image_bgr: Image, size_wh: tuple[int, int]) -> Image:
    """Area averages when it shrinks, bilinear when it grows. Halving first is the cheap way to the same averages."""
    pixels = image_bgr
    while pixels.shape[1] >= 2 * size_wh[0] and pixels.shape[0] >= 2 * size_wh[1]:
        half_wh = (pixels.shape[1] // 2, pixels.shape[0] // 2)
        pixels = np.asarray(cv2.resize(pixels, half_wh, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    shrinks = size_wh[0] < pixels.shape[1]
    resized = cv2.resize(pixels, size_wh, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(resized, dtype=np.uint8)
