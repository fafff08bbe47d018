"""Evaluate a checkpoint, a model file or another method's results file on the images of a BOP dataset.

Models run in the daemon's own estimator, so the scores are those of the deployed code; a checkpoint is exported to FP32
first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from sim_replay.bop import Model as TargetModel
from sim_replay.datasets import Dataset, open_dataset
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.evaluation.bop_results import file_answers
from sim_replay.evaluation.consistency import consistency
from sim_replay.evaluation.directions import directions
from sim_replay.evaluation.files import write_files
from sim_replay.evaluation.filtering import filtering
from sim_replay.evaluation.given_sizes import no_size, sizes_of
from sim_replay.evaluation.judge import Answerer, JudgedFrame, judge_frames, score_of
from sim_replay.evaluation.spread import intervals_95
from sim_replay.evaluation.tracked import OwnShipTold, tracker_answers
from sim_replay.offline import (
    DEFAULT_THREADS,
    SHIPPED_MODEL,
    InputError,
    estimator_answers,
    load_model,
    method_of,
    with_score_min,
)
from trainer.config import ConfigError


class DatasetRequest(NamedTuple):
    """What to evaluate, and on which images."""

    model: Path | None = None  # ONNX file or checkpoint; None: the shipped INT8 file, unless there are results
    results: Path | None = None  # BOP results file of any method
    dataset: Path | None = None  # None: the bundled scene
    split: str | None = None
    every: int = 1  # score every n-th image
    mode: Literal["frames", "track"] = "frames"  # each image alone, or sequences through the tracker
    own_ship: OwnShipTold = "usual"  # in mode track: accuracy of the own-ship pose given to the tracker
    score_min: float | None = None  # detection threshold; None: the model file's own
    size_given: bool = False  # give the estimator each scene's wingspan and length, as [target] does


class Evaluation(NamedTuple):
    """The result: `score` has the keys of sim_replay.score.statistics and describes what was evaluated."""

    score: dict[str, Any]
    method: str  # name for the results file of a model
    dataset: Dataset
    judged: list[JudgedFrame]
    models: Mapping[int, TargetModel]

    def write(self, out: Path) -> list[Path]:
        """metrics.json, frames.jsonl, the BOP results file and the figures into `out`. Raises ConfigError."""
        from sim_replay.evaluation.figures import write_figures  # matplotlib is slow to import

        try:
            files = write_files(out, self.method, self.dataset, self.score, self.judged)
            return [*files, *write_figures(out, self.score, self.judged, self.models)]
        except OSError as error:
            raise ConfigError(f"{out}: cannot be written: {error.strerror or error}") from error
        except InputError as error:
            raise ConfigError(str(error)) from error


def evaluate_dataset(
    request: DatasetRequest,
    *,
    on_start: Callable[[int], None] = lambda _: None,
    on_frame: Callable[[JudgedFrame], None] = lambda _: None,
) -> Evaluation:
    """Evaluate the requested images; `on_start` receives their number. Raises ConfigError, naming file and key."""
    if request.every < 1:
        raise ConfigError(f"--every {request.every}: must be at least 1")
    try:
        dataset = open_dataset(request.dataset or BUNDLED_SEQUENCE, request.split)
        pictures = dataset.labelled_frames()
        if request.mode == "frames":  # the tracker needs all of them
            pictures = pictures[:: request.every]
        if not pictures:
            raise ConfigError(f"{request.dataset}: contains no image to evaluate")
        method, answer = _subject(request, dataset)
        on_start(len(pictures))
        judged = judge_frames(pictures, dataset.models, answer, on_frame)
        if request.mode == "track":
            judged = judged[:: request.every]
    except InputError as error:
        raise ConfigError(str(error)) from error
    score = {
        "mode": request.mode,
        "own_ship": request.own_ship if request.mode == "track" else None,
        "every": request.every,
        "size_given": request.size_given,
        **score_of(dataset, method, judged),
        "intervals_95": intervals_95(judged),
        "consistency": consistency(judged),
        "filtering": filtering(judged),
        "directions": directions(judged),
    }
    return Evaluation(score, Path(method["file"]).stem, dataset, judged, dataset.models)


def _subject(request: DatasetRequest, dataset: Dataset) -> tuple[dict[str, Any], Answerer]:
    """Description of the method for the score, and the function that returns its poses."""
    if request.results is not None:
        if request.mode == "track":
            raise ConfigError("--mode track: needs a model; a results file already contains poses")
        if request.score_min is not None:
            raise ConfigError("--score-min: needs a model; a results file already contains poses")
        if request.size_given:
            raise ConfigError("--size-given: needs a model; a results file already contains poses")
        return {"file": request.results.name, "precision": None}, file_answers(request.results, dataset)
    tracker = partial(tracker_answers, own_ship=request.own_ship)
    answers = tracker if request.mode == "track" else estimator_answers
    size_of = sizes_of(dataset.models) if request.size_given else no_size
    path = request.model or SHIPPED_MODEL
    if path.suffix == ".onnx":
        model = with_score_min(load_model(path, DEFAULT_THREADS), request.score_min)
        return method_of(model), answers(model, size_of)
    from trainer.evaluate import SCORE_THRESHOLD  # torch is slow to import
    from trainer.export import export_unmeasured

    with tempfile.TemporaryDirectory() as folder:
        exported = export_unmeasured(path, Path(folder), score_min=SCORE_THRESHOLD)
        model = with_score_min(load_model(exported, DEFAULT_THREADS), request.score_min)
    return method_of(model) | {"file": path.name}, answers(model, size_of)
