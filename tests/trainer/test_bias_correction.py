"""Rounded weights shift the mean output of a channel; its bias makes up for that, on other pictures too."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from trainer.bias_correction import correct_biases

PICTURES = 24


class Reader(CalibrationDataReader):
    def __init__(self, pictures: list[dict[str, np.ndarray]]) -> None:
        self._left = list(pictures)

    def get_next(self) -> dict[str, np.ndarray] | None:
        return self._left.pop() if self._left else None


def pictures(seed: int) -> list[dict[str, np.ndarray]]:
    """Never negative, as after a Relu; of two sizes."""
    rng = np.random.default_rng(seed)
    sizes = [(40, 48) if i % 2 else (32, 32) for i in range(PICTURES)]
    return [{"x": rng.gamma(2.0, 0.5, (1, 8, *size)).astype(np.float32)} for size in sizes]


def network() -> torch.nn.Module:
    """Plain, depthwise with uneven strides and padding, dilated. A weight in each channel is large, so that the others
    are rounded coarsely."""
    torch.manual_seed(5)
    convolutions = [
        torch.nn.Conv2d(8, 12, 3, padding=1),
        torch.nn.Conv2d(12, 12, 3, stride=(2, 1), padding=(1, 0), groups=12),
        torch.nn.Conv2d(12, 6, 3, dilation=2),
    ]
    for conv in convolutions:
        conv.weight.data[:, 0, 1, 1] = 8.0 * conv.weight.data.abs().amax()
    first, second, third = convolutions
    return torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU(), third).eval()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The network in float and in INT8, not corrected."""
    folder = tmp_path_factory.mktemp("biases")
    floats, int8 = folder / "floats.onnx", folder / "int8.onnx"
    free = {"x": {2: "H", 3: "W"}, "y": {2: "H", 3: "W"}}
    names = {"input_names": ["x"], "output_names": ["y"], "dynamic_axes": free}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter's own
        torch.onnx.export(network(), (torch.rand(1, 8, 32, 32),), str(floats), opset_version=17, dynamo=False, **names)
    quantize_static(
        str(floats),
        str(int8),
        Reader(pictures(0)),
        quant_format=QuantFormat.QDQ,
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    return floats, int8


def means(model: onnx.ModelProto, seed: int) -> np.ndarray:
    """Mean output [6] of each channel."""
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.mean([session.run(["y"], one)[0].mean((0, 2, 3)) for one in pictures(seed)], axis=0)


def test_channels_keep_their_mean_on_other_pictures(files: tuple[Path, Path]) -> None:
    floats, rounded = (onnx.load(str(path)) for path in files)
    corrected = onnx.load(str(files[1]))
    correct_biases(corrected, floats.graph, pictures(0))
    right = means(floats, 1)
    before, after = (np.abs(means(model, 1) - right).max() for model in (rounded, corrected))
    assert after < 0.1 * before


def test_only_biases_change(files: tuple[Path, Path]) -> None:
    floats, rounded = (onnx.load(str(path)) for path in files)
    corrected = onnx.load(str(files[1]))
    correct_biases(corrected, floats.graph, pictures(0))
    pairs = zip(rounded.graph.initializer, corrected.graph.initializer, strict=True)
    changed = [old.name for old, new in pairs if old.SerializeToString() != new.SerializeToString()]
    assert len(changed) == 3
    assert all("bias" in name for name in changed)
    assert list(rounded.graph.node) == list(corrected.graph.node)
    onnx.checker.check_model(corrected)
