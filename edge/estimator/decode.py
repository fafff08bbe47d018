"""From network outputs to estimates: what is accepted, where it lies on the frame, how sure it is. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.estimator.model import Peaks
from edge.estimator.window import PixelMap, whole_frame
from edge.types import Array, Estimate
from msgs.contract import ModelContract

# A depth beyond the trained range is believed with a covariance that reaches back to the range, up to this factor.
RANGE_EXCESS_MAX = 2.0
# Two boxes of which the smaller lies this much inside the larger are one aircraft.
SAME_TARGET_OVERLAP = 0.5
ROTATION_TOLERANCE = 0.05
# A longer side below this many pixels of the frame shows no shape to tell a pose from.
BOX_MIN_PX = 8.0
# A box this near to the frame's edge, in its longer sides and in pixels, may be cut by it.
EDGE_SHARE, EDGE_PX = 0.05, 1.5
# What is cut off is not known, so neither is how large the whole is nor where its middle: 1-sigma of log Z, and of the
# origin's pixels in longer sides of the box. They cover the shipped model's errors on targets of which half is off.
CUT_SIGMA_LOG_Z, CUT_SIGMA_ORIGIN = 0.4, 0.25
# Nor does what is left show which end is the nose: each axis, radians.
CUT_SIGMA_ROTATION_RAD = 0.8
# What scores low is often not what it is taken for: 1-sigma of those that are not, as above. Times 1 - score it is the
# variance of the doubt. Chosen on the validation split and the first flights of strangers.
DOUBT_SIGMA_LOG_Z, DOUBT_SIGMA_ORIGIN, DOUBT_SIGMA_ROTATION_RAD = 0.5, 0.05, 0.5
# A depth at the farthest that a graph tells is a least depth, one at the nearest a greatest: 1-sigma of log Z then, and
# how near counts as at it.
LIMIT_SIGMA_LOG_Z, LIMIT_TOLERANCE = 1.0, 1e-3


class Shown(NamedTuple):
    """What of a frame the network was shown, and as which pixels."""

    pixel_map: PixelMap
    K: Array  # [3, 3] of the network's pixels
    size_wh: tuple[int, int]  # the network's
    frame_wh: tuple[int, int]

    def cut_sides(self, box_xyxy_px: Array) -> NDArray[np.bool_]:
        """[4], at which sides of a box on the frame an edge of the window, with more of the frame behind it, may hide
        a part of what the box holds."""
        lens = self.pixel_map.lens
        corners = np.array([[-0.5, -0.5], np.array(self.size_wh) - 0.5])
        window = self.pixel_map.to_pinhole(corners).ravel()
        whole = whole_frame(self.frame_wh, lens)
        picture = np.array([whole.left, whole.top, whole.left + whole.width, whole.top + whole.height]) - 0.5
        box = box_xyxy_px if lens is None else lens.box_to_pinhole(box_xyxy_px)
        inwards = np.array([1.0, 1.0, -1.0, -1.0])
        hides = (window - picture) * inwards > EDGE_PX
        return np.asarray(hides & ((box - window) * inwards < _edge_margin_px(box)))


def decode(
    peaks: Peaks,
    image: int,
    shown: Shown,
    contract: ModelContract,
    stage: Literal["acquire", "track"],
    score_min: float,
    refused: Counter[str],
) -> list[Estimate]:
    """Accepted, distinct targets of one image of the batch, best score first.

    What the contract's least score would take for a target and is refused is counted by reason.

    A target cut by the edge of what was shown, of a size that was not trained or at the end of what depth can be told
    has a covariance that says so; one whose origin lies off the frame, or too small to show a shape, is not told.
    """
    acquiring = stage == "acquire"
    calibration = contract.acquire_score if acquiring else contract.track_score
    least = contract.acquire_score_min if acquiring else contract.track_score_min
    pixel_map = shown.pixel_map
    found = []
    for peak in range(peaks.score.shape[1]):
        shown_px = shown_size_px(peaks.size_px[image, peak], pixel_map)
        score = calibration.probability(float(peaks.score[image, peak]), shown_px)
        if not score >= score_min:
            continue
        R = peaks.R_cam_target[image, peak].astype(np.float64)
        t_m = peaks.t_cam_target_m[image, peak].astype(np.float64)
        sigma = peaks.sigma[image, peak].astype(np.float64)
        box = pixel_map.box_to_frame(peaks.center_px[image, peak], peaks.size_px[image, peak])
        origin_px = pixel_map.to_frame(peaks.origin_px[image, peak])
        on_frame = np.clip(box, -0.5, np.tile(shown.frame_wh, 2) - 0.5)
        cut = _is_cut(box, shown.frame_wh) or bool(np.any(shown.cut_sides(on_frame)))
        reason = _refusal(R, t_m, sigma, box, contract.trained_range_m) or _unseen(box, origin_px, cut, shown.frame_wh)
        if reason is not None:
            refused[reason] += score >= least
            continue
        longer_px = float(peaks.size_px[image, peak].max())
        sigma = _widened(sigma, score, longer_px, cut, contract.trained_box_px)
        nearest_m, farthest_m = contract.depth_limits_m
        if not nearest_m * (1.0 + LIMIT_TOLERANCE) < t_m[2] < farthest_m * (1.0 - LIMIT_TOLERANCE):
            sigma[2] = np.hypot(sigma[2], LIMIT_SIGMA_LOG_Z)
        covariance = pose_covariance(t_m, sigma, shown.K, contract.trained_range_m)
        found.append(Estimate(score, on_frame, _nearest_rotation(R), t_m, covariance, stage))
    return distinct(sorted(found, key=lambda estimate: -estimate.score))


def shown_size_px(size_px: ArrayLike, pixel_map: PixelMap) -> float:
    """Geometric mean of a box's sides [2] in network pixels, or in the frame's where those are fewer; 0: no size."""
    width, height = np.nan_to_num(np.asarray(size_px, dtype=np.float64).clip(min=0.0), posinf=0.0)
    enlarged = max(1.0, pixel_map.scale_xy[0] * pixel_map.scale_xy[1])
    return float(np.sqrt(width * height / enlarged))


def pose_covariance(
    t_cam_target_m: ArrayLike, sigma: ArrayLike, K: ArrayLike, trained_range_m: tuple[float, float]
) -> Array:
    """Covariance [6, 6] (x, y, z m, rotation x, y, z rad; cam) from sigma [6] of (u, v, log Z, rotation).

    t = Z K^-1 [u, v, 1], so J = [Z K^-1 e_u, Z K^-1 e_v, t]. `K` is of the pixels that u and v are counted in.
    Outside the trained range the distance to it, in log Z, is added to the depth's sigma.
    """
    t_m, sigma = np.asarray(t_cam_target_m, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    K_inverse = np.linalg.inv(np.asarray(K, dtype=np.float64))
    sigma_log_z = np.hypot(sigma[2], np.log(_excess(t_m[2], trained_range_m)))
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
        if not lies_on(estimate.box_xyxy_px, boxes):
            kept.append(estimate)
            boxes.append(estimate.box_xyxy_px)
    return kept


def lies_on(box_xyxy: ArrayLike, known_boxes: Sequence[Array]) -> bool:
    """Whether a box is of the same target as one of `known_boxes`."""
    return any(overlap(box_xyxy, known) >= SAME_TARGET_OVERLAP for known in known_boxes)


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
    if t_m[2] <= 0 or _excess(t_m[2], trained_range_m) > RANGE_EXCESS_MAX:
        return "out_of_range"
    return None


def grown(box_xyxy_px: Array, shown: Shown) -> Array | None:
    """The box, longer by its longer side beyond each edge of the window that cuts what it holds; None: none does."""
    cut = shown.cut_sides(box_xyxy_px)
    if not np.any(cut):
        return None
    longer_px = np.max(box_xyxy_px[2:] - box_xyxy_px[:2])
    return np.asarray(box_xyxy_px + cut * longer_px * np.array([-1.0, -1.0, 1.0, 1.0]))


def _is_cut(box_xyxy_px: Array, frame_wh: tuple[int, int]) -> bool:
    """Whether the frame's edge may hide a part of what the box holds."""
    margin_px = _edge_margin_px(box_xyxy_px)
    return bool(
        np.any(box_xyxy_px[:2] < margin_px - 0.5) or np.any(box_xyxy_px[2:] > np.array(frame_wh) - 0.5 - margin_px)
    )


def _edge_margin_px(box_xyxy_px: Array) -> float:
    return EDGE_SHARE * float(np.max(box_xyxy_px[2:] - box_xyxy_px[:2])) + EDGE_PX


def _unseen(box_xyxy_px: Array, origin_px: Array, cut: bool, frame_wh: tuple[int, int]) -> str | None:
    """Why too little of a target is on the frame to tell its pose, or None."""
    limit = np.array(frame_wh) - 0.5
    visible = np.minimum(box_xyxy_px[2:], limit) - np.maximum(box_xyxy_px[:2], -0.5)
    if np.max(visible) < BOX_MIN_PX or np.min(visible) <= 0:
        return "too_small"
    if cut and (not np.all(np.isfinite(origin_px)) or np.any(origin_px < -0.5) or np.any(origin_px > limit)):
        return "cut_off"
    return None


def _widened(sigma: Array, score: float, longer_px: float, cut: bool, trained_box_px: tuple[float, float]) -> Array:
    """Sigma [6] of (u, v, log Z, rotation), wider by what the score leaves in doubt and by what the network was not
    taught: cut targets, other sizes."""
    origin_px = DOUBT_SIGMA_ORIGIN * longer_px
    doubt = np.array([origin_px, origin_px, DOUBT_SIGMA_LOG_Z, *[DOUBT_SIGMA_ROTATION_RAD] * 3])
    wider = np.hypot(sigma, np.sqrt(1.0 - score) * doubt)
    wider[2] = np.hypot(wider[2], np.log(_excess(longer_px, trained_box_px)))
    if cut:
        wider[:2] = np.hypot(wider[:2], CUT_SIGMA_ORIGIN * longer_px)
        wider[2] = np.hypot(wider[2], CUT_SIGMA_LOG_Z)
        wider[3:] = np.hypot(wider[3:], CUT_SIGMA_ROTATION_RAD)
    return wider


def _excess(value: float, trained: tuple[float, float]) -> float:
    """Factor by which a depth or a size lies outside what was trained; 1 inside."""
    low, high = trained
    return float(max(low / value, value / high, 1.0))


def _nearest_rotation(R: Array) -> Array:
    u, _, vt = np.linalg.svd(R)
    return np.asarray(u @ vt)
