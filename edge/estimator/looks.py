"""Evaluations of one target in one frame ("looks"), plain or mirrored, and how several are combined. Pure.

An aircraft mirrored left to right is still an aircraft, with port and starboard swapped, and the network's errors on an
image and on its mirror image differ: the two combined are better than either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.estimator.decode import lies_on
from edge.estimator.model import Peaks
from edge.types import Array, Estimate
from msgs.geometry import nearest_rotation, rotation_angle, so3_log

# Mirroring negates cam x and target y; applied from both sides they keep a rotation a rotation.
MIRROR_CAM, MIRROR_TARGET = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
# Rotations nearer to each other than this agree and are averaged; others are a different answer.
AGREEING_RAD = np.radians(40.0)
# A larger distance counts no more than this: nose and tail confused.
DISAGREEING_RAD = np.radians(60.0)

# Limits of a single evaluation's probability of a target.
SUREST_NO, SUREST_YES = 0.01, 0.995


def mirrored(images_bgr: NDArray[np.uint8], K: Array, turned: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], Array]:
    """Images [N, H, W, 3], those in `turned` [N] mirrored left to right, and the K [N, 3, 3] of these pixels."""
    images_bgr, K = images_bgr.copy(), K.copy()
    for i in np.flatnonzero(turned):
        images_bgr[i] = cv2.flip(images_bgr[i], 1)
    K[turned, 0, 1:] *= -1.0
    K[turned, 0, 2] += images_bgr.shape[2] - 1
    return images_bgr, K


def unmirrored(peaks: Peaks, width_px: int, turned: NDArray[np.bool_]) -> Peaks:
    """The network's outputs for images of which some are mirrored (`turned` [N]), converted to the original images. It
    is its own inverse."""
    last_px = np.array([width_px - 1, 0], dtype=np.float32)
    turn = np.array([-1.0, 1.0], dtype=np.float32)
    at_peaks = turned[:, None, None]
    return replace(
        peaks,
        center_px=np.where(at_peaks, last_px + turn * peaks.center_px, peaks.center_px),
        origin_px=np.where(at_peaks, last_px + turn * peaks.origin_px, peaks.origin_px),
        t_cam_target_m=np.where(at_peaks, peaks.t_cam_target_m @ MIRROR_CAM.astype(np.float32), peaks.t_cam_target_m),
        R_cam_target=np.where(
            at_peaks[..., None],
            (MIRROR_CAM @ peaks.R_cam_target @ MIRROR_TARGET).astype(np.float32),
            peaks.R_cam_target,
        ),
    )


def confirmed(place_score: float, look_scores: Sequence[float]) -> float:
    """Probability of a target that the whole frame shows with `place_score` and windows show with `look_scores`.

    The odds are multiplied: the downscaled frame and the native pixels are treated as independent evidence. The
    windows, at least one, show the same pixels and count once, with their mean log-odds.
    """
    place, *looks = np.clip([place_score, *look_scores], SUREST_NO, SUREST_YES)
    log_odds = np.log(place / (1.0 - place)) + np.mean([np.log(look / (1.0 - look)) for look in looks])
    return float(1.0 / (1.0 + np.exp(-log_odds)))


def of_one_target(look: Estimate, first: Estimate) -> bool:
    """Whether two evaluations show the same target, not two aircraft in the same window."""
    return lies_on(look.box_xyxy_px, [first.box_xyxy_px])


def of_looks(looks: Sequence[Estimate], coarser: Sequence[Estimate] = ()) -> Estimate:
    """One estimate of one target evaluated in several windows of one frame.

    Box, direction and range (geometric mean) are means over `looks`. The rotation is the mean of those that agree with
    the most plausible one, those of `coarser` windows included. As all evaluations share the same pixels, the
    covariance is not reduced: it is the mean of theirs plus the scatter between them.
    """
    if len(looks) == 1 and not coarser:
        return looks[0]
    t_m = np.stack([look.t_cam_target_m for look in looks])
    log_ranges = np.log(np.linalg.norm(t_m, axis=1))
    ray = (t_m / np.exp(log_ranges)[:, None]).mean(0)
    t_mean_m = np.exp(log_ranges.mean()) * ray / np.linalg.norm(ray)
    covariance = np.zeros((6, 6))
    relative = [
        look.covariance[:3, :3] / np.exp(2 * log_range) for look, log_range in zip(looks, log_ranges, strict=True)
    ]
    covariance[:3, :3] = np.exp(2 * log_ranges.mean()) * np.mean(relative, axis=0)
    aside_m = t_m * (np.exp(log_ranges.mean()) / np.exp(log_ranges))[:, None] - t_mean_m
    covariance[:3, :3] += log_ranges.var() * np.outer(t_mean_m, t_mean_m) + aside_m.T @ aside_m / len(looks)
    R, covariance[3:, 3:] = _rotation_of([*looks, *coarser])
    return replace(
        looks[0],
        score=float(np.mean([look.score for look in looks])),
        box_xyxy_px=np.mean([look.box_xyxy_px for look in looks], axis=0),
        R_cam_target=R,
        t_cam_target_m=t_mean_m,
        covariance=covariance,
    )


def _rotation_of(looks: Sequence[Estimate]) -> tuple[Array, Array]:
    """Mean R_cam_target [3, 3] of the rotations that agree with the (weighted) medoid, and its covariance [3, 3].

    The covariance is the weighted mean of theirs plus the scatter of all rotations about the mean.
    """
    R = np.stack([look.R_cam_target for look in looks])
    covariances = np.stack([look.covariance[3:, 3:] for look in looks])
    variances = np.trace(covariances, axis1=1, axis2=2)
    apart_rad = rotation_angle(R[:, None], R[None])
    middle = int(np.argmin(np.minimum(apart_rad, DISAGREEING_RAD) @ (1.0 / np.sqrt(variances))))
    agreeing = apart_rad[middle] < AGREEING_RAD
    shares = (1.0 / variances) / np.sum(1.0 / variances)
    mean = nearest_rotation(np.einsum("n,nij->ij", shares * agreeing, R))
    away = so3_log(R @ mean.T)
    spread = np.einsum("n,ni,nj->ij", shares, away, away)
    return mean, np.average(covariances[agreeing], axis=0, weights=shares[agreeing]) + spread
