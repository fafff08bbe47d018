"""Export: a checkpoint to FP32 and INT8 model files that carry their contract, measured on windows of their own.

`export_models` reads top-down: render, write FP32, measure, quantise, measure again, refuse if INT8 strayed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msgs.contract import ModelContract
from trainer.checkpoint import load_model
from trainer.config import ConfigError, DataConfig, TrainerConfig
from trainer.data import Sampler, TrainingBatch, render_once, window_sampler
from trainer.evaluate import Predictions, choose_threshold, difference, measure, predict_all, torch_predictor
from trainer.graph import onnx_predictor, quantise_graph, write_contract, write_graph

CALIBRATION_SEED = 910_001
COMPARISON_SEED = 920_001
TOLERANCE_DEG = 2.0
ACQUIRE_CROP_PX = 384

OpenView = Callable[[int, int, float], Callable[[], Sampler]]  # (seed, size_px, acquire_share) to a picklable opener


class Views(NamedTuple):
    """Rendered windows as the two stages see them; `track` is empty for a model without that stage."""

    track: list[TrainingBatch]
    acquire: list[TrainingBatch]


class Measured(NamedTuple):
    """One model file's predictions on the comparison windows."""

    track: Predictions | None
    acquire: Predictions


def stage_sampler(data: DataConfig, seed: int, size_px: int, acquire_share: float) -> Callable[[], Sampler]:
    """An opener of windows as one stage sees them: 0 for track, 1 for acquire."""
    return window_sampler(data.model_copy(update={"acquire_share": acquire_share}), seed, size_px)


def render_views(config: TrainerConfig, seed: int, samples: int, open_view: OpenView) -> Views:
    """`samples` windows of the track stage and half as many of the acquire stage."""
    track = config.contract.track_size_wh
    windows = render_once(open_view(seed, track[0], 0.0), samples) if track else []
    crop_px = min(ACQUIRE_CROP_PX, *config.contract.acquire_size_wh)
    return Views(windows, render_once(open_view(seed + 1, crop_px, 1.0), max(samples // 2, 16)))


def _predict(path: Path, views: Views) -> Measured:
    predict = onnx_predictor(path)
    return Measured(predict_all(predict, views.track) if views.track else None, predict_all(predict, views.acquire))


def _metrics(measured: Measured, views: Views, thresholds: tuple[float, float]) -> dict[str, float]:
    """Contract metrics: `track_*` and `acquire_*`, those that could be measured."""
    found = {f"acquire_{k}": v for k, v in measure(measured.acquire, views.acquire, thresholds[0]).items()}
    if measured.track is not None:
        found.update({f"track_{k}": v for k, v in measure(measured.track, views.track, thresholds[1]).items()})
    return {name: round(value, 5) for name, value in found.items() if math.isfinite(value)}


def _span(values: np.ndarray) -> tuple[float, float]:
    return round(float(values.min()), 1), round(float(values.max()), 1)


def make_contract(
    config: TrainerConfig,
    training: dict[str, str | int | float],
    sha256: str,
    views: Views,
    thresholds: tuple[float, float],
) -> ModelContract:
    """The contract of the FP32 file, without metrics; what the windows show (focal length, box) is read from them."""
    batches = [*views.track, *views.acquire]
    on = np.concatenate([batch.present for batch in batches])
    focal_px = np.concatenate([batch.K[:, 0, 0] for batch in batches])
    box_px = np.concatenate([batch.size_px.max(axis=1) for batch in batches])[on]
    contract = config.contract
    return ModelContract(
        name=contract.name,
        configuration=config.model.configuration,
        backbone=config.model.backbone,
        precision="fp32",
        max_peaks=config.model.max_peaks,
        acquire_size_wh=contract.acquire_size_wh,
        acquire_fit=contract.acquire_fit,
        track_size_wh=contract.track_size_wh,
        track_window_scale=contract.track_window_scale,
        acquire_score_min=thresholds[0],
        track_score_min=thresholds[1],
        trained_range_m=contract.trained_range_m,
        trained_focal_px=_span(focal_px),
        trained_box_px=_span(box_px),
        airframes=airframe_names(config.data.airframe_ids),
        training=training,
        metrics={},
        weights_sha256=sha256,
    )


def airframe_names(ids: list[int] | None) -> list[str]:
    """Names of the training airframes; None: all."""
    from sim_replay.airframes import AIRFRAMES

    return [AIRFRAMES[i].name for i in (range(len(AIRFRAMES)) if ids is None else ids)]


def comparison_table(views: Views, pairs: dict[str, tuple[Measured, Measured]]) -> tuple[str, float]:
    """Differences of each named pair as text, and the largest median rotation difference, degrees."""
    lines = [f"{'pair':24} {'stage':8} {'rotation deg':>16} {'depth %':>16} {'centre px':>16} {'score':>16}"]
    worst = 0.0
    for name, (a, b) in pairs.items():
        stages = [("track", a.track, b.track, views.track), ("acquire", a.acquire, b.acquire, views.acquire)]
        for stage, one, other, batches in stages:
            if one is None or other is None:
                continue
            d = difference(one, other, np.concatenate([batch.present for batch in batches]))
            worst = max(worst, d["rotation_deg_median"])
            cells = [("rotation_deg", 1), ("depth_rel", 100), ("center_px", 1), ("score", 1)]
            text = "".join(f" {s * d[f'{k}_median']:7.3f} /{s * d[f'{k}_p95']:7.3f}" for k, s in cells)
            lines.append(f"{name:24} {stage:8}{text}")
    return "\n".join(lines) + "\n(median / 95th percentile over windows with a target)", worst


def export_models(
    checkpoint: Path,
    out: Path,
    *,
    float_out: Path | None = None,
    tolerance_deg: float = TOLERANCE_DEG,
    samples: int = 300,
    open_view: OpenView | None = None,
    say: Callable[[str], None] = print,
) -> tuple[Path, Path]:
    """Write NAME-fp32.onnx into `float_out` (default `out`) and NAME-int8.onnx into `out`; returns their paths.

    Raises ConfigError, and leaves no INT8 file, when its median rotation differs from FP32's by more than the tolerance.
    """
    model, config, training, sha256 = load_model(checkpoint)
    view = open_view or (lambda seed, size, share: stage_sampler(config.data, seed, size, share))
    float_path = (float_out or out) / f"{config.contract.name}-fp32.onnx"
    int8_path = out / f"{config.contract.name}-int8.onnx"
    for path in (float_path, int8_path):
        path.parent.mkdir(parents=True, exist_ok=True)

    say("rendering calibration and comparison windows")
    calibration = render_views(config, CALIBRATION_SEED, samples, view)
    comparison = render_views(config, COMPARISON_SEED, samples, view)

    write_graph(model, float_path)
    floats = _predict(float_path, comparison)
    acquire_min = choose_threshold(floats.acquire, comparison.acquire)
    track_min = choose_threshold(floats.track, comparison.track) if floats.track else acquire_min
    thresholds = (acquire_min, track_min)
    contract = make_contract(config, training, sha256, comparison, thresholds)
    float_metrics = _metrics(floats, comparison, thresholds)
    write_contract(float_path, contract.model_copy(update={"metrics": float_metrics}))

    say("quantising")
    partial = int8_path.with_suffix(".part")
    try:
        quantise_graph(float_path, partial, [*calibration.track, *calibration.acquire])
        int8 = _predict(partial, comparison)
        reference = torch_predictor(model)
        by_torch = Measured(
            predict_all(reference, comparison.track) if comparison.track else None,
            predict_all(reference, comparison.acquire),
        )
        say(comparison_table(comparison, {"FP32 against PyTorch": (floats, by_torch)})[0])
        table, strayed_deg = comparison_table(comparison, {"INT8 against FP32": (int8, floats)})
        say(table)
        if not strayed_deg <= tolerance_deg:
            raise ConfigError(
                f"{int8_path}: not written: median rotation differs from FP32's by {strayed_deg:.2f} degrees, "
                f"more than --tolerance {tolerance_deg:g}"
            )
        int8_metrics = _metrics(int8, comparison, thresholds)
        write_contract(partial, contract.model_copy(update={"precision": "int8", "metrics": int8_metrics}))
        partial.replace(int8_path)
    finally:
        partial.unlink(missing_ok=True)
    say(f"wrote {float_path} and {int8_path}")
    return float_path, int8_path
