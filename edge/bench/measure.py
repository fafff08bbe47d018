"""All measurements: model files by stage, number of threads and engine, and the machine's peak."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from edge.bench import openvino, peak
from edge.bench.engines import Engine, other_engines
from edge.bench.macs import Macs, count_macs
from edge.bench.peak import Peak
from edge.bench.timing import Milliseconds, time_in_turns
from edge.estimator.model import Model, load_model
from msgs.contract import ModelContract

ORT = "onnxruntime"
CPU_INFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Case:
    """One row: a stage of a file on a number of threads of an engine (ORT, `openvino`, `pytorch`)."""

    file: str
    stage: str
    threads: int
    engine: str


@dataclass(frozen=True)
class Row:
    case: Case
    configuration: str
    precision: str
    size_wh: tuple[int, int]
    macs: Macs
    ms: Milliseconds
    limit_ms: float | None  # least time, at the machine's peak on these threads; None: that is not known


@dataclass(frozen=True)
class Machine:
    cpu: str
    cores: int  # available to this process
    onnxruntime: str
    openvino: str | None  # None: not installed


@dataclass(frozen=True)
class Measured:
    """One run on one machine."""

    machine: Machine
    rounds: int
    models: dict[str, Model]  # by file
    peaks: tuple[Peak, ...]
    rows: tuple[Row, ...]


def measure(
    models: Sequence[Path],
    threads: Sequence[int],
    spinning: bool,
    rounds: int,
    others: bool,
    on_round: Callable[[int], None],
) -> Measured:
    """Time all cases in turns, on noise, and `others` in every available engine, after all else of a round: ONNX
    Runtime's rows then follow each other as they do without other engines.

    Raises InputError for a file that is not a model.
    """
    engines = other_engines() if others else {}
    calls: dict[Case, Callable[[], object]] = {}
    loaded: dict[str, Model] = {}
    for path in models:
        for count in threads:
            loaded[str(path)] = model = load_model(path, count, spinning)
            model.warm_up()
            calls |= _cases(model, count, engines)
    counts = sorted({1, *threads})
    peaks: dict[Case, Callable[[], object]] = {
        Case("", precision, count, "peak"): peak.product(precision, count)
        for count in counts
        for precision in ("int8", "fp32")
    }
    ours = {case: call for case, call in calls.items() if case.engine == ORT}
    ms = time_in_turns({**ours, **peaks, **calls}, rounds, on_round, warm=peaks)
    rates = {case: peak.MACS / ms[case].p10 / 1e6 for case in peaks}
    measured = [Peak(n, rates[Case("", "int8", n, "peak")], rates[Case("", "fp32", n, "peak")]) for n in counts]
    by_threads = {one.threads: one.beside(measured[0]) for one in measured}
    macs = {
        (file, stage): count_macs(model.path.read_bytes(), size_wh)
        for file, model in loaded.items()
        for stage, size_wh in stages(model.contract).items()
    }
    rows = tuple(_row(case, loaded[case.file], macs[case.file, case.stage], ms[case], by_threads) for case in calls)
    return Measured(_machine(), rounds, loaded, tuple(by_threads.values()), rows)


def stages(contract: ModelContract) -> dict[str, tuple[int, int]]:
    """The network's input sizes (width, height) by stage."""
    track = {"track": contract.track_size_wh} if contract.track_size_wh is not None else {}
    return {"acquire": contract.acquire_size_wh, **track}


def _cases(model: Model, threads: int, others: Mapping[str, Engine]) -> dict[Case, Callable[[], object]]:
    calls: dict[Case, Callable[[], object]] = {}
    for stage, (width, height) in stages(model.contract).items():
        image = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), dtype=np.uint8)
        K: NDArray[np.float32] = np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]], np.float32)
        calls[Case(str(model.path), stage, threads, ORT)] = partial(model.run, image, K.astype(np.float64))
        for name, engine in others.items():
            call = engine(model.path, model.contract, image, K, threads)
            if call is not None:
                calls[Case(str(model.path), stage, threads, name)] = call
    return calls


def _row(case: Case, model: Model, macs: Macs, ms: Milliseconds, peaks: dict[int, Peak]) -> Row:
    contract = model.contract
    limit_ms = peaks[case.threads].limit_ms(macs.int8, macs.float32)
    return Row(case, contract.configuration, contract.precision, stages(contract)[case.stage], macs, ms, limit_ms)


def _machine() -> Machine:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Machine(cpu_name(), cores, ort.__version__, openvino.version())


def cpu_name() -> str:
    """The processor's name from the kernel. Arm kernels give the board's, if any; otherwise it is the architecture."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model"))]
    return names[0] if names else platform.machine()
