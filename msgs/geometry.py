"""Rotations and quaternions, pure NumPy, broadcasting over leading axes.

`R_a_b` transforms vectors from frame b to frame a. Quaternions are Hamilton; the name gives their component order.
Angles are radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
# `cam` (x right, y down, z forward) into axes that point forward, right and down: of a camera along the nose, upright.
R_FORWARD_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
R_FORWARD_CAM.setflags(write=False)
# Variance that stands for "unknown"; ROS has no other representation for it.
NOT_ESTIMATED = 1e6
# Cosine of pitch below which rounding, and no longer the matrix, decides what is roll and what is yaw.
VERTICAL = 1e-8


def skew(vector: ArrayLike) -> Array:
    """[..., 3] to the [..., 3, 3] matrix with skew(v) @ w = v x w."""
    v = np.asarray(vector, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(rotation_vector_rad: ArrayLike) -> Array:
    """Rotation vectors [..., 3] to rotation matrices [..., 3, 3] (Rodrigues)."""
    w = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = skew(w)
    # np.sinc(x) = sin(pi x) / (pi x): smooth at 0 without a branch.
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + a * k + b * (k @ k)


def so3_log(R: ArrayLike) -> Array:
    """Rotation matrices [..., 3, 3] to rotation vectors [..., 3], |w| <= pi; well-conditioned up to pi."""
    q = q_wxyz_from_R(R)
    q = np.where(q[..., :1] < 0.0, -q, q)
    half_angle = np.arctan2(np.linalg.norm(q[..., 1:], axis=-1, keepdims=True), q[..., :1])
    scale = 2.0 / np.sinc(half_angle / np.pi)
    return q[..., 1:] * scale


def slerp(R_a: Array, R_b: Array, share: ArrayLike) -> Array:
    """Rotations [..., 3, 3] at the given share [...] of the shortest turn from R_a to R_b [..., 3, 3]."""
    return R_a @ so3_exp(np.asarray(share)[..., None] * so3_log(R_a.swapaxes(-1, -2) @ R_b))


def rotation_angle(R_a: ArrayLike, R_b: ArrayLike) -> Array:
    """Geodesic distance [...] in radians between rotations [..., 3, 3] (paper: E_r, before degrees)."""
    relative = np.swapaxes(np.asarray(R_a, dtype=np.float64), -1, -2) @ np.asarray(R_b, dtype=np.float64)
    axis = np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        axis=-1,
    )
    sine = 0.5 * np.linalg.norm(axis, axis=-1)
    cosine = 0.5 * (np.trace(relative, axis1=-2, axis2=-1) - 1.0)
    return np.arctan2(sine, cosine)


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotation nearest, in the sum of squares, to a matrix [3, 3]: to a mean of rotations, or a rounded one."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    R = u @ vt
    return R if np.linalg.det(R) > 0.0 else u @ np.diag([1.0, 1.0, -1.0]) @ vt


def _matrices(rows: list[list[Array]]) -> Array:
    """Entries [...], row by row, to matrices [..., rows, columns]; for a single one much quicker than np.stack."""
    entries = np.array(rows)
    # Contiguous: NumPy multiplies others by another algorithm, which rounds differently.
    return np.ascontiguousarray(entries.transpose(*range(2, entries.ndim), 0, 1))


def q_wxyz_from_R(R: ArrayLike) -> Array:
    """Rotation matrices [..., 3, 3] to unit quaternions [..., 4], w >= 0 (Bar-Itzhack: largest diagonal first)."""
    m = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1])
    xy, xz, yz = (m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2])
    rows = [
        [1 + m00 + m11 + m22, x, y, z],
        [x, 1 + m00 - m11 - m22, xy, xz],
        [y, xy, 1 - m00 + m11 - m22, yz],
        [z, xz, yz, 1 - m00 - m11 + m22],
    ]
    candidates = _matrices(rows)
    best = np.argmax(np.array([m00 + m11 + m22, m00, m11, m22]), axis=0)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0.0, -q, q)


def R_from_q_wxyz(q_wxyz: ArrayLike) -> Array:
    """Quaternions [..., 4] (normalised here) to rotation matrices [..., 3, 3]; ValueError on a zero quaternion."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(norm > 1e-9):
        raise ValueError("a zero or non-finite quaternion is not a rotation")
    unit = q / norm
    w, x, y, z = unit[..., 0], unit[..., 1], unit[..., 2], unit[..., 3]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return _matrices(rows)


def R_from_euler(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Aerospace Z-Y-X angles [...] to R_ned_body [..., 3, 3]."""
    roll, pitch, yaw = np.broadcast_arrays(roll_rad, pitch_rad, yaw_rad)
    zero = np.zeros_like(np.asarray(roll, dtype=np.float64))
    about = lambda x, y, z: so3_exp(np.stack([x + zero, y + zero, z + zero], axis=-1))  # noqa: E731
    return about(zero, zero, yaw) @ about(zero, pitch, zero) @ about(roll, zero, zero)


def euler_from_R(R_ned_body: ArrayLike) -> tuple[Array, Array, Array]:
    """R_ned_body [..., 3, 3] to aerospace (roll, pitch, yaw), radians; roll is 0 by convention at pitch = ±90°."""
    R = np.asarray(R_ned_body, dtype=np.float64)
    level = np.hypot(R[..., 2, 1], R[..., 2, 2])
    vertical = level < VERTICAL
    pitch = np.arctan2(-R[..., 2, 0], level)
    roll = np.where(vertical, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.where(vertical, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return roll, pitch, yaw


def rotation_estimated(covariance: Array) -> bool:
    """Whether, according to a pose's covariance [6, 6] (position, rotation), its rotation was estimated at all."""
    return bool(np.trace(covariance[3:, 3:]) < NOT_ESTIMATED)
