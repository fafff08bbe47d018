"""From network outputs to estimates: what is accepted, where it lies on the frame, how sure it is. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from edge.estimator.model import Peaks
from edge.estimator.window import PixelMap
from edge.types import Array, Estimate
from msgs.contract import ModelContract

# A depth beyond the trained range is believed with a covariance that reaches back to the range, up to this factor.
RANGE_EXCESS_MAX = 2.0
# Two boxes of which the smaller lies this much inside the larger are one aircraft.
SAME_TARGET_OVERLAP = 0.5
ROTATION_TOLERANCE = 0.05


def decode(
    peaks: Peaks,
    image: int,
    pixel_map: PixelMap,
    K_network: Array,
    contract: ModelContract,
    stage: Literal["acquire", "track"],
    refused: Counter[str],
) -> list[Estimate]:
    """Accepted, distinct targets of one image of the batch, best score first; refusals are counted by reason."""
    score_min = contract.acquire_score_min if stage == "acquire" else contract.track_score_min
    found = []
    for peak in range(peaks.score.shape[1]):
        score = float(peaks.score[image, peak])
        if not score >= score_min:
            continue
        R = peaks.R_cam_target[image, peak].astype(np.float64)
        t_m = peaks.t_cam_target_m[image, peak].astype(np.float64)
        sigma = peaks.sigma[image, peak].astype(np.float64)
        box = pixel_map.box_to_frame(peaks.center_px[image, peak], peaks.size_px[image, peak])
        reason = _refusal(R, t_m, sigma, box, contract.trained_range_m)
        if reason is not None:
            refused[reason] += 1
            continue
        covariance = pose_covariance(t_m, sigma, K_network, contract.trained_range_m)
        found.append(Estimate(score, box, _nearest_rotation(R), t_m, covariance, stage))
    return distinct(sorted(found, key=lambda estimate: -estimate.score))


def pose_covariance(
    t_cam_target_m: ArrayLike, sigma: ArrayLike, K: ArrayLike, trained_range_m: tuple[float, float]
) -> Array:
    """Covariance [6, 6] (x, y, z m, rotation x, y, z rad; cam) from sigma [6] of (u, v, log Z, rotation).

    t = Z K^-1 [u, v, 1], so J = [Z K^-1 e_u, Z K^-1 e_v, t]. `K` is of the pixels that u and v are counted in.
    Outside the trained range the distance to it, in log Z, is added to the depth's sigma.
    """
    t_m, sigma = np.asarray(t_cam_target_m, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    K_inverse = np.linalg.inv(np.asarray(K, dtype=np.float64))
    sigma_log_z = np.hypot(sigma[2], np.log(_range_excess(t_m[2], trained_range_m)))
    J = np.column_stack([t_m[2] * K_inverse[:, 0], t_m[2] * K_inverse[:, 1], t_m])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = J @ np.diag([sigma[0] ** 2, sigma[1] ** 2, sigma_log_z**2]) @ J.T
    covariance[3:, 3:] = np.diag(sigma[3:] ** 2)
    return covariance


def distinct(estimates: Sequence[Estimate], known_boxes: Sequence[Array] = ()) -> list[Estimate]:
    """Those, in order, that lie on none of the known boxes nor on one taken before."""
    boxes = list(known_boxes)
    kept = []
    for estimate in estimates:
        if all(overlap(estimate.box_xyxy_px, box) < SAME_TARGET_OVERLAP for box in boxes):
            kept.append(estimate)
            boxes.append(estimate.box_xyxy_px)
    return kept


def overlap(box_a_xyxy: ArrayLike, box_b_xyxy: ArrayLike) -> float:
    """Intersection over the smaller box's area, 0..1."""
    a, b = np.asarray(box_a_xyxy, dtype=np.float64), np.asarray(box_b_xyxy, dtype=np.float64)
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    if sides.min() <= 0:
        return 0.0
    return float(np.prod(sides) / min(np.prod(a[2:] - a[:2]), np.prod(b[2:] - b[:2])))


def nearest_expected(estimates: Sequence[Estimate], box_xyxy_px: ArrayLike) -> Estimate | None:
    """The estimate for an expected box: a strong one beats a weak one, a near one a far one."""
    box = np.asarray(box_xyxy_px, dtype=np.float64)
    longer_px = max(box[2] - box[0], box[3] - box[1], 1.0)

    def merit(estimate: Estimate) -> float:
        away = (estimate.box_xyxy_px[:2] + estimate.box_xyxy_px[2:] - box[:2] - box[2:]) / (2.0 * longer_px)
        return estimate.score * float(np.exp(-away @ away))

    return max(estimates, key=merit, default=None)


def _refusal(R: Array, t_m: Array, sigma: Array, box: Array, trained_range_m: tuple[float, float]) -> str | None:
    if not all(np.all(np.isfinite(value)) for value in (R, t_m, sigma, box)):
        return "not_finite"
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        return "no_rotation"
    if np.any(sigma <= 0) or np.any(box[2:] <= box[:2]):
        return "no_size"
    if t_m[2] <= 0 or _range_excess(t_m[2], trained_range_m) > RANGE_EXCESS_MAX:
        return "out_of_range"
    return None


def _range_excess(z_m: float, trained_range_m: tuple[float, float]) -> float:
    """Factor by which a depth lies outside the trained range; 1 inside."""
    near_m, far_m = trained_range_m
    return float(max(near_m / z_m, z_m / far_m, 1.0))


def _nearest_rotation(R: Array) -> Array:
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)
