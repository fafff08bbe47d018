"""Output files of an evaluation: metrics.json, frames.jsonl and, for a model, a BOP results file."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_replay import metrics
from sim_replay.datasets import Dataset
from sim_replay.evaluation.bop_results import results_name, write_results
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.score import Match, TargetPose


def write_files(
    out: Path, method: str, dataset: Dataset, score: dict[str, Any], judged: Sequence[JudgedFrame]
) -> list[Path]:
    """Write the score and every frame's result into `out`; returns the files. `method` names the results file.

    Poses that were read from a results file are not written as one: it may be in `out` under the same name.
    """
    out.mkdir(parents=True, exist_ok=True)
    metrics_json, frames_jsonl = out / "metrics.json", out / "frames.jsonl"
    metrics_json.write_text(json.dumps(score, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    with frames_jsonl.open("w", encoding="utf-8") as file:
        for frame in judged:
            file.write(json.dumps(frame_record(frame, dataset.root), allow_nan=False) + "\n")
    if score["method"]["precision"] is None:
        return [metrics_json, frames_jsonl]
    results_csv = out / results_name(method, dataset)
    write_results(results_csv, judged)
    return [metrics_json, frames_jsonl, results_csv]


def frame_record(frame: JudgedFrame, root: Path) -> dict[str, Any]:
    """One line of frames.jsonl: the image, each true target with its match, and the poses that belong to no target."""
    path, root = (Path(os.path.abspath(one)) for one in (frame.picture.image_path, root))
    return {
        "scene_id": frame.picture.scene_id,
        "im_id": frame.picture.image_id,
        "image": str(path.relative_to(root) if path.is_relative_to(root) else path),
        "time_ms": None if frame.time_ms is None else round(frame.time_ms, 3),
        "targets": [target_record(match) for match in frame.matches],
        "false_poses": [pose_record(pose) for pose in frame.false_poses],
    }


def target_record(match: Match) -> dict[str, Any]:
    """A true target, the pose matched to it, and its errors: metres, degrees."""
    truth, estimate = match.truth, match.estimate
    record: dict[str, Any] = {
        "obj_id": truth.object_id,
        "airframe": truth.airframe_label,
        "range_m": round(float(np.linalg.norm(truth.t_cam_target_m)), 3),
        "truth": pose_record(truth),
        "estimate": None,
    }
    if estimate is not None:
        R_est, t_est = estimate.R_cam_target, estimate.t_cam_target_m
        R_gt, t_gt = truth.R_cam_target, truth.t_cam_target_m
        record["estimate"] = pose_record(estimate)
        turn_deg = match.rotation_error_deg
        record["rotation_error_deg"] = None if turn_deg is None else round(turn_deg, 4)
        record["translation_error_m"] = round(float(metrics.translation_error_m(t_est, t_gt)), 4)
        record["depth_error_m"] = round(float(metrics.depth_error_m(t_est, t_gt)), 4)
        record["bearing_error_deg"] = round(float(metrics.bearing_error_deg(t_est, t_gt)), 5)
        record["add_m"] = None if match.add_m is None else round(match.add_m, 4)
        right = bool(metrics.pose_10deg_5pct(R_est, t_est, R_gt, t_gt))
        record["pose_10deg_5pct"] = right and estimate.rotation_known
    return record


def pose_record(pose: TargetPose) -> dict[str, Any]:
    """A pose in `cam`, rounded, with score and sigma where they are known; null for an unknown rotation."""
    record: dict[str, Any] = {
        "R_cam_target": _rounded(pose.R_cam_target, 6) if pose.rotation_known else None,
        "t_cam_target_m": _rounded(pose.t_cam_target_m, 4),
    }
    if pose.score is not None:
        record["score"] = round(pose.score, 4)
    if pose.covariance is not None:
        sigma = _rounded(np.sqrt(np.diagonal(pose.covariance)), 6)  # x, y, z m, rotation x, y, z rad
        record["sigma"] = sigma if pose.rotation_known else [*sigma[:3], None, None, None]
    return record


def _rounded(values: NDArray[np.float64], digits: int) -> list[Any]:
    return np.round(values, digits).tolist()
