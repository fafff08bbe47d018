"""Lines of boxes, ellipses and ellipsoids. Pure; pixel centres are at integer coordinates, `cam` is x right, y down,
z forward."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from msgs.geometry import q_wxyz_from_R
from msgs.wire import Array

NEAR_M = 0.5  # near plane: closer points are not projected
SIGMAS = 2.0  # of every ellipse and ellipsoid drawn
_ELLIPSE_POINTS = 48
_OPENCV_LENSES = (0, 4, 5, 8, 12, 14)  # possible numbers of coefficients of OpenCV's camera model
_OPENCV_MODELS = ("", "plumb_bob", "rational_polynomial")  # its names in ROS; some drivers send none
# Corners are numbered by their signs: bit 0 x, bit 1 y, bit 2 z.
_EDGES = tuple((a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit)


def box_edges_m(size_m: ArrayLike) -> Array:
    """[12, 2, 3] edges of a box of length, width, height (m) about the target's origin, in its body axes."""
    signs = np.array([[(corner >> axis & 1) * 2.0 - 1.0 for axis in range(3)] for corner in range(8)])
    corners_m = 0.5 * signs * np.asarray(size_m, dtype=np.float64)
    return np.array([[corners_m[a], corners_m[b]] for a, b in _EDGES])


def posed(points_m: ArrayLike, R_cam_target: ArrayLike, t_cam_target_m: ArrayLike) -> Array:
    """Points [..., 3] from the target's body frame to `cam`."""
    return np.asarray(points_m) @ np.asarray(R_cam_target).T + np.asarray(t_cam_target_m)


def project(points_cam_m: ArrayLike, K: ArrayLike, distortion: ArrayLike = (), model: str = "") -> Array | None:
    """Pixels [..., 2] of points [..., 3], by OpenCV's camera model; None if any is not in front of the camera.

    Also None for another distortion model: drawn without distortion, a box would be in the wrong place.
    """
    points = np.asarray(points_cam_m, dtype=np.float64)
    lens = np.asarray(distortion, dtype=np.float64)
    if model not in _OPENCV_MODELS or lens.size not in _OPENCV_LENSES or (points[..., 2] < NEAR_M).any():
        return None
    zero = np.zeros(3)
    px, _ = cv2.projectPoints(points.reshape(-1, 1, 3), zero, zero, np.asarray(K, dtype=np.float64), lens)
    return np.asarray(px, dtype=np.float64).reshape(*points.shape[:-1], 2)


def pixel_covariance(t_cam_m: Array, covariance_m2: Array, K: ArrayLike) -> Array:
    """[2, 2] of the projection of a point [3] with covariance [3, 3] in `cam`, to first order, without distortion."""
    x, y, z = t_cam_m
    K = np.asarray(K, dtype=np.float64)
    slopes = K[:2, :2] @ np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
    return slopes @ covariance_m2 @ slopes.T


def ellipse(center: ArrayLike, covariance: Array) -> Array:
    """[N, 2] closed line at `SIGMAS` about a point [2] with covariance [2, 2]."""
    values, vectors = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.asarray(center) + SIGMAS * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Half axes [3] at `SIGMAS` and their orientation (q_xyzw, [4]) of a covariance [3, 3]."""
    values, vectors = np.linalg.eigh(covariance)
    if np.linalg.det(vectors) < 0.0:
        vectors[:, 0] *= -1.0
    return SIGMAS * np.sqrt(np.maximum(values, 0.0)), np.roll(q_wxyz_from_R(vectors), -1)
