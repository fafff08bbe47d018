"""A first convolution over quads of pixels gives the bytes that one over pixels gives."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from trainer.pixel_quads import take_quads

OUTPUTS = 5
FIRST_PIXEL = [0, 0, 1, 1]  # pads: a window's first column is the picture's
CENTRED = [1, 1, 1, 1]


def bytes_graph(pads: list[int], stride: int = 2) -> onnx.ModelProto:
    """image -> Transpose -> DQ -> Conv -> Q -> DQ -> y, as the quantiser and `feed_pixels` leave it."""
    rng = np.random.default_rng(5)
    scale = rng.uniform(0.001, 0.01, OUTPUTS).astype(np.float32)
    constants = {
        "pixel_scale": np.array(1.0, np.float32),
        "pixel_zero": np.array(114, np.uint8),
        # Two products with a byte fit into 16 bits: where there are no 8-bit dot products they would be cut to that.
        "w": rng.integers(-63, 64, (OUTPUTS, 3, 3, 3)).astype(np.int8),
        "w_scale": scale,
        "w_zero": np.zeros(OUTPUTS, np.int8),
        "b": rng.integers(-4000, 4000, OUTPUTS).astype(np.int32),
        "b_scale": scale,
        "b_zero": np.zeros(OUTPUTS, np.int32),
        "y_scale": np.array(3.0, np.float32),
        "y_zero": np.array(128, np.uint8),
    }
    nodes = [
        helper.make_node("Transpose", ["image"], ["x"], perm=[0, 3, 1, 2]),
        helper.make_node("DequantizeLinear", ["x", "pixel_scale", "pixel_zero"], ["x_float"]),
        helper.make_node("DequantizeLinear", ["w", "w_scale", "w_zero"], ["w_float"], axis=0),
        helper.make_node("DequantizeLinear", ["b", "b_scale", "b_zero"], ["b_float"], axis=0),
        helper.make_node(
            "Conv", ["x_float", "w_float", "b_float"], ["c"], kernel_shape=[3, 3], strides=[stride] * 2, pads=pads
        ),
        helper.make_node("QuantizeLinear", ["c", "y_scale", "y_zero"], ["y_bytes"]),
        helper.make_node("DequantizeLinear", ["y_bytes", "y_scale", "y_zero"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "bytes",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, ["N", "H", "W", 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", OUTPUTS, "h", "w"])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
        value_info=[helper.make_tensor_value_info("c", TensorProto.FLOAT, ["N", OUTPUTS, "h", "w"])],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def run(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"image": image})[0]


@pytest.mark.parametrize("pads", [FIRST_PIXEL, CENTRED])
@pytest.mark.parametrize("size", [(4, 4), (6, 20), (32, 64)])
def test_it_gives_the_same_bytes_of_every_picture(pads: list[int], size: tuple[int, int]) -> None:
    model = bytes_graph(pads)
    image = np.random.default_rng(6).integers(0, 256, (2, *size, 3), dtype=np.uint8)
    before = run(model, image)
    take_quads(model.graph, "image")
    onnx.checker.check_model(model, full_check=True)
    assert before.shape[2:] == (size[0] // 2, size[1] // 2)
    assert len(np.unique(before)) > 10
    np.testing.assert_array_equal(run(model, image), before)
    conv = next(node for node in model.graph.node if node.op_type == "Conv")
    assert next(list(a.ints) for a in conv.attribute if a.name == "strides") == [2, 1]


@pytest.mark.parametrize(("pads", "stride"), [(CENTRED, 1), ([0, 0, 0, 0], 2)])
def test_a_convolution_that_does_not_halve_the_picture_is_refused(pads: list[int], stride: int) -> None:
    with pytest.raises(ValueError, match="not half the picture's width"):
        take_quads(bytes_graph(pads, stride).graph, "image")


def test_one_whose_output_stays_in_float_is_refused() -> None:
    model = bytes_graph(CENTRED)
    quantise = next(node for node in model.graph.node if node.op_type == "QuantizeLinear")
    quantise.CopyFrom(helper.make_node("Relu", ["c"], ["y_bytes"]))
    before = model.SerializeToString(deterministic=True)
    with pytest.raises(ValueError, match="not quantised"):
        take_quads(model.graph, "image")
    assert model.SerializeToString(deterministic=True) == before
