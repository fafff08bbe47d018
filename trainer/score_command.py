"""`uavpose-trainer calibrate-score`: calibrate a model file's scores as probabilities, on whole frames."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msgs.contract import ModelContract
from trainer.config import ConfigError
from trainer.heads import heads_told

if TYPE_CHECKING:
    from sim_replay.datasets import Dataset

_log = logging.getLogger(__name__)
# A false target costs more than a target found a few frames later, so the threshold for a new one is high; a target
# being tracked is given up only at a low probability.
ACQUIRE_PROBABILITY_MIN, TRACK_PROBABILITY_MIN = 0.7, 0.3
THRESHOLD_METRICS = ("recall", "false_alarms")  # measured at the old thresholds, hence dropped


def register(commands: argparse._SubParsersAction) -> None:
    """Add the sub-command."""
    command = commands.add_parser(
        "calibrate-score",
        help="calibrate the score of a model file as a probability",
        description="Run the model on the images of the datasets, fit for each stage the probability that a peak "
        "is a target (logistic in the network's score and the apparent size), and write it into the file with the "
        f"thresholds {ACQUIRE_PROBABILITY_MIN:g} (acquire) and {TRACK_PROBABILITY_MIN:g} (track). Use images that are "
        "in neither the training nor the test set, some of them without a target.",
    )
    command.add_argument(
        "--model", type=Path, required=True, metavar="ONNX", help="the file to calibrate, modified in place"
    )
    command.add_argument("--dataset", type=Path, required=True, nargs="+", metavar="DIR", help="BOP datasets")
    command.add_argument("--split", metavar="NAME", help="split of each dataset (default: all)")
    command.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Calibrate as requested and print the result. Raises ConfigError."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("evaluating", total=None)
        contract = calibrate_file(
            arguments.model,
            arguments.dataset,
            arguments.split,
            on_start=lambda total: progress.update(task, total=total),
            on_frame=lambda: progress.advance(task),
        )
    for stage, fitted in (("acquire", contract.acquire_score), ("track", contract.track_score)):
        error = contract.metrics.get(f"{stage}_calibration_error")
        print(f"{stage:8} {fitted}  calibration error {error}")


def calibrate_file(
    path: Path,
    folders: Sequence[Path],
    split: str | None = None,
    *,
    on_start: Callable[[int], None] = lambda _: None,
    on_frame: Callable[[], None] = lambda: None,
) -> ModelContract:
    """Fit both stages' scores and write them into the file; returns the contract. Raises ConfigError."""
    from sim_replay.datasets import open_dataset
    from sim_replay.evaluation.candidates import candidates
    from sim_replay.offline import DEFAULT_THREADS, InputError, load_model
    from trainer.graph import read_contract, write_contract
    from trainer.score_calibration import (
        LEAST_OF_EACH,
        ScoresTellNothing,
        TooFewCandidates,
        expected_calibration_error,
        fit,
    )

    contract = read_contract(path)
    if not os.access(path.parent, os.W_OK):
        raise ConfigError(f"{path}: its folder is not writable")
    try:
        datasets = [open_dataset(folder, split) for folder in folders]
        for dataset in datasets:
            warn_of_training_images(dataset, contract)
        of_each = [dataset.boxed_frames() for dataset in datasets]
        pictures = [picture for frames in of_each for picture in frames]
        visible = sum(target.box_visible_xyxy_px is not None for picture in pictures for target in picture.targets)
        if visible < LEAST_OF_EACH:
            raise ConfigError(
                f"--dataset: {visible} visible targets in {len(pictures)} images: at least {LEAST_OF_EACH} are needed, "
                "and as many peaks elsewhere"
            )
        on_start(len(pictures))
        seen = list(candidates(load_model(path, DEFAULT_THREADS), pictures, on_frame))
    except InputError as error:
        raise ConfigError(str(error)) from error
    stages = ("acquire",) if contract.track_size_wh is None else ("acquire", "track")
    metrics = {
        name: value
        for name, value in contract.metrics.items()
        if name.removeprefix("acquire_").removeprefix("track_") not in THRESHOLD_METRICS
    }
    changes: dict[str, object] = {}
    for stage in stages:
        of_stage = [candidate for candidate in seen if candidate.stage == stage]
        try:
            changes[f"{stage}_score"] = fitted = fit(of_stage)
        except TooFewCandidates as error:
            raise ConfigError(f"--dataset: {stage}: {error}") from error
        except ScoresTellNothing as error:
            raise ConfigError(f"{path}: {stage}: {error}") from error
        metrics[f"{stage}_calibration_error"] = round(expected_calibration_error(fitted, of_stage), 4)
    changes |= {"acquire_score_min": ACQUIRE_PROBABILITY_MIN, "track_score_min": TRACK_PROBABILITY_MIN}
    training = contract.training | {
        "score_frames": len(pictures),
        "score_datasets": ", ".join(
            f"{dataset.name}/{dataset.split or 'all'} ({len(frames)})"
            for dataset, frames in zip(datasets, of_each, strict=True)
        ),
    }
    contract = contract.model_copy(update=changes | {"metrics": metrics, "training": training})
    write_contract(path, contract)
    return contract


def warn_of_training_images(dataset: Dataset, contract: ModelContract) -> None:
    """By name, as a model file knows no folders: a network is too sure of images that it was trained on."""
    splits = sorted({scene.split for scene in dataset.scenes if scene.split is not None})
    heads = (str(contract.training.get(f"{prefix}_datasets", "")) for prefix in heads_told(contract.training))
    refined_on = {source for told in heads for source in told.split("; ")}
    for split in splits:
        # Training on `train` takes in `train_pbr`, and may have been given the split's folder for the dataset's.
        asked = (split, split.partition("_")[0])
        names = tuple(f"{folder}, split {name}: " for folder in (dataset.name, split) for name in asked)
        taught_heads = f"{dataset.name}, split {split}" in refined_on
        if taught_heads or any(source.startswith(names) for source in contract.data.split("; ")):
            told = "%s: the model was trained on split %s of a dataset of this name; if it is this one, calibrated "
            _log.warning(told + "scores promise too much: give another --split, such as val", dataset.root, split)
