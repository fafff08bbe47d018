"""Export: a checkpoint to FP32 and INT8 model files with embedded contract, evaluated on held-out windows.

`export_models` reads top-down: render, write FP32, evaluate, quantise, evaluate again, refuse if INT8 deviates.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from msgs.contract import CONTRACT_VERSION, ModelContract
from msgs.settings import faults_of
from trainer.checkpoint import load_model, weights_sha256
from trainer.comparison import Measured, Tolerance, Views, comparison_table, too_blind
from trainer.config import Z_RANGE_M, ConfigError, ContractConfig, DataConfig, TrainerConfig, load_config, made_folder
from trainer.data import Sampler, TrainingBatch, render_once
from trainer.dataset_windows import DatasetSampler
from trainer.evaluate import Predictions, Predictor, choose_threshold, measure, predict_all, torch_predictor
from trainer.graph import onnx_predictor, quantise_graph, write_contract, write_graph
from trainer.model import IMAGENET_MEAN_BGR, IMAGENET_STD_BGR, PoseNet
from trainer.sources import warn_of_unseen_reduction, window_sampler
from trainer.tally import Tally, windows_in
from trainer.unfinished import unfinished

CALIBRATION_SEED = 910_001
COMPARISON_SEED = 920_001
ACQUIRE_CROP_PX = 384
RENDERED_RANGE_M = (100.0, 500.0)  # well covered by rendered windows
ANY_SIZE_PX = (1e-3, 1e6)  # for an unmeasured file: no size counts as untrained
UNREACHABLE_SCORE = 1.0
EMPTY_SHARE = 0.12
RENDERED_AT_ONCE = 16

OpenView = Callable[[int, int, float], Callable[[], Sampler]]  # (seed, size_px, acquire_share) to a picklable opener


def stage_sampler(
    data: DataConfig, seed: int, size_px: int, acquire_share: float, held_out: bool = True
) -> Callable[[], Sampler]:
    """An opener of windows of the kind one stage processes; `acquire_share` is 0 for track, 1 for acquire.

    Some contain no target, even if training had none: scores cannot be evaluated without them. The share in `held_out`
    windows is independent of training, so that metrics are comparable. None is flown: weights are exported and
    evaluated without the flights that they were trained on.
    """
    empty_share = EMPTY_SHARE if held_out else max(data.empty_share, EMPTY_SHARE)
    shares = {"acquire_share": acquire_share, "empty_share": empty_share, "flown": [], "flown_share": 0.0}
    return window_sampler(data.model_copy(update=shares), seed, size_px, held_out)


def acquire_window_px(contract: ContractConfig | ModelContract) -> int:
    """Side of the windows on which the acquire stage is evaluated; whole frames if it was trained on those."""
    smaller_px = min(contract.acquire_size_wh)
    return smaller_px if contract.acquire_fit == "squash" else min(ACQUIRE_CROP_PX, smaller_px)


def _windows_of(contract: ContractConfig, samples: int) -> tuple[int, int]:
    """Number of windows of the track stage, `samples`, and of the acquire stage, half as many; as rendered at once."""
    asked = samples if contract.track_size_wh else 0, max(samples // 2, 16)
    track, acquire = (math.ceil(count / RENDERED_AT_ONCE) * RENDERED_AT_ONCE for count in asked)
    return track, acquire


def render_views(config: TrainerConfig, seed: int, samples: int, open_view: OpenView, tally: Tally) -> Views:
    """`samples` windows of the track stage and half as many of the acquire stage."""
    track, acquire = _windows_of(config.contract, samples)
    size_wh, acquire_px = config.contract.track_size_wh, acquire_window_px(config.contract)

    def rendered(opener: Callable[[], Sampler], count: int) -> list[TrainingBatch]:
        return render_once(opener, count, RENDERED_AT_ONCE, lambda _: tally.add(RENDERED_AT_ONCE))

    windows = rendered(open_view(seed, size_wh[0], 0.0), track) if size_wh else []
    return Views(windows, rendered(open_view(seed + 1, acquire_px, 1.0), acquire))


def _refuse_without_targets(comparison: Views) -> None:
    """Raises ConfigError if a stage has windows, but none with a target."""
    for stage, batches in zip(Views._fields, comparison, strict=True):
        if batches and not any(batch.present.any() for batch in batches):
            raise ConfigError(
                f"INT8 cannot be compared with FP32: none of the held-out windows of the {stage} stage shows a target; "
                "raise --samples, or give a validation_split with a larger share of images with targets"
            )


def _predict(predict: Predictor, views: Views, what: str, say: Callable[[str], None]) -> Measured:
    tally = Tally(f"evaluating {what}", windows_in([*views.track, *views.acquire]), say)

    def counted(image_bgr: NDArray[np.uint8], K: NDArray[np.float32]) -> Predictions:
        predicted = predict(image_bgr, K)
        tally.add(len(image_bgr))
        return predicted

    return Measured(predict_all(counted, views.track) if views.track else None, predict_all(counted, views.acquire))


def _metrics(measured: Measured, views: Views, thresholds: tuple[float, float]) -> dict[str, float]:
    """Contract metrics `track_*` and `acquire_*`, without those that could not be measured."""
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
    """The contract of the FP32 file, without metrics; the trained ranges of focal length and box are measured on
    `views`, windows like those in training. Raises ConfigError if they show no target."""
    batches = [*views.track, *views.acquire]
    on = np.concatenate([batch.present for batch in batches])
    focal_px = np.concatenate([batch.K[:, 0, 0] for batch in batches])
    box_px = np.concatenate([batch.size_px.max(axis=1) for batch in batches])[on]
    if not len(box_px):
        raise ConfigError("the training data show no target")
    range_m = config.contract.trained_range_m or _trained_range_m(config.data)
    return _contract(config, training, sha256, thresholds, range_m, _span(focal_px), _span(box_px))


def _trained_range_m(data: DataConfig) -> tuple[float, float]:
    """Range of target depths in training, in whole metres; of datasets by their labels."""
    of_datasets = [DatasetSampler(one.path, one.split, data.seed, 32, 0.0).depths_m for one in data.datasets]
    Z_m = np.clip(np.concatenate([np.zeros(0), *of_datasets]), *Z_RANGE_M)
    spans = [] if data.rendered_share == 0.0 else [RENDERED_RANGE_M]
    if len(Z_m):
        low_m = min(math.floor(Z_m.min()), Z_RANGE_M[1] - 1.0)  # all depths may be equal
        spans.append((low_m, max(math.ceil(Z_m.max()), low_m + 1.0)))
    low_m, high_m = zip(*spans, strict=True)
    return min(low_m), max(high_m)


def _contract(
    config: TrainerConfig,
    training: dict[str, str | int | float],
    sha256: str,
    thresholds: tuple[float, float],
    trained_range_m: tuple[float, float],
    trained_focal_px: tuple[float, float],
    trained_box_px: tuple[float, float],
) -> ModelContract:
    contract = config.contract
    return ModelContract(
        version=CONTRACT_VERSION,
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
        pixel_mean_bgr=IMAGENET_MEAN_BGR,
        pixel_std_bgr=IMAGENET_STD_BGR,
        depth_limits_m=Z_RANGE_M,
        trained_range_m=trained_range_m,
        trained_focal_px=trained_focal_px,
        trained_box_px=trained_box_px,
        airframes=airframe_names(config.data.airframe_ids) if config.data.rendered_share > 0.0 else [],
        data=data_told(config.data),
        training=training,
        metrics={},
        weights_sha256=sha256,
    )


def data_told(data: DataConfig) -> str:
    """Description of a configuration's training data."""
    rendered = data.rendered_share
    name_of = lambda path: os.path.basename(os.path.abspath(path))  # noqa: E731, "." has no name of its own
    parts = [f"{name_of(source.path)}, split {source.split}: {source.share:.0%}" for source in data.datasets]
    if rendered > 0.0:
        told = f"rendered windows: {rendered:.0%}, of them {data.empty_share:.0%} without a target"
        told += f", {data.acquire_share:.0%} of the whole frame"
        told += f", {data.flown_share:.0%} of flown frames" if data.flown_share else ""
        parts.append(told + (f", {data.invented_share:.0%} of invented aircraft" if data.invented_share else ""))
    return "; ".join(parts)


def airframe_names(ids: list[int] | None) -> list[str]:
    """Names of the training airframes; None: all."""
    from sim_replay.airframes import AIRFRAMES

    return [AIRFRAMES[i].name for i in (range(len(AIRFRAMES)) if ids is None else ids)]


def export_models(
    checkpoint: Path,
    out: Path,
    *,
    float_out: Path | None = None,
    contract: ContractConfig | None = None,
    tolerance: Tolerance = Tolerance(),  # noqa: B008, a NamedTuple does not change
    samples: int = 300,
    open_view: OpenView | None = None,
    say: Callable[[str], None] = print,
) -> tuple[Path, Path]:
    """Write NAME-fp32.onnx into `float_out` (default `out`) and NAME-int8.onnx into `out`; returns their paths.

    `contract` replaces the [contract] section of the checkpoint's configuration. If INT8's poses or recall
    differ from FP32's by more than the tolerance, on windows not used for calibration, it raises ConfigError and writes
    no INT8 file (an existing one is kept).
    """
    model, config, training, sha256 = load_model(checkpoint)
    if contract is not None:
        config = _with_contract(config, contract)
    held_out = open_view or (lambda seed, size, share: stage_sampler(config.data, seed, size, share))
    trained_on = open_view or (lambda seed, size, share: stage_sampler(config.data, seed, size, share, held_out=False))
    float_path = (float_out or out) / f"{config.contract.name}-fp32.onnx"
    int8_path = out / f"{config.contract.name}-int8.onnx"
    for path in (float_path, int8_path):
        made_folder(path.parent)

    warn_of_unseen_reduction(config.contract)
    say("rendering windows for calibration and comparison")
    tally = Tally("rendering", 2 * sum(_windows_of(config.contract, samples)), say)
    calibration = render_views(config, CALIBRATION_SEED, samples, trained_on, tally)
    comparison = render_views(config, COMPARISON_SEED, samples, held_out, tally)
    _refuse_without_targets(comparison)

    with tempfile.TemporaryDirectory() as folder:
        exact = Path(folder) / float_path.name  # until the end: another export may replace the one in `out`
        write_graph(model, exact)
        floats = _predict(onnx_predictor(exact), comparison, "FP32", say)
        acquire_min = choose_threshold(floats.acquire, comparison.acquire)
        track_min = choose_threshold(floats.track, comparison.track) if floats.track else acquire_min
        thresholds = (acquire_min, track_min)
        promise = make_contract(config, training, sha256, calibration, thresholds)
        metrics = _metrics(floats, comparison, thresholds)
        write_contract(exact, promise.model_copy(update={"metrics": metrics}))
        try:
            with unfinished(float_path) as part:
                shutil.copyfile(exact, part)
        except OSError as error:
            raise ConfigError(f"{float_path}: cannot be written: {error.strerror}") from error
        by_torch = _predict(torch_predictor(model), comparison, "PyTorch", say)
        say(comparison_table(comparison, "FP32 vs. PyTorch", floats, by_torch, thresholds)[0])
        for warning in too_blind(metrics):
            say(warning)

        write_int8(exact, int8_path, promise, calibration, comparison, floats, tolerance, say)
    say(f"wrote {float_path} and {int8_path}")
    return float_path, int8_path


def export_unmeasured(
    source: Path,
    out: Path,
    *,
    untrained: bool = False,
    contract: ContractConfig | None = None,
    score_min: float = UNREACHABLE_SCORE,
) -> Path:
    """Write NAME-unmeasured-fp32.onnx into `out`; returns its path.

    `source` is a checkpoint, or with `untrained` a configuration whose network gets random weights; `contract` as in
    `export_models`. Nothing is rendered or measured: the file has no metrics, and `score_min` is the threshold of both
    stages. By default no peak reaches it, so that the file can be timed but not flown. Raises ConfigError.
    """
    if untrained:
        config = load_config(source)
        model = PoseNet(config.model.deployed()).eval()
        training: dict[str, str | int | float] = {"samples": 0}
        sha256 = weights_sha256(model.state_dict())
    else:
        model, config, training, sha256 = load_model(source)
    if contract is not None:
        config = _with_contract(config, contract)
    made_folder(out)
    path = out / f"{config.contract.name}-unmeasured-fp32.onnx"
    range_m = config.contract.trained_range_m or (Z_RANGE_M if config.data.datasets else RENDERED_RANGE_M)
    spans = (range_m, ANY_SIZE_PX, ANY_SIZE_PX)
    with unfinished(path) as part:
        write_graph(model, part)
        write_contract(part, _contract(config, training, sha256, (score_min, score_min), *spans))
    return path


def _with_contract(config: TrainerConfig, contract: ContractConfig) -> TrainerConfig:
    """The configuration with another [contract]. Raises ConfigError if that contradicts how the network was trained."""
    try:
        return TrainerConfig.model_validate(config.model_dump() | {"contract": contract.model_dump()})
    except ValidationError as error:
        told = "; ".join(fault.reason for fault in faults_of(error))
        raise ConfigError(f"--config: its [contract] contradicts the network's training: {told}") from error


def write_int8(
    float_path: Path,
    int8_path: Path,
    promise: ModelContract,
    calibration: Views,
    comparison: Views,
    floats: Measured,
    tolerance: Tolerance,
    say: Callable[[str], None],
) -> None:
    """Write a temporary INT8 file, compare it with FP32 on `comparison`, and rename it only if it is accepted.

    `promise` is the FP32 file's contract, `floats` its predictions. Raises ConfigError if INT8 deviates too far.
    """
    with unfinished(int8_path) as unproved:
        quantise_graph(float_path, unproved, [*calibration.track, *calibration.acquire], say)
        int8 = _predict(onnx_predictor(unproved), comparison, "INT8", say)
        thresholds = (promise.acquire_score_min, promise.track_score_min)
        table, strayed = comparison_table(comparison, "INT8 vs. FP32", int8, floats, thresholds)
        say(table)
        refusal = strayed.refusal(tolerance)
        if refusal is not None:
            raise ConfigError(f"{int8_path}: not written: {refusal}")
        measured = {"precision": "int8", "metrics": _metrics(int8, comparison, thresholds)}
        write_contract(unproved, promise.model_copy(update=measured))
