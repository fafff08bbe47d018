"""Metrics of a model on labelled images: pose errors, boxes, detection. Pure functions of predictions and labels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from msgs.contract import ScoreCalibration
from msgs.geometry import nearest_rotation
from sim_replay import metrics
from trainer.data import TrainingBatch
from trainer.model import PoseNet

SCORE_THRESHOLD = 0.3


class Predictions(NamedTuple):
    """Outputs for the highest peak of each image, named as in msgs.contract."""

    score: NDArray[np.float32]  # [N]
    center_px: NDArray[np.float32]  # [N, 2]
    size_px: NDArray[np.float32]  # [N, 2]
    origin_px: NDArray[np.float32]  # [N, 2]
    t_cam_target_m: NDArray[np.float32]  # [N, 3]
    R_cam_target: NDArray[np.float32]  # [N, 3, 3]
    sigma: NDArray[np.float32]  # [N, 6]


Predictor = Callable[[NDArray[np.uint8], NDArray[np.float32]], Predictions]


def torch_predictor(model: PoseNet) -> Predictor:
    """A predictor that runs `model` in evaluation mode on the device its weights are on."""
    device = next(model.parameters()).device

    @torch.no_grad()
    def predict(image_bgr: NDArray[np.uint8], K: NDArray[np.float32]) -> Predictions:
        out = model(torch.from_numpy(image_bgr).to(device), torch.from_numpy(K).to(device))
        return Predictions(*(value[:, 0].float().cpu().numpy() for value in out))

    return predict


def predict_all(predict: Predictor, batches: Iterable[TrainingBatch]) -> Predictions:
    """Predictions of all batches, concatenated."""
    parts = [predict(np.ascontiguousarray(b.image_bgr), np.ascontiguousarray(b.K)) for b in batches]
    return Predictions(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def calibrated(predicted: Predictions, calibration: ScoreCalibration) -> Predictions:
    """The predictions with scores converted to probabilities, for windows that are not enlarged."""
    shown_px = np.sqrt(np.prod(np.maximum(predicted.size_px, 0.0), axis=-1))
    told = [calibration.probability(float(p), float(s)) for p, s in zip(predicted.score, shown_px, strict=True)]
    return predicted._replace(score=np.array(told, dtype=np.float32))


def box_iou(center_a: NDArray, size_a: NDArray, center_b: NDArray, size_b: NDArray) -> NDArray:
    """Intersection over union [N] of boxes given as centres and sizes [N, 2]."""
    low = np.maximum(center_a - size_a / 2, center_b - size_b / 2)
    high = np.minimum(center_a + size_a / 2, center_b + size_b / 2)
    both = np.prod(np.maximum(high - low, 0.0), axis=-1)
    return both / (np.prod(size_a, axis=-1) + np.prod(size_b, axis=-1) - both)


def ranking_auc(positive: NDArray, negative: NDArray) -> float:
    """Probability that a positive outranks a negative (ties count half); NaN if either is missing."""
    if len(positive) == 0 or len(negative) == 0:
        return float("nan")
    difference = positive[:, None] - negative[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


def _judged(batches: Sequence[TrainingBatch]) -> NDArray[np.bool_]:
    """Mask [N] of windows without other aircraft, whose highest peak can only be the labelled target's."""
    return np.concatenate([~batch.others.any(axis=(1, 2)) for batch in batches])


def tell_of_poses(batches: Sequence[TrainingBatch]) -> bool:
    """Whether any window shows a target whose pose `measure` can evaluate."""
    return bool((_judged(batches) & np.concatenate([batch.present for batch in batches])).any())


def _mean(values: NDArray) -> float:
    """NaN if empty."""
    return float(values.mean()) if len(values) else math.nan


def _median(values: NDArray) -> float:
    """NaN if empty."""
    return float(np.median(values)) if len(values) else math.nan


def measure(
    predicted: Predictions, batches: list[TrainingBatch], threshold: float = SCORE_THRESHOLD
) -> dict[str, float]:
    """Metrics of one set of windows. Pose metrics are over all windows with a target, detected or not.

    Windows with a second aircraft are left out, as the highest peak may be that one's. NaN where no windows remain.
    """
    judged = _judged(batches)
    labels = TrainingBatch(*(np.concatenate(values)[judged] for values in zip(*batches, strict=True)))
    predicted = Predictions(*(np.compress(judged, value, axis=0) for value in predicted))
    on = labels.present
    est = Predictions(*(value[on] for value in predicted))
    R, t = labels.R_cam_target[on], labels.t_cam_target_m[on]
    center, size = labels.center_px[on], labels.size_px[on]
    E_r = metrics.rotation_error_deg(est.R_cam_target, R)
    depth = metrics.depth_error_rel(est.t_cam_target_m, t)
    E_t = metrics.translation_error_m(est.t_cam_target_m, t)
    pose = metrics.pose_10deg_5pct(est.R_cam_target, est.t_cam_target_m, R, t)
    inside = np.all(np.abs(est.center_px - center) <= np.maximum(size / 2, 4.0), axis=-1)
    found = (est.score >= threshold) & inside
    empty = predicted.score[~on]
    return {
        "windows": float(len(on)),
        "E_r_mean_deg": _mean(E_r),
        "E_r_median_deg": _median(E_r),
        "rot_lt_10deg": _mean(E_r < 10.0),
        "E_t_mean_m": _mean(E_t),
        "E_t_median_m": _median(E_t),
        "E_z_mean_m": _mean(metrics.depth_error_m(est.t_cam_target_m, t)),
        "depth_rel_mean": _mean(depth),
        "depth_rel_median": _median(depth),
        "depth_lt_5pct": _mean(depth < 0.05),
        "pose_10deg_5pct": _mean(pose),
        "bearing_median_deg": _median(metrics.bearing_error_deg(est.t_cam_target_m, t)),
        "box_iou_mean": _mean(box_iou(est.center_px, est.size_px, center, size)),
        "recall": _mean(found),
        "false_alarms": _mean(empty >= threshold),
        "score_auc": ranking_auc(est.score, empty),
        "score_median": _median(est.score),
    }


def measure_each(
    predicted: Predictions, batches: list[TrainingBatch], parts: Mapping[str, NDArray[np.bool_]]
) -> dict[str, dict[str, float]]:
    """The metrics of parts of the windows, given as masks [N]; none of an empty part."""
    labels = [np.concatenate(values) for values in zip(*batches, strict=True)]
    found = {}
    for name, own in parts.items():
        if own.any():
            of_part = Predictions(*(np.compress(own, value, axis=0) for value in predicted))
            found[name] = measure(of_part, [TrainingBatch(*(value[own] for value in labels))])
    return found


def null_where_unknown(measured: Mapping[str, float]) -> dict[str, float | None]:
    """The metrics for JSON, which has no NaN: None instead."""
    return {name: value if math.isfinite(value) else None for name, value in measured.items()}


def constant_guess(batches: list[TrainingBatch]) -> dict[str, float]:
    """Baseline errors of the best constant prediction: one rotation and one depth, fitted to these windows."""
    labels = TrainingBatch(*(np.concatenate(values) for values in zip(*batches, strict=True)))
    R, Z = labels.R_cam_target[labels.present].astype(np.float64), labels.t_cam_target_m[labels.present, 2]
    guess = nearest_rotation(R.mean(axis=0))
    return {
        "constant_E_r_mean_deg": float(metrics.rotation_error_deg(np.broadcast_to(guess, R.shape), R).mean()),
        "constant_depth_rel_mean": float(np.mean(np.abs(np.median(Z) / Z - 1.0))),
    }


def choose_threshold(predicted: Predictions, batches: list[TrainingBatch]) -> float:
    """Detection threshold in 0.05..0.95: the median of those with the highest recall minus false alarm rate.

    SCORE_THRESHOLD if all windows or none contain a target.
    """
    judged = _judged(batches)
    present = np.concatenate([batch.present for batch in batches])[judged]
    score = predicted.score[judged]
    if present.all() or not present.any():
        return SCORE_THRESHOLD
    steps = np.arange(5, 96) / 100.0
    recall = (score[present][:, None] >= steps).mean(axis=0)
    alarms = (score[~present][:, None] >= steps).mean(axis=0)
    gain = recall - alarms
    return float(np.median(steps[gain >= gain.max() - 1e-9]))


def sigma_shortfall(a: Predictions, b: Predictions, present: NDArray[np.bool_]) -> float:
    """Relative decrease of sigma from `b` to `a`: median over windows with a target, of the component where it is
    largest; negative if all are larger."""
    ratio = np.median(a.sigma[present] / b.sigma[present], axis=0)
    return float(1.0 - ratio.min())


def difference(a: Predictions, b: Predictions, present: NDArray[np.bool_]) -> dict[str, float]:
    """Differences of two predictors on the same windows: medians and 95th percentiles over those with a target."""
    a, b = (Predictions(*(value[present] for value in one)) for one in (a, b))
    values = {
        "rotation_deg": metrics.rotation_error_deg(a.R_cam_target, b.R_cam_target),
        "depth_rel": np.abs(a.t_cam_target_m[:, 2] / b.t_cam_target_m[:, 2] - 1.0),
        "center_px": np.linalg.norm(a.center_px - b.center_px, axis=-1),
        "sigma_rel": np.abs(a.sigma / b.sigma - 1.0),
        "score": np.abs(a.score - b.score),
    }
    return {
        f"{name}_{label}": float(np.percentile(value, percentile))
        for name, value in values.items()
        for label, percentile in (("median", 50), ("p95", 95))
    }
