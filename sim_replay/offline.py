"""Scores a model on a BOP dataset frame by frame: the daemon's own estimator, with no tracker, sockets or clock."""

from __future__ import annotations

import time
from typing import Any

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model, load_model
from edge.types import Frame, FrameMeta
from sim_replay.datasets import DatasetFrame
from sim_replay.evaluation.judge import Answer, Answerer
from sim_replay.score import TargetPose

__all__ = ["DEFAULT_THREADS", "SHIPPED_MODEL", "InputError", "Model", "estimator_answers", "load_model", "method_of"]

DEFAULT_THREADS = 2


def estimator_answers(model: Model) -> Answerer:
    """Acquire and track on each picture alone, as the daemon does on a frame that it knows no target of.

    Raises InputError if the model does not run.
    """
    estimator = Estimator(model)
    model.warm_up()

    def answer(index: int, picture: DatasetFrame) -> Answer:
        image_bgr = picture.undistorted_bgr()
        started_ns = time.monotonic_ns()
        found = estimator.acquire(Frame(FrameMeta(index, started_ns, started_ns), image_bgr, picture.K))
        time_ms = (time.monotonic_ns() - started_ns) * 1e-6
        poses = (
            TargetPose(index, e.R_cam_target, e.t_cam_target_m, score=e.score, covariance=e.covariance) for e in found
        )
        return Answer(tuple(poses), time_ms)

    return answer


def method_of(model: Model) -> dict[str, Any]:
    """How a score names the model that was judged."""
    return {"file": model.path.name, "sha256": model.sha256, "precision": model.contract.precision}
