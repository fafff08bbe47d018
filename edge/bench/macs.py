"""Multiply-accumulates (MACs) of a network, from the kernels that ONNX Runtime executes for one input size."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

KERNEL_SUFFIX = "_kernel_time"
QUANTISED = ("QLinear", "Integer", "QGemm", "Quantize")
Shape = list[int]


@dataclass(frozen=True)
class Macs:
    """Of one inference of one image."""

    int8: int
    float32: int


def count_macs(model: bytes, size_wh: tuple[int, int]) -> Macs:
    """Run `model` (inputs as in msgs.contract) once at `size_wh` under ONNX Runtime's profiler and sum its kernels."""
    width, height = size_wh
    with tempfile.TemporaryDirectory() as folder:
        options = ort.SessionOptions()
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        # The layout optimisations of the highest level, and prepacking, would hide the shapes of the weights.
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
        options.add_session_config_entry("session.disable_prepacking", "1")
        session = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        K = np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]], dtype=np.float32)
        session.run(None, {"image": np.zeros((1, height, width, 3), dtype=np.uint8), "K": K})
        events = json.loads(Path(session.end_profiling()).read_text(encoding="utf-8"))
    return macs_of_kernels(
        event["args"] for event in events if event.get("cat") == "Node" and event["name"].endswith(KERNEL_SUFFIX)
    )


def macs_of_kernels(kernels: Iterable[Mapping[str, Any]]) -> Macs:
    """The sum over convolutions and matrix products; `kernels` as the profiler reports them."""
    int8 = float32 = 0
    for kernel in kernels:
        name = str(kernel["op_name"])
        inputs, outputs = ([_shape(one) for one in kernel[f"{side}_type_shape"]] for side in ("input", "output"))
        if "Conv" in name:
            macs = _convolution(inputs, outputs[0])
        elif "Gemm" in name or "MatMul" in name:
            macs = _product(inputs[0], outputs[0])
        else:
            continue
        if any(part in name for part in QUANTISED):
            int8 += macs
        else:
            float32 += macs
    return Macs(int8, float32)


def _shape(typed: Mapping[str, Shape]) -> Shape:
    return next(iter(typed.values()))


def _convolution(inputs: list[Shape], output: Shape) -> int:
    """Each output element is a sum over its channel's kernel [C_in / groups, ...]."""
    weight = next(shape for shape in inputs[1:] if len(shape) >= 3)
    return math.prod(output) * math.prod(weight[1:])


def _product(left: Shape, output: Shape) -> int:
    """[..., M, K] times [..., K, N], or a transposed left side of rank 2."""
    summed = math.prod(left) // output[0] if len(left) == 2 and len(output) == 2 else left[-1]
    return math.prod(output) * summed
