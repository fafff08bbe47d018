"""From network outputs to estimates: acceptance, position on the frame, covariance. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.estimator.given_size import Depth, TargetSize, combined, depth_by_size
from edge.estimator.model import Peaks
from edge.estimator.own_parts import OwnParts
from edge.estimator.window import PixelMap, clipped, whole_frame
from edge.tracking.boxes import overlap
from edge.types import Array, Estimate
from msgs.contract import ModelContract
from msgs.geometry import nearest_rotation

# A depth outside the trained range, up to this factor, is accepted with a covariance that reaches back to the range.
RANGE_EXCESS_MAX = 2.0
# Two boxes are of one aircraft if this share of the smaller lies inside the larger.
SAME_TARGET_OVERLAP = 0.5
ROTATION_TOLERANCE = 0.05
# 1-sigma of (u, v) px, log Z and rotation rad, widened for what is doubtful, above which a network has told nothing,
# and the tracker's matrices would become singular.
SIGMA_MAX = np.array([1e4, 1e4, 100.0, 100.0, 100.0, 100.0])
# A box whose longer side is below this many pixels of the frame shows too little shape for a pose.
BOX_MIN_PX = 8.0
# A box this near to the frame's edge, as a share of its longer side plus pixels, may be cut by it.
EDGE_SHARE, EDGE_PX = 0.05, 1.5
# Of a cut target neither size nor centre is known: 1-sigma of log Z, and of the origin's pixels in units of the box's
# longer side. They cover the shipped model's errors on targets of which half is outside. If less is left, the network
# takes that for the whole and its box is too small: the longer side of the expected box then counts.
CUT_SIGMA_LOG_Z, CUT_SIGMA_ORIGIN = 0.4, 0.25
# The visible part does not show which end is the nose either: 1-sigma about each axis.
CUT_SIGMA_ROTATION_RAD = 0.8
# Low scores are often false: 1-sigma errors of those, units as above. Their squares times (1 - score) are added to the
# variances. Chosen on the validation split and the first flights of unseen airframes.
DOUBT_SIGMA_LOG_Z, DOUBT_SIGMA_ORIGIN, DOUBT_SIGMA_ROTATION_RAD = 0.5, 0.05, 0.5
# A depth at the graph's upper limit is only a lower bound, one at its lower limit only an upper bound: 1-sigma of log Z
# then, and the relative tolerance for being at a limit.
LIMIT_SIGMA_LOG_Z, LIMIT_TOLERANCE = 1.0, 1e-3
# No sight line in training is steeper: the network does not know the outlines of aircraft seen from farther above or
# below. The excess, as 1-sigma about each axis, covers the shipped model's errors up to the vertical.
TRAINED_STEEPNESS_RAD = float(np.deg2rad(40.0))
# The same of sight lines farther off the optical axis, as only wide-angle lenses have them: a pinhole image stretches
# there what it shows.
TRAINED_OFF_AXIS_RAD = float(np.deg2rad(40.0))


class Shown(NamedTuple):
    """The part of a frame that the network was given, and the mapping of its pixels."""

    pixel_map: PixelMap
    K: Array  # [3, 3] of the network's pixels
    size_wh: tuple[int, int]  # of the network's input
    frame_wh: tuple[int, int]
    up_cam: Array | None = None  # as in Frame
    own_parts: OwnParts | None = None  # as in Frame

    def cut_sides(self, box_xyxy_px: Array) -> NDArray[np.bool_]:
        """[4], for each side of a box on the frame: whether an edge of the window, beyond which the frame continues,
        may cut the object in the box."""
        lens = self.pixel_map.lens
        corners = np.array([[-0.5, -0.5], np.array(self.size_wh) - 0.5])
        window = self.pixel_map.to_pinhole(corners).ravel()
        whole = whole_frame(self.frame_wh, lens)
        picture = np.array([whole.left, whole.top, whole.left + whole.width, whole.top + whole.height]) - 0.5
        box = box_xyxy_px if lens is None else lens.box_to_pinhole(box_xyxy_px)
        inwards = np.array([1.0, 1.0, -1.0, -1.0])
        hides = (window - picture) * inwards > EDGE_PX
        return np.asarray(hides & ((box - window) * inwards < _edge_margin_px(box)))

    def cuts(self, box_xyxy_px: Array) -> bool:
        """Whether some of the object in a box, on the frame or beyond, may not be seen: past an edge of the frame or
        the window, or behind parts of the own aircraft."""
        on_frame = clipped(box_xyxy_px, self.frame_wh)
        if _is_cut(box_xyxy_px, self.frame_wh) or np.any(self.cut_sides(on_frame)):
            return True
        margin_px = _edge_margin_px(on_frame) * np.array([-1.0, -1.0, 1.0, 1.0])
        return self.own_parts is not None and self.own_parts.touches(on_frame + margin_px)

    def hides(self, point_px: Array) -> bool:
        """Whether a point of the frame lies outside of it, or behind parts of the own aircraft."""
        off = not np.all((point_px >= -0.5) & (point_px <= np.array(self.frame_wh) - 0.5))
        return off or (self.own_parts is not None and self.own_parts.touches(np.tile(point_px, 2)))


def decode(
    peaks: Peaks,
    image: int,
    shown: Shown,
    contract: ModelContract,
    stage: Literal["acquire", "track"],
    score_min: float,
    refused: Counter[str],
    size: TargetSize | None = None,
    expected_xyxy_px: ArrayLike = (0.0, 0.0, 0.0, 0.0),
) -> list[Estimate]:
    """Accepted, distinct targets of one image of the batch, best score first.

    Rejected peaks are counted in `refused` by reason if their score reaches the contract's minimum. If the targets'
    `size` is given, it goes into the depth of those that no edge cuts. `expected_xyxy_px` [4]: the box, on the frame or
    beyond, of the target that the image was cut out for, if any.

    The covariance is enlarged for a target that is cut by the edge of the network's image or by parts of the own
    aircraft, of a size outside training, at a limit of depth, or seen from farther above or below than in training, or
    farther off the optical axis. A cut target whose origin is not to be seen, or one too small to show a shape, is
    rejected.
    """
    acquiring = stage == "acquire"
    calibration = contract.acquire_score if acquiring else contract.track_score
    least = contract.acquire_score_min if acquiring else contract.track_score_min
    pixel_map = shown.pixel_map
    expected_px = _longer_side_px(expected_xyxy_px, shown)
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
        on_frame = clipped(box, shown.frame_wh)
        reason = _refusal(R, t_m, sigma, box, contract.trained_range_m)
        cut = reason is None and shown.cuts(box)
        reason = reason or _unseen(box, shown.frame_wh) or ("cut_off" if cut and shown.hides(origin_px) else None)
        if reason is None:
            longer_px = float(peaks.size_px[image, peak].max())
            sigma = _widened(sigma, score, longer_px, contract.trained_box_px)
            if cut:
                sigma = np.hypot(sigma, _cut_sigma(max(longer_px, expected_px)))
            if np.any(sigma > SIGMA_MAX):
                reason = "unsure"
        if reason is not None:
            refused[reason] += score >= least
            continue
        nearest_m, farthest_m = contract.depth_limits_m
        if not nearest_m * (1.0 + LIMIT_TOLERANCE) < t_m[2] < farthest_m * (1.0 - LIMIT_TOLERANCE):
            sigma[2] = np.hypot(sigma[2], LIMIT_SIGMA_LOG_Z)
        # Outside the trained range the depth may be as far off as its distance to it.
        sigma[2] = np.hypot(sigma[2], np.log(_excess(t_m[2], contract.trained_range_m)))
        sigma[3:] = np.hypot(sigma[3:], max(_steepness_rad(t_m, shown.up_cam) - TRAINED_STEEPNESS_RAD, 0.0))
        sigma[3:] = np.hypot(sigma[3:], max(_off_axis_rad(t_m) - TRAINED_OFF_AXIS_RAD, 0.0))
        R, oversize = nearest_rotation(R), None
        if size is not None and not cut:
            sides = peaks.size_px[image, peak] / np.diag(shown.K)[:2]
            t_m, sigma, oversize = _sized(size, R, t_m, sides, sigma, score)
        found.append(Estimate(score, on_frame, R, t_m, pose_covariance(t_m, sigma, shown.K), stage, oversize))
    # Of several peaks on one target the heatmap's highest, the first, is where it is; another may have a higher score.
    return sorted(distinct(found), key=lambda estimate: -estimate.score)


def shown_size_px(size_px: ArrayLike, pixel_map: PixelMap) -> float:
    """Geometric mean of a box's sides [2] in network pixels, or in the frame's where those are fewer; 0: no size."""
    width, height = np.nan_to_num(np.asarray(size_px, dtype=np.float64).clip(min=0.0), posinf=0.0)
    enlarged = max(1.0, pixel_map.scale_xy[0] * pixel_map.scale_xy[1])
    return float(np.sqrt(width * height / enlarged))


def pose_covariance(t_cam_target_m: ArrayLike, sigma: ArrayLike, K: ArrayLike) -> Array:
    """Covariance [6, 6] (x, y, z m, rotation x, y, z rad; cam) from sigma [6] of (u, v, log Z, rotation).

    t = Z K^-1 [u, v, 1], so J = [Z K^-1 e_u, Z K^-1 e_v, t]. `K` is that of the image whose pixels u and v are in.
    """
    t_m, sigma = np.asarray(t_cam_target_m, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    K_inverse = np.linalg.inv(np.asarray(K, dtype=np.float64))
    J = np.column_stack([t_m[2] * K_inverse[:, 0], t_m[2] * K_inverse[:, 1], t_m])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = J @ np.diag(sigma[:3] ** 2) @ J.T
    covariance[3:, 3:] = np.diag(sigma[3:] ** 2)
    return covariance


def distinct(estimates: Sequence[Estimate], known_boxes: Sequence[Array] = ()) -> list[Estimate]:
    """The estimates, in order, that overlap none of the known boxes and no estimate kept before."""
    boxes = list(known_boxes)
    kept = []
    for estimate in estimates:
        if not lies_on(estimate.box_xyxy_px, boxes):
            kept.append(estimate)
            boxes.append(estimate.box_xyxy_px)
    return kept


def lies_on(box_xyxy: Array, known_boxes: Sequence[Array]) -> bool:
    """Whether a box overlaps one of `known_boxes` so much that both are of the same target."""
    return any(overlap(box_xyxy, known) >= SAME_TARGET_OVERLAP for known in known_boxes)


def nearest_expected(estimates: Sequence[Estimate], box_xyxy_px: ArrayLike) -> Estimate | None:
    """The estimate that fits an expected box best, by score and distance; None if there are no estimates."""
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
    """The box, extended by its longer side at each side where a window edge cuts its object; None: not cut."""
    cut = shown.cut_sides(box_xyxy_px)
    if not np.any(cut):
        return None
    longer_px = np.max(box_xyxy_px[2:] - box_xyxy_px[:2])
    return np.asarray(box_xyxy_px + cut * longer_px * np.array([-1.0, -1.0, 1.0, 1.0]))


def _is_cut(box_xyxy_px: Array, frame_wh: tuple[int, int]) -> bool:
    """Whether the frame's edge may cut the object in the box."""
    margin_px = _edge_margin_px(box_xyxy_px)
    return bool(
        np.any(box_xyxy_px[:2] < margin_px - 0.5) or np.any(box_xyxy_px[2:] > np.array(frame_wh) - 0.5 - margin_px)
    )


def _edge_margin_px(box_xyxy_px: Array) -> float:
    return EDGE_SHARE * float(np.max(box_xyxy_px[2:] - box_xyxy_px[:2])) + EDGE_PX


def _unseen(box_xyxy_px: Array, frame_wh: tuple[int, int]) -> str | None:
    """Why too little of a target is on the frame to give its pose; None: enough of it is."""
    visible = np.minimum(box_xyxy_px[2:], np.array(frame_wh) - 0.5) - np.maximum(box_xyxy_px[:2], -0.5)
    return "too_small" if np.max(visible) < BOX_MIN_PX or np.min(visible) <= 0 else None


def _longer_side_px(box_xyxy_px: ArrayLike, shown: Shown) -> float:
    """Longer side of a box on the frame in the network's pixels, at most the frame's: a prediction is unbounded."""
    x0, y0, x1, y1 = np.asarray(box_xyxy_px, dtype=np.float64)
    return float(np.max(np.minimum([x1 - x0, y1 - y0], max(shown.frame_wh)) * shown.pixel_map.scale_xy))


def _cut_sigma(longer_px: float) -> Array:
    """Sigma [6] of (u, v, log Z, rotation) of a cut target whose box is so long."""
    origin_px = CUT_SIGMA_ORIGIN * longer_px
    return np.array([origin_px, origin_px, CUT_SIGMA_LOG_Z, *[CUT_SIGMA_ROTATION_RAD] * 3])


def _widened(sigma: Array, score: float, longer_px: float, trained_box_px: tuple[float, float]) -> Array:
    """Sigma [6] of (u, v, log Z, rotation), enlarged for a low score and for sizes that training did not contain."""
    origin_px = DOUBT_SIGMA_ORIGIN * longer_px
    doubt = np.array([origin_px, origin_px, DOUBT_SIGMA_LOG_Z, *[DOUBT_SIGMA_ROTATION_RAD] * 3])
    wider = np.hypot(sigma, np.sqrt(1.0 - score) * doubt)
    wider[2] = np.hypot(wider[2], np.log(_excess(longer_px, trained_box_px)))
    return wider


def _sized(
    size: TargetSize, R: Array, t_m: Array, sides: Array, sigma: Array, score: float
) -> tuple[Array, Array, float | None]:
    """Position [3] and sigma [6] with the depth by the given size taken in, and how many times as large the target
    appears to be, if that contradicts it. `sides` [2]: of the box, in units of Z."""
    by_size = depth_by_size(size, R, t_m[:2] / t_m[2], sides, sigma[3:])
    # What may be none may also have a wrong box.
    by_size = by_size._replace(variance=by_size.variance + (1.0 - score) * DOUBT_SIGMA_LOG_Z**2)
    appearance = Depth(float(np.log(t_m[2])), float(sigma[2] ** 2))
    (log_z, variance), contradicted = combined(appearance, by_size)
    oversize = float(np.exp(appearance.log_z - by_size.log_z)) if contradicted else None
    return (
        t_m * np.exp(log_z - appearance.log_z),
        np.array([*sigma[:2], np.sqrt(variance), *sigma[3:]]),
        oversize,
    )


def _excess(value: float, trained: tuple[float, float]) -> float:
    """Factor by which a depth or a size lies outside the trained interval; 1 inside."""
    low, high = trained
    return float(max(low / value, value / high, 1.0))


def _steepness_rad(t_m: Array, up_cam: Array | None) -> float:
    """Angle of the sight line to the horizon, 0 .. pi / 2; 0 if it is unknown where up is."""
    return 0.0 if up_cam is None else float(np.arcsin(min(abs(float(t_m @ up_cam)) / float(np.linalg.norm(t_m)), 1.0)))


def _off_axis_rad(t_m: Array) -> float:
    """Angle of the sight line to the camera's optical axis."""
    return float(np.arctan2(np.hypot(t_m[0], t_m[1]), t_m[2]))
