"""How long one inference of each stage takes on this machine."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edge.config import SHIPPED_MODEL
from edge.estimator.model import Model, load_model
from edge.health import Percentiles, percentiles_ms

UNTIMED_RUNS = 5


@dataclass(frozen=True)
class Timing:
    """One model file on this machine, milliseconds an inference of one image."""

    file: str
    precision: str
    sha256: str
    threads: int
    runs: int
    acquire_ms: Percentiles
    track_ms: Percentiles | None  # None: the model has no track stage


def bench(models: Sequence[Path], threads: int, spinning: bool, runs: int) -> list[Timing]:
    """Time each model in turn, on noise. Raises InputError on a file that is no model."""
    timings = []
    for path in models or [SHIPPED_MODEL]:
        model = load_model(path, threads, spinning)
        model.warm_up()
        contract = model.contract
        track = _time(model, contract.track_size_wh, runs) if contract.track_size_wh is not None else None
        acquire = _time(model, contract.acquire_size_wh, runs)
        timings.append(Timing(str(path), contract.precision, model.sha256, threads, runs, acquire, track))
    return timings


def int8_ratios(timings: Sequence[Timing]) -> dict[str, float]:
    """p50 of the first INT8 file over p50 of the first FP32 file, by stage; empty unless both are there."""
    first = {timing.precision: timing for timing in reversed(timings)}
    if not {"int8", "fp32"} <= set(first):
        return {}
    int8, fp32 = first["int8"], first["fp32"]
    ratios = {"acquire": int8.acquire_ms.p50 / fp32.acquire_ms.p50}
    if int8.track_ms is not None and fp32.track_ms is not None:
        ratios["track"] = int8.track_ms.p50 / fp32.track_ms.p50
    return ratios


def table(timings: Sequence[Timing]) -> str:
    """For a person."""
    lines = [f"{'model':40} {'precision':9} {'stage':8} {'p50 ms':>8} {'p99 ms':>8}"]
    for timing in timings:
        for stage, ms in (("acquire", timing.acquire_ms), ("track", timing.track_ms)):
            if ms is not None:
                lines.append(f"{Path(timing.file).name:40} {timing.precision:9} {stage:8} {ms.p50:8.2f} {ms.p99:8.2f}")
    lines += [f"INT8 / FP32, {stage}: {ratio:.2f}" for stage, ratio in int8_ratios(timings).items()]
    return "\n".join(lines)


def to_json(timings: Sequence[Timing]) -> str:
    """For a script."""
    return json.dumps({"models": [asdict(timing) for timing in timings], "int8_over_fp32": int8_ratios(timings)})


def _time(model: Model, size_wh: tuple[int, int], runs: int) -> Percentiles:
    width, height = size_wh
    image = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), dtype=np.uint8)
    K = np.array([[[float(width), 0.0, width / 2], [0.0, float(width), height / 2], [0.0, 0.0, 1.0]]])
    durations_ns = []
    for run in range(UNTIMED_RUNS + runs):
        start_ns = time.perf_counter_ns()
        model.run(image, K)
        if run >= UNTIMED_RUNS:
            durations_ns.append(time.perf_counter_ns() - start_ns)
    return percentiles_ms(durations_ns)
