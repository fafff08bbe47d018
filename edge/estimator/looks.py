"""Looks at one target in one frame, plain or mirrored, and what several of them say together. Pure.

An aircraft mirrored left to right is an aircraft still, its port side for its starboard side, and what the network gets
wrong of a picture it gets wrong otherwise of the mirrored one: the two together are better than either.
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
from msgs.geometry import rotation_angle, so3_log

# cam x and target y turn round; the two together make a rotation of a rotation.
MIRROR_CAM, MIRROR_TARGET = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
# Rotations nearer than this are one answer, of which there is a mean; the others are another.
AGREEING_RAD = np.radians(40.0)
# Farther than this is no worse: a nose taken for a tail.
DISAGREEING_RAD = np.radians(60.0)

# No one look is surer than this of a target, nor of there being none.
SUREST_NO, SUREST_YES = 0.01, 0.995


def mirrored(images_bgr: NDArray[np.uint8], K: Array, turned: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], Array]:
    """Images [N, H, W, 3], those that are `turned` [N] with left for right, and the K [N, 3, 3] of these pixels."""
    images_bgr, K = images_bgr.copy(), K.copy()
    for i in np.flatnonzero(turned):
        images_bgr[i] = cv2.flip(images_bgr[i], 1)
    K[turned, 0, 1:] *= -1.0
    K[turned, 0, 2] += images_bgr.shape[2] - 1
    return images_bgr, K


def unmirrored(peaks: Peaks, width_px: int, turned: NDArray[np.bool_]) -> Peaks:
    """What the network says of images of which some are `turned` [N], for the images as they were; doing it twice gives
    the first back."""
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
    """Probability of a target where the whole frame has one with `place_score` and windows with `look_scores`.

    The odds multiply: the frame's, made small, and its native pixels are taken for two witnesses. The windows, of which
    there is at least one, show the same pixels and are one witness, their mean.
    """
    place, *looks = np.clip([place_score, *look_scores], SUREST_NO, SUREST_YES)
    log_odds = np.log(place / (1.0 - place)) + np.mean([np.log(look / (1.0 - look)) for look in looks])
    return float(1.0 / (1.0 + np.exp(-log_odds)))


def of_one_target(look: Estimate, first: Estimate) -> bool:
    """Whether a look lies where the first one does, and is not of another aircraft in the same window."""
    return lies_on(look.box_xyxy_px, [first.box_xyxy_px])


def of_looks(looks: Sequence[Estimate], coarser: Sequence[Estimate] = ()) -> Estimate:
    """One estimate of one target seen in several windows of one frame.

    Box, direction and range are means over `looks`; so is the rotation over all that agree with the most believed one,
    of those through `coarser` windows too. All are of the same pixels: the covariance is no smaller than their mean,
    and larger by how far they lie apart.
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
    """Mean R_cam_target [3, 3] of those around the one that the others, each by its sureness, lie nearest to.

    And its covariance [3, 3]: theirs, and how far all lie from it.
    """
    R = np.stack([look.R_cam_target for look in looks])
    covariances = np.stack([look.covariance[3:, 3:] for look in looks])
    variances = np.trace(covariances, axis1=1, axis2=2)
    apart_rad = rotation_angle(R[:, None], R[None])
    middle = int(np.argmin(np.minimum(apart_rad, DISAGREEING_RAD) @ (1.0 / np.sqrt(variances))))
    agreeing = apart_rad[middle] < AGREEING_RAD
    shares = (1.0 / variances) / np.sum(1.0 / variances)
    U, _, Vt = np.linalg.svd(np.einsum("n,nij->ij", shares * agreeing, R))
    mean = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    away = so3_log(R @ mean.T)
    spread = np.einsum("n,ni,nj->ij", shares, away, away)
    return mean, np.average(covariances[agreeing], axis=0, weights=shares[agreeing]) + spread
