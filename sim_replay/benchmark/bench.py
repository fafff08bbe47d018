"""`uavpose-replay bench`: how fast this machine generates whole frames and training windows."""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from edge.errors import InputError
from sim_replay.benchmark.crew import CrewError, Stopped, Tell, available_cores, crew
from sim_replay.benchmark.plan import plan_dataset
from sim_replay.benchmark.preset import load_preset
from sim_replay.benchmark.scene_store import SceneStore
from sim_replay.benchmark.sequence_files import Job, add_frame

WINDOW_PX = 128
BATCH = 64
Kind = Literal["frames", "windows"]


@dataclass(frozen=True)
class Measured:
    """One worker's result."""

    count: int
    seconds: float
    renderer: str  # as reported by OpenGL

    @property
    def rate(self) -> float:
        """Per second."""
        return self.count / self.seconds


def _measure(kind: Kind, seconds: float, worker: int, tell: Tell, stopped: Stopped) -> Measured:
    """A crew's task: warm up, then render for `seconds`."""
    return _frames(seconds, worker) if kind == "frames" else _windows(seconds, worker)


def _frames(seconds: float, worker: int) -> Measured:
    """Frames of fw-uav6d, rendered, labelled, compressed and written as `generate` does."""
    preset = load_preset("fw-uav6d")
    plans = plan_dataset(preset, 0)
    plan = plans[worker % len(plans)]
    with tempfile.TemporaryDirectory() as folder:
        job = Job(preset, Path(folder), "uavpose-replay bench", {plan.index: plan.focal_px})
        film = job.film(plan)
        with SceneStore(job.folder(plan), plan.jpeg_quality) as store:
            add_frame(store, film, 0, labels_only=False)
            done, start_s = 0, time.perf_counter()
            while (spent_s := time.perf_counter() - start_s) < seconds:
                add_frame(store, film, done % plan.frames, labels_only=False)
                done += 1
    return Measured(done, spent_s, _renderer_name())


def _windows(seconds: float, worker: int) -> Measured:
    from sim_replay.sampler import WindowSampler

    sampler = WindowSampler(worker, WINDOW_PX)
    sampler.batch(0, BATCH)
    done, start_s = 0, time.perf_counter()
    while (spent_s := time.perf_counter() - start_s) < seconds:
        sampler.batch(done, BATCH)
        done += BATCH
    return Measured(done, spent_s, _renderer_name())


def _renderer_name() -> str:
    import moderngl

    context = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]
    name = str(context.info["GL_RENDERER"])
    context.release()
    return name


def bench(seconds: float, workers: int) -> dict[str, Any]:
    """Rates of each worker and in total, all workers rendering at once. Raises CrewError."""
    from edge.bench.measure import cpu_name  # loads ONNX Runtime, which workers do without

    out: dict[str, Any] = {"cpu": cpu_name(), "cores": available_cores(), "workers": workers, "seconds": seconds}
    for kind in ("frames", "windows"):
        results = _run_all(kind, seconds, workers)
        each = [round(result.rate, 2) for result in results]
        out["gl_renderer"] = results[0].renderer
        out[f"{kind}_per_second"] = {"together": round(sum(each), 2), "each_worker": each}
    return out


def _run_all(kind: Kind, seconds: float, workers: int) -> Sequence[Measured]:
    return [said.value for said in crew(partial(_measure, kind, seconds), range(workers), workers)]


def run(seconds: float, workers: int | None, as_json: bool) -> int:
    """Measure and print. Exit codes: 0 measured, 1 a worker failed. Raises InputError."""
    chosen = available_cores() if workers is None else workers
    if not 0 < seconds < math.inf or chosen < 1:
        raise InputError("--seconds and --workers: must be above 0 and finite")
    try:
        found = bench(seconds, chosen)
    except CrewError as error:
        Console(stderr=True).print(str(error))
        return 1
    if as_json:
        print(json.dumps(found, indent=2))
        return 0
    table = Table(title=f"{found['cpu']}, {found['cores']} cores; {found['gl_renderer']}")
    for column in ("", "each worker", f"{chosen} together"):
        table.add_column(column)
    for kind, name in (("frames", "whole frames/s, written"), ("windows", f"training windows/s at {WINDOW_PX}²")):
        rates = found[f"{kind}_per_second"]
        table.add_row(name, ", ".join(str(rate) for rate in rates["each_worker"]), str(rates["together"]))
    Console().print(table)
    return 0
