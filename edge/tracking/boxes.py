"""Boxes on the frame: where a target's lies as it moves, and how two overlap. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.types import Array

RANGE_MIN_M = 1.0  # nearer, a projection is meaningless
SAME_BOX_IOU = 0.3  # above it two boxes are of one target


@dataclass(frozen=True)
class BoxModel:
    """A measured box, remembered so that it moves with the bearing and scales with the range."""

    offset: Array  # [2] box centre minus projection of the target's origin, px * m / px of focal length
    size: Array  # [2] m, as if the target were flat

    @classmethod
    def measured(cls, box_xyxy_px: Array, t_cam_target_m: Array, K: Array) -> BoxModel:
        m_per_px = max(t_cam_target_m[2], RANGE_MIN_M) / np.array([K[0, 0], K[1, 1]])
        center = 0.5 * (box_xyxy_px[:2] + box_xyxy_px[2:])
        return cls((center - _project(t_cam_target_m, K)) * m_per_px, (box_xyxy_px[2:] - box_xyxy_px[:2]) * m_per_px)

    def box_xyxy_px(self, t_cam_target_m: Array, K: Array) -> Array:
        px_per_m = np.array([K[0, 0], K[1, 1]]) / max(t_cam_target_m[2], RANGE_MIN_M)
        center = _project(t_cam_target_m, K) + self.offset * px_per_m
        half = 0.5 * self.size * px_per_m
        return np.concatenate([center - half, center + half])


def iou(a_xyxy: Array, b_xyxy: Array) -> float:
    """Intersection over union of two boxes [4]."""
    overlap = np.clip(np.minimum(a_xyxy[2:], b_xyxy[2:]) - np.maximum(a_xyxy[:2], b_xyxy[:2]), 0.0, None)
    intersection = float(overlap[0] * overlap[1])
    union = float(np.prod(a_xyxy[2:] - a_xyxy[:2]) + np.prod(b_xyxy[2:] - b_xyxy[:2])) - intersection
    return intersection / union if union > 0.0 else 0.0


def inside(box_xyxy_px: Array, image_size_wh: tuple[int, int]) -> bool:
    """Whether any of a box [4] lies in the picture."""
    return bool(np.all(box_xyxy_px[2:] > 0.0) and np.all(box_xyxy_px[:2] < np.array(image_size_wh) - 1.0))


def _project(t_cam_m: Array, K: Array) -> Array:
    return (K @ (t_cam_m / max(t_cam_m[2], RANGE_MIN_M)))[:2]
