"""Lens distortion: from the frame's pixels to those of an undistorted (pinhole) camera of the same K, and back. Pure.

The model is OpenCV's and ROS's plumb bob: k1 k2 p1 p2 [k3 [k4 k5 k6]].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from edge.types import Array

# Tangent of the largest angle off the axis that is undistorted (76 degrees).
RADIUS_MAX = 4.0
# How far the pinhole image may extend beyond the frame's pixels, in sides of the frame.
EXTENT_EXCESS = 0.5
RETURNED_MAX_PX = 0.5  # a pixel off by more after undistorting and distorting again has no ray of its own
_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
_GRID_POINTS = 65  # per side; the border alone is not enough: a lens model may fold inside the frame


@dataclass(frozen=True, eq=False)
class Lens:
    """K [3, 3] (pixel centres at integers) and the distortion that frame pixels have and pinhole pixels lack."""

    K: Array
    distortion: tuple[float, ...]  # k1 k2 p1 p2 [k3 [k4 k5 k6]]

    def to_pinhole(self, points_px: ArrayLike) -> Array:
        """[..., 2] frame pixels to pinhole pixels; valid inside the frame where the distortion can be inverted."""
        points = np.asarray(points_px, dtype=np.float64)
        straight = cv2.undistortPoints(
            points.reshape(-1, 1, 2), self.K, np.array(self.distortion), P=self.K, criteria=_EXACT
        )
        return np.asarray(straight, dtype=np.float64).reshape(points.shape)

    def to_frame(self, points_px: ArrayLike) -> Array:
        """[..., 2] pinhole pixels to frame pixels."""
        points = np.asarray(points_px, dtype=np.float64)
        rays = self.rays(points).reshape(-1, 1, 3)
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.K, np.array(self.distortion))
        return np.asarray(bent, dtype=np.float64).reshape(points.shape)

    def rays(self, points_px: ArrayLike) -> Array:
        """[..., 2] pinhole pixels to rays [..., 3] in `cam` with z = 1."""
        points = np.asarray(points_px, dtype=np.float64)
        homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
        return np.asarray(homogeneous @ np.linalg.inv(self.K).T)

    def box_to_pinhole(self, box_xyxy_px: ArrayLike) -> Array:
        """Box [..., 4] on the frame to the box on the pinhole image through the midpoints of its sides."""
        return _through(self.to_pinhole, box_xyxy_px)

    def box_to_frame(self, box_xyxy_px: ArrayLike) -> Array:
        """Box [..., 4] on the pinhole image to the box on the frame through the midpoints of its sides."""
        return _through(self.to_frame, box_xyxy_px)

    def shows(self, points_px: ArrayLike) -> Array:
        """Whether each of [..., 2] frame pixels is the image of exactly one ray."""
        straight = self.to_pinhole(points_px)
        radius = np.linalg.norm(self.rays(straight)[..., :2], axis=-1)
        returned = np.abs(self.to_frame(straight) - np.asarray(points_px)).max(axis=-1)
        return np.asarray((radius < self.radius_max) & (returned < RETURNED_MAX_PX))  # NaN compares false

    def extent_xyxy_px(self, frame_wh: tuple[int, int]) -> Array:
        """The box [4] of pinhole pixels around all valid pixels of the frame, limited by EXTENT_EXCESS."""
        return _extent(self.K.tobytes(), self.distortion, frame_wh).copy()

    @property
    def radius_max(self) -> float:
        """Tangent of the angle off the axis up to which the distortion model is one to one."""
        return _radius_max(self.distortion)


def lens_of(K: ArrayLike, distortion: tuple[float, ...]) -> Lens | None:
    """The lens, or None without distortion."""
    return Lens(np.asarray(K, dtype=np.float64), distortion) if any(distortion) else None


def _through(convert: Callable[[Array], Array], box_xyxy_px: ArrayLike) -> Array:
    x0, y0, x1, y1 = np.moveaxis(np.asarray(box_xyxy_px, dtype=np.float64), -1, 0)
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    middles = np.stack([np.stack(p, axis=-1) for p in ((x0, y), (x, y0), (x1, y), (x, y1))], axis=-2)
    left, top, right, bottom = np.moveaxis(convert(middles), -2, 0)
    return np.stack([left[..., 0], top[..., 1], right[..., 0], bottom[..., 1]], axis=-1)


@lru_cache(maxsize=16)
def _radius_max(distortion: tuple[float, ...]) -> float:
    """Where the radial part stops growing: beyond it the polynomial folds the image over itself."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
    r = np.linspace(0.0, RADIUS_MAX, 4001)
    r2 = r * r
    bent = r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    folds = np.flatnonzero(~(np.diff(bent) > 0))
    return float(r[folds[0]]) if folds.size else RADIUS_MAX


@lru_cache(maxsize=16)
def _extent(K_bytes: bytes, distortion: tuple[float, ...], frame_wh: tuple[int, int]) -> Array:
    lens = Lens(np.frombuffer(K_bytes).reshape(3, 3), distortion)
    right, bottom = frame_wh[0] - 0.5, frame_wh[1] - 0.5
    xs, ys = np.linspace(-0.5, right, _GRID_POINTS), np.linspace(-0.5, bottom, _GRID_POINTS)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    straight = lens.to_pinhole(grid)[lens.shows(grid)]
    if not len(straight):
        return np.array([-0.5, -0.5, right, bottom])
    low, high = straight.min(axis=0), straight.max(axis=0)
    excess = EXTENT_EXCESS * np.array(frame_wh)
    return np.concatenate([np.maximum(low, -0.5 - excess), np.minimum(high, np.array([right, bottom]) + excess)])
