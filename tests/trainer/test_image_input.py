"""The INT8 graph computes from bytes what it would from normalised pixels."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from torch import Tensor, nn

from trainer.image_input import PIXEL_ZERO, feed_pixels, fold_normalisation, quantised_as_pixels

MEAN, STD = torch.tensor([100.0, 120.0, 90.0]), torch.tensor([50.0, 60.0, 55.0])


class Begin(nn.Module):
    """A picture [N, H, W, 3], normalised and convolved."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.conv = nn.Conv2d(3, 8, 3, 2)

    def forward(self, image: Tensor) -> Tensor:
        x = (image.permute(0, 3, 1, 2).float() - MEAN[:, None, None]) / STD[:, None, None]
        return self.conv(x)


@pytest.fixture
def graph_file(tmp_path: Path) -> Path:
    traced, path = tmp_path / "traced.onnx", tmp_path / "begin.onnx"
    image = torch.zeros(1, 33, 33, 3, dtype=torch.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(Begin(), (image,), str(traced), input_names=["image"], output_names=["y"], dynamo=False)
    quant_pre_process(str(traced), str(path), skip_symbolic_shape=True)
    return path


def run(path: Path, image: np.ndarray) -> np.ndarray:
    return ort.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(None, {"image": image})[0]


def pictures(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 256, (1, 33, 33, 3), dtype=np.uint8) for _ in range(count)]


class Reader(CalibrationDataReader):
    def __init__(self) -> None:
        self.left = pictures(4)

    def get_next(self) -> dict[str, np.ndarray] | None:
        return {"image": self.left.pop()} if self.left else None


def folded(path: Path) -> str:
    model = onnx.load(str(path))
    tensor = fold_normalisation(model.graph, "image")
    onnx.save(model, str(path))
    return tensor


def test_folding_the_normalisation_changes_nothing(graph_file: Path) -> None:
    image = pictures(1)[0]
    before = run(graph_file, image)
    folded(graph_file)
    np.testing.assert_allclose(run(graph_file, image), before, atol=1e-4)


def test_bytes_are_the_quantised_picture(graph_file: Path, tmp_path: Path) -> None:
    image, before = pictures(1)[0], run(graph_file, pictures(1)[0])
    tensor = folded(graph_file)
    int8 = tmp_path / "int8.onnx"
    quantize_static(
        str(graph_file),
        str(int8),
        Reader(),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv"],
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        extra_options={"TensorQuantOverrides": quantised_as_pixels(tensor)},
    )
    by_arithmetic = run(int8, image)
    model = onnx.load(str(int8))
    feed_pixels(model.graph, "image")
    onnx.checker.check_model(model)
    onnx.save(model, str(int8))
    np.testing.assert_array_equal(run(int8, image), by_arithmetic)
    assert np.abs(by_arithmetic - before).max() < 0.05 * np.abs(before).max()
    kinds = [node.op_type for node in model.graph.node]
    assert not {"Cast", "Sub", "Div"} & set(kinds)
    assert all(tensor.name != "pixel_zero" for tensor in model.graph.initializer)


def test_a_graph_that_begins_otherwise_is_refused(graph_file: Path) -> None:
    model = onnx.load(str(graph_file))
    div = next(node for node in model.graph.node if node.op_type == "Div")
    div.op_type = "Mul"
    with pytest.raises(ValueError, match="does not begin with"):
        fold_normalisation(model.graph, "image")
    assert 0 < PIXEL_ZERO < 255
