"""The same file in OpenVINO, if the package `openvino` is installed."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs.contract import ModelContract

PACKAGE = "openvino"


def version() -> str | None:
    """None: not installed."""
    return importlib.metadata.version(PACKAGE) if importlib.util.find_spec(PACKAGE) is not None else None


def engine(
    path: Path, contract: ModelContract, image: NDArray[np.uint8], K: NDArray[np.float32], threads: int
) -> Callable[[], object]:
    """`edge.bench.engines.Engine` on the CPU, compiled for this size only."""
    core = importlib.import_module(PACKAGE).Core()
    network = core.read_model(str(path))
    network.reshape({"image": list(image.shape), "K": list(K.shape)})
    # By default it computes FP32 files in bfloat16 if the processor supports it.
    precision = {"INFERENCE_PRECISION_HINT": "f32"}
    settings = {"INFERENCE_NUM_THREADS": threads, "NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY", **precision}
    request = core.compile_model(network, "CPU", settings).create_infer_request()
    return lambda: request.infer({"image": image, "K": K})
