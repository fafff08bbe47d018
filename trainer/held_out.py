"""Evaluate a checkpoint or a model file on rendered windows of a seed that training did not use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from msgs.contract import ScoreCalibration
from trainer.checkpoint import load_model
from trainer.config import ConfigError, DataConfig
from trainer.data import render_once
from trainer.evaluate import (
    SCORE_THRESHOLD,
    Predictor,
    calibrated,
    constant_guess,
    measure,
    predict_all,
    torch_predictor,
)
from trainer.export import OpenView, acquire_window_px, airframe_names, stage_sampler
from trainer.graph import onnx_predictor, read_contract
from trainer.heads import heads_told


class Request(NamedTuple):
    """The model to evaluate, and on which windows."""

    model: Path  # ONNX file, or a checkpoint: run folder or weights.pt
    samples: int
    seed: int
    stage: Literal["track", "acquire"]
    size_px: int | None = None


class _Subject(NamedTuple):
    """A network with the metadata of its file."""

    predict: Predictor
    data: DataConfig
    training_seeds: tuple[object, ...]
    track_px: int | None
    acquire_px: int
    thresholds: dict[str, float]
    calibrations: dict[str, ScoreCalibration]


def _seeds(training: Mapping[str, object]) -> tuple[object, ...]:
    """Seeds of the last training run's windows and of those of the heads that were trained after it."""
    seeds = ["seed", *(f"{prefix}_seed" for prefix in heads_told(training))]
    return tuple(training[key] for key in seeds if key in training)


def _checkpoint(path: Path) -> _Subject:
    model, config, training, _ = load_model(path)
    track = config.contract.track_size_wh
    track_px = track[0] if track else None
    thresholds = {"track": SCORE_THRESHOLD, "acquire": SCORE_THRESHOLD}
    acquire_px = acquire_window_px(config.contract)
    rendered = config.data.model_copy(update={"datasets": []})
    return _Subject(torch_predictor(model), rendered, _seeds(training), track_px, acquire_px, thresholds, {})


def _model_file(path: Path, seed: int) -> _Subject:
    contract = read_contract(path)
    view = "frame" if contract.acquire_fit == "squash" else "crop"
    every = airframe_names(None)
    ids = [every.index(name) for name in contract.airframes if name in every] or None
    said = {"seed": seed, "validation_seed": seed + 1, "batch_size": 16, "airframe_ids": ids, "acquire_view": view}
    data = DataConfig.model_validate(said)
    thresholds = {"track": contract.track_score_min, "acquire": contract.acquire_score_min}
    track = contract.track_size_wh[0] if contract.track_size_wh else None
    calibrations = {"track": contract.track_score, "acquire": contract.acquire_score}
    acquire_px = acquire_window_px(contract)
    return _Subject(onnx_predictor(path), data, _seeds(contract.training), track, acquire_px, thresholds, calibrations)


def evaluate_file(
    request: Request, *, open_view: OpenView | None = None, rendered: Callable[[int], None] | None = None
) -> dict[str, float]:
    """Metrics of trainer.evaluate.measure at the file's own threshold. Raises ConfigError for an invalid request."""
    is_onnx = request.model.suffix == ".onnx"
    subject = _model_file(request.model, request.seed) if is_onnx else _checkpoint(request.model)
    if request.seed in subject.training_seeds:
        raise ConfigError(f"--seed {request.seed}: was used in training; give another")
    size_px = request.size_px or (subject.track_px if request.stage == "track" else None)
    size_px = size_px or subject.acquire_px
    if size_px < 32 or size_px % 32:
        raise ConfigError(f"--size {size_px}: must be a multiple of 32")
    if request.samples < 16:
        raise ConfigError(f"--windows {request.samples}: must be at least 16")
    view = open_view or (lambda seed, size, share: stage_sampler(subject.data, seed, size, share))
    opener = view(request.seed, size_px, 0.0 if request.stage == "track" else 1.0)
    batches = render_once(opener, request.samples, rendered=rendered)
    predicted = predict_all(subject.predict, batches)
    if request.stage in subject.calibrations:
        predicted = calibrated(predicted, subject.calibrations[request.stage])
    measured = measure(predicted, batches, subject.thresholds[request.stage])
    settings = {"size_px": float(size_px), "score_min": subject.thresholds[request.stage]}
    return {**settings, **measured, **constant_guess(batches)}
