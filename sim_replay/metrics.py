"""Pose errors of the paper's "Evaluation Metrics", one function a metric, broadcasting over leading axes.

Arguments stand in the order R_est, t_est, R_gt, t_gt; rotations [..., 3, 3] turn target body axes into `cam`,
translations [..., 3] are the target's origin in `cam`, metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs.geometry import Array, rotation_angle

POSE_ROTATION_DEG = 10.0
POSE_TRANSLATION_REL = 0.05


def rotation_error_deg(R_est: ArrayLike, R_gt: ArrayLike) -> Array:
    """E_r [...]: geodesic distance on SO(3), degrees. Paper: arccos((Tr(R_est R_gt^T) - 1) / 2) * 180 / pi."""
    return np.rad2deg(rotation_angle(R_est, R_gt))


def translation_error_m(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """E_t [...]: Euclidean distance ||t_est - t_gt||, metres."""
    return np.linalg.norm(np.asarray(t_est, dtype=np.float64) - np.asarray(t_gt, dtype=np.float64), axis=-1)


def depth_error_m(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """E_z [...]: |z_est - z_gt| along the optical axis, metres."""
    return np.abs(np.asarray(t_est, dtype=np.float64)[..., 2] - np.asarray(t_gt, dtype=np.float64)[..., 2])


def depth_error_rel(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """[...]: E_z over the true depth; "Depth < 5 %" is this below 0.05."""
    return depth_error_m(t_est, t_gt) / np.abs(np.asarray(t_gt, dtype=np.float64)[..., 2])


def translation_error_rel(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """[...]: E_t over the true range ||t_gt||."""
    return translation_error_m(t_est, t_gt) / np.linalg.norm(np.asarray(t_gt, dtype=np.float64), axis=-1)


def pose_10deg_5pct(R_est: ArrayLike, t_est: ArrayLike, R_gt: ArrayLike, t_gt: ArrayLike) -> NDArray[np.bool_]:
    """Pose@10°/5 % [...]: rotation error below 10° and translation error below 5 % of the true range."""
    rotation_ok = rotation_error_deg(R_est, R_gt) < POSE_ROTATION_DEG
    return rotation_ok & (translation_error_rel(t_est, t_gt) < POSE_TRANSLATION_REL)


def add_m(R_est: ArrayLike, t_est: ArrayLike, R_gt: ArrayLike, t_gt: ArrayLike, points_body_m: ArrayLike) -> Array:
    """ADD [...], metres: mean distance of model points [P, 3] under both poses. ADD-0.5d: below half the diameter."""
    points = np.asarray(points_body_m, dtype=np.float64)
    delta_R = np.asarray(R_est, dtype=np.float64) - np.asarray(R_gt, dtype=np.float64)
    delta_t = np.asarray(t_est, dtype=np.float64) - np.asarray(t_gt, dtype=np.float64)
    moved = points @ np.swapaxes(delta_R, -1, -2) + delta_t[..., None, :]
    return np.linalg.norm(moved, axis=-1).mean(axis=-1)


def bearing_error_deg(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """[...]: angle between the rays to the estimated and the true origin, degrees."""
    a, b = np.asarray(t_est, dtype=np.float64), np.asarray(t_gt, dtype=np.float64)
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))
