"""Scores a model on BOP scenes frame by frame: the daemon's own estimator, with no tracker, sockets or clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge.errors import InputError
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model, load_model
from edge.types import Frame, FrameMeta
from sim_replay.ground_truth import SceneTruth, read_scene_truth
from sim_replay.score import (
    Match,
    TargetPose,
    latency_statistics,
    match_poses,
    pose_statistics,
    statistics_by_range,
)

DEFAULT_THREADS = 2


@dataclass(frozen=True, eq=False)
class FrameResult:
    """One picture, judged by itself."""

    scene: str
    image: Path
    matches: tuple[Match, ...]
    false_poses: int  # poses that belong to no target
    estimate_ms: float  # acquire and track together


def scene_folders(dataset: Path) -> list[Path]:
    """The folder itself if it is a BOP scene, else every scene below it, sorted. Raises InputError if there is none."""
    folders = sorted(path.parent for path in dataset.rglob("scene_camera.json"))
    if not folders:
        raise InputError(f"{dataset}: no BOP scene (scene_camera.json) in it or below")
    return folders


def score_dataset(
    scene_dirs: Sequence[Path],
    model_path: Path,
    threads: int = DEFAULT_THREADS,
    on_frame: Callable[[FrameResult], None] = lambda _: None,
) -> list[FrameResult]:
    """Run acquire and track on every frame of the scenes; `on_frame` sees each as it comes. Raises InputError."""
    return score_scenes([read_scene_truth(folder) for folder in scene_dirs], load_model(model_path, threads), on_frame)


def score_scenes(
    scenes: Sequence[SceneTruth], model: Model, on_frame: Callable[[FrameResult], None] = lambda _: None
) -> list[FrameResult]:
    """`score_dataset` with scenes and model already read."""
    estimator = Estimator(model)
    model.warm_up()
    results = []
    for scene in scenes:
        for index in range(len(scene.images)):
            results.append(_judge_frame(estimator, scene, index))
            on_frame(results[-1])
    return results


def _judge_frame(estimator: Estimator, scene: SceneTruth, index: int) -> FrameResult:
    image_bgr = cv2.imread(str(scene.images[index]), cv2.IMREAD_COLOR)
    if image_bgr is None:
        raise InputError(f"{scene.images[index]} is not a readable picture")
    started_ns = time.monotonic_ns()
    meta = FrameMeta(index, started_ns, started_ns)
    found = estimator.acquire(Frame(meta, np.asarray(image_bgr, dtype=np.uint8), scene.K[index]))
    estimate_ms = (time.monotonic_ns() - started_ns) * 1e-6
    poses = [TargetPose(index, estimate.R_cam_target, estimate.t_cam_target_m) for estimate in found]
    truths = [truth for truth in scene.truths if truth.frame == index]
    matches, false_poses = match_poses(truths, poses)
    return FrameResult(scene.name, scene.images[index], tuple(matches), false_poses, estimate_ms)


def dataset_score(name: str, results: Sequence[FrameResult], model: Model) -> dict[str, Any]:
    """The figures of many frames: shares 0..1, degrees, metres, milliseconds; null where there is nothing to tell."""
    matches = [match for result in results for match in result.matches]
    return {
        "sequence": name,
        "frames": len(results),
        "targets": len(matches),
        "poses": sum(match.estimate is not None for match in matches) + sum(r.false_poses for r in results),
        "false_poses": sum(result.false_poses for result in results),
        **pose_statistics(matches),
        "estimate_ms": latency_statistics([result.estimate_ms for result in results]),
        "by_range": statistics_by_range(matches),
        "model": {"file": model.path.name, "sha256": model.sha256, "precision": model.contract.precision},
    }
