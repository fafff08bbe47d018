"""Boxes on the frame: prediction for a moving target, through the lens, and overlap of two. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.estimator.lens import Lens
from edge.types import Array

RANGE_MIN_M = 1.0  # below it a projection is meaningless
SAME_BOX_IOU = 0.3  # above it two boxes are of one target


@dataclass(frozen=True)
class BoxModel:
    """A measured box, stored so that it moves with the bearing and scales with the range.

    It is stored in pinhole pixels, as lens distortion changes a target's apparent size with its place on the frame.
    """

    offset: Array  # [2] box centre minus projection of the target's origin, px * m / px of focal length
    size: Array  # [2] m, as if the target were flat

    @classmethod
    def measured(cls, box_xyxy_px: Array, t_cam_target_m: Array, lens: Lens) -> BoxModel:
        """From a box [4] on the frame."""
        K = lens.K
        m_per_px = max(t_cam_target_m[2], RANGE_MIN_M) / np.array([K[0, 0], K[1, 1]])
        straight = _straight(box_xyxy_px, lens)
        if straight is None:
            return cls(np.zeros(2), (box_xyxy_px[2:] - box_xyxy_px[:2]) * m_per_px)
        center = 0.5 * (straight[:2] + straight[2:])
        return cls((center - _project(t_cam_target_m, K)) * m_per_px, (straight[2:] - straight[:2]) * m_per_px)

    def box_xyxy_px(self, t_cam_target_m: Array, lens: Lens) -> Array:
        """The box [4] on the frame."""
        K = lens.K
        px_per_m = np.array([K[0, 0], K[1, 1]]) / max(t_cam_target_m[2], RANGE_MIN_M)
        center = _project(t_cam_target_m, K) + self.offset * px_per_m
        half = 0.5 * self.size * px_per_m
        return _bent(np.concatenate([center - half, center + half]), lens)


def iou(a_xyxy: Array, b_xyxy: Array) -> float:
    """Intersection over union of two boxes [4]."""
    sides = np.clip(np.minimum(a_xyxy[2:], b_xyxy[2:]) - np.maximum(a_xyxy[:2], b_xyxy[:2]), 0.0, None)
    intersection = float(sides[0] * sides[1])
    union = float(np.prod(a_xyxy[2:] - a_xyxy[:2]) + np.prod(b_xyxy[2:] - b_xyxy[:2])) - intersection
    return intersection / union if union > 0.0 else 0.0


def overlap(a_xyxy: Array, b_xyxy: Array) -> float:
    """Share of the smaller of two boxes [4] that lies in the other, 0..1."""
    sides = np.minimum(a_xyxy[2:], b_xyxy[2:]) - np.maximum(a_xyxy[:2], b_xyxy[:2])
    if sides.min() <= 0.0:
        return 0.0
    return float(np.prod(sides) / min(np.prod(a_xyxy[2:] - a_xyxy[:2]), np.prod(b_xyxy[2:] - b_xyxy[:2])))


def inside(box_xyxy_px: Array, image_size_wh: tuple[int, int]) -> bool:
    """Whether any part of a box [4] lies in the image."""
    return bool(np.all(box_xyxy_px[2:] > 0.0) and np.all(box_xyxy_px[:2] < np.array(image_size_wh) - 1.0))


def _straight(box_xyxy_px: Array, lens: Lens) -> Array | None:
    """A box [4] on the frame in pinhole pixels; None where the lens cannot be inverted, as in some lenses' corners:
    OpenCV returns arbitrary values there."""
    if not any(lens.distortion):
        return box_xyxy_px
    straight = lens.box_to_pinhole(box_xyxy_px)
    return straight if iou(_bent(straight, lens), box_xyxy_px) > SAME_BOX_IOU else None  # not with NaN


def _bent(box_xyxy_px: Array, lens: Lens) -> Array:
    """A box [4] of pinhole pixels on the frame.

    Points farther off the axis than the lens model's valid radius keep their pinhole position, which is farther out:
    the polynomial would fold them back into the image.
    """
    if not any(lens.distortion):
        return box_xyxy_px
    x0, y0, x1, y1 = box_xyxy_px
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    middles = np.array([(x0, y), (x, y0), (x1, y), (x, y1)])  # of its sides, as the box was measured
    tangents = np.linalg.norm(lens.rays(middles)[:, :2], axis=1)
    left, top, right, bottom = np.where(tangents[:, None] < lens.radius_max, lens.to_frame(middles), middles)
    return np.array([left[0], top[1], right[0], bottom[1]])


def _project(t_cam_m: Array, K: Array) -> Array:
    return (K @ (t_cam_m / max(t_cam_m[2], RANGE_MIN_M)))[:2]
