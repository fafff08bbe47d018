"""Scores a model on a BOP dataset frame by frame: the daemon's own estimator, without tracker, sockets or clock."""

from __future__ import annotations

import time
from typing import Any

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model, load_model
from edge.types import Frame, FrameMeta
from msgs.contract import samples_behind
from sim_replay.datasets import DatasetFrame
from sim_replay.evaluation.given_sizes import SizeOf, no_size
from sim_replay.evaluation.judge import Answer, Answerer
from sim_replay.score import TargetPose

__all__ = [
    "DEFAULT_THREADS",
    "SHIPPED_MODEL",
    "InputError",
    "Model",
    "estimator_answers",
    "load_model",
    "method_of",
    "with_score_min",
]

DEFAULT_THREADS = 2


def estimator_answers(model: Model, size_of: SizeOf = no_size) -> Answerer:
    """Acquire and track stage on each image alone, as in the daemon on a frame without known targets, of a camera so
    slow that there is time to search every region.

    `size_of`: what [target] says in each scene. Raises InputError if the model does not run.
    """
    estimator = Estimator(model)
    model.warm_up()

    def answer(index: int, picture: DatasetFrame) -> Answer:
        image_bgr = picture.undistorted_bgr()
        estimator.target_size = size_of(picture.scene)
        started_ns = time.monotonic_ns()
        frame = Frame(FrameMeta(index, started_ns, started_ns), image_bgr, picture.K)
        found = estimator.acquire(frame, regions=estimator.regions(frame))
        time_ms = (time.monotonic_ns() - started_ns) * 1e-6
        poses = (
            TargetPose(index, e.R_cam_target, e.t_cam_target_m, score=e.score, covariance=e.covariance) for e in found
        )
        return Answer(tuple(poses), time_ms)

    return answer


def with_score_min(model: Model, score_min: float | None) -> Model:
    """The model with another minimum score (target probability) in both stages; None: unchanged.

    The acquire stage applies it to the whole frame and its windows together. Raises InputError outside 0..1.
    """
    if score_min is None:
        return model
    if not 0.0 <= score_min <= 1.0:
        raise InputError(f"the score threshold {score_min} is not between 0 and 1")
    model.contract = model.contract.model_copy(update={"acquire_score_min": score_min, "track_score_min": score_min})
    return model


def method_of(model: Model) -> dict[str, Any]:
    """Description of the evaluated model in a score."""
    contract = model.contract
    return {
        "name": contract.name,
        "file": model.path.name,
        "sha256": model.sha256,
        "precision": contract.precision,
        "acquire_score_min": contract.acquire_score_min,
        "track_score_min": contract.track_score_min,
        "training_samples": samples_behind(contract.training),
    }
