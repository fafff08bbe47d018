"""Pose metrics of the paper's section "Evaluation Metrics", one function each, broadcasting over leading axes.

The order of arguments is R_est, t_est, R_gt, t_gt; rotations [..., 3, 3] map target body axes to `cam`, translations
[..., 3] are the target's origin in `cam`, metres. Covariances [..., 6, 6] are of (x, y, z m, rotation x, y, z rad) in
`cam`, rotation as R = exp(w) R_est. Functions named after a threshold return booleans; a rate is their mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs.geometry import Array, rotation_angle, so3_log

ROTATION_LIMIT_DEG = 10.0
DEPTH_LIMIT_REL = 0.05
TRANSLATION_LIMIT_REL = 0.05

Booleans = NDArray[np.bool_]


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
    """[...]: E_z over the true depth."""
    return depth_error_m(t_est, t_gt) / np.abs(np.asarray(t_gt, dtype=np.float64)[..., 2])


def translation_error_rel(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """[...]: E_t over the true range ||t_gt||."""
    return translation_error_m(t_est, t_gt) / np.linalg.norm(np.asarray(t_gt, dtype=np.float64), axis=-1)


def bearing_error_deg(t_est: ArrayLike, t_gt: ArrayLike) -> Array:
    """[...]: angle between the rays to the estimated and the true origin, degrees."""
    a, b = np.asarray(t_est, dtype=np.float64), np.asarray(t_gt, dtype=np.float64)
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def rot_10deg(R_est: ArrayLike, R_gt: ArrayLike) -> Booleans:
    """Rot<10° [...]: E_r below 10°."""
    return rotation_error_deg(R_est, R_gt) < ROTATION_LIMIT_DEG


def depth_5pct(t_est: ArrayLike, t_gt: ArrayLike) -> Booleans:
    """Depth<5 % [...]: E_z below 5 % of the true depth."""
    return depth_error_rel(t_est, t_gt) < DEPTH_LIMIT_REL


def pose_10deg_5pct(R_est: ArrayLike, t_est: ArrayLike, R_gt: ArrayLike, t_gt: ArrayLike) -> Booleans:
    """Pose@10°/5 % [...]: rotation error below 10° and translation error below 5 % of the true range."""
    return rot_10deg(R_est, R_gt) & (translation_error_rel(t_est, t_gt) < TRANSLATION_LIMIT_REL)


def add_m(R_est: ArrayLike, t_est: ArrayLike, R_gt: ArrayLike, t_gt: ArrayLike, points_body_m: ArrayLike) -> Array:
    """ADD [...], metres: mean over model points x [P, 3] of ||(R_est x + t_est) - (R_gt x + t_gt)||."""
    points = np.asarray(points_body_m, dtype=np.float64)
    delta_R = np.asarray(R_est, dtype=np.float64) - np.asarray(R_gt, dtype=np.float64)
    delta_t = np.asarray(t_est, dtype=np.float64) - np.asarray(t_gt, dtype=np.float64)
    moved = points @ np.swapaxes(delta_R, -1, -2) + delta_t[..., None, :]
    return np.linalg.norm(moved, axis=-1).mean(axis=-1)


def add_within(add: ArrayLike, diameter_m: ArrayLike, fraction: float) -> Booleans:
    """ADD-0.5d, ADD-0.1d [...]: ADD `add`, metres, below `fraction` of the model's diameter."""
    return np.asarray(add, dtype=np.float64) < fraction * np.asarray(diameter_m, dtype=np.float64)


def recall(found: int, targets: int) -> float | None:
    """Detection recall, 0..1: share of all targets that have a pose, right or wrong; None without targets."""
    return found / targets if targets else None


def false_positives_per_1000(false_poses: int, empty_frames: int) -> float | None:
    """False poses per 1,000 frames without a target; None without such frames."""
    return 1000.0 * false_poses / empty_frames if empty_frames else None


def depth_inside(t_est: ArrayLike, t_gt: ArrayLike, covariance: ArrayLike, sigmas: float) -> Booleans:
    """[...]: whether the true depth lies within `sigmas` standard deviations of the estimated one."""
    variance = np.asarray(covariance, dtype=np.float64)[..., 2, 2]
    return depth_error_m(t_est, t_gt) <= sigmas * np.sqrt(variance)


def bearing_inside(t_est: ArrayLike, t_gt: ArrayLike, covariance: ArrayLike, sigmas: float) -> Booleans:
    """[..., 2]: the same for the ray's two slopes, x/z and y/z; their variance by the Jacobian at the estimate."""
    est, gt = np.asarray(t_est, dtype=np.float64), np.asarray(t_gt, dtype=np.float64)
    slopes = est[..., :2] / est[..., 2:]
    J = np.concatenate([np.broadcast_to(np.eye(2), (*slopes.shape, 2)), -slopes[..., None]], axis=-1)
    J = J / est[..., 2, None, None]
    variance = np.einsum("...ij,...jk,...ik->...i", J, np.asarray(covariance, dtype=np.float64)[..., :3, :3], J)
    return np.abs(gt[..., :2] / gt[..., 2:] - slopes) <= sigmas * np.sqrt(np.maximum(variance, 0.0))


def rotation_inside(R_est: ArrayLike, R_gt: ArrayLike, covariance: ArrayLike, sigmas: float) -> Booleans:
    """[..., 3]: the same for the rotation vector that turns the estimate into the truth, each axis of `cam`."""
    est, gt = np.asarray(R_est, dtype=np.float64), np.asarray(R_gt, dtype=np.float64)
    error_rad = so3_log(gt @ np.swapaxes(est, -1, -2))
    variance = np.diagonal(np.asarray(covariance, dtype=np.float64)[..., 3:, 3:], axis1=-2, axis2=-1)
    return np.abs(error_rad) <= sigmas * np.sqrt(variance)


def nees(
    R_est: ArrayLike, t_est: ArrayLike, R_gt: ArrayLike, t_gt: ArrayLike, covariance: ArrayLike
) -> tuple[Array, Array, Array]:
    """Normalised estimation error squared [...]: e' P^-1 e of the whole pose, of its position and of its rotation.

    NaN for each of the three whose covariance is singular: the error is undefined there.
    """
    est = np.asarray(R_est, dtype=np.float64)
    turn_rad = so3_log(np.asarray(R_gt, dtype=np.float64) @ np.swapaxes(est, -1, -2))
    shift_m = np.asarray(t_gt, dtype=np.float64) - np.asarray(t_est, dtype=np.float64)
    error = np.concatenate([shift_m, turn_rad], axis=-1)
    P = np.asarray(covariance, dtype=np.float64)

    def of(part: slice) -> Array:
        e, of_part = error[..., part], P[..., part, part]
        sound = np.linalg.slogdet(of_part)[0] != 0.0
        inverted = np.where(sound[..., None, None], of_part, np.eye(of_part.shape[-1]))
        return np.where(sound, np.sum(e * np.linalg.solve(inverted, e[..., None])[..., 0], axis=-1), np.nan)

    return of(slice(0, 6)), of(slice(0, 3)), of(slice(3, 6))
