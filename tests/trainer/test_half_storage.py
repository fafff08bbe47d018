"""Weights stored in half precision: the file shrinks; what half can hold answers the same bit by bit."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from trainer.half_storage import STORED_LEAST, store_halved

SIDE = 128


def product_with(weights: np.ndarray) -> onnx.ModelProto:
    """x [1, 128] times the weights [128, 128], plus a bias."""
    row = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, SIDE])
    out = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, SIDE])
    nodes = [
        onnx.helper.make_node("MatMul", ["x", "w"], ["product"]),
        onnx.helper.make_node("Add", ["product", "b"], ["y"]),
    ]
    constants = [
        onnx.numpy_helper.from_array(weights, "w"),
        onnx.numpy_helper.from_array(np.float32([0.1] * SIDE), "b"),
    ]
    graph = onnx.helper.make_graph(nodes, "g", [row], [out], constants)
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)


def answer(model: onnx.ModelProto) -> np.ndarray:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    x = np.random.default_rng(1).normal(size=(1, SIDE)).astype(np.float32)
    return session.run(None, {"x": x})[0]


def test_a_file_of_weights_from_a_half_precision_checkpoint_halves_and_answers_the_same() -> None:
    assert SIDE * SIDE >= STORED_LEAST
    weights = np.random.default_rng(0).normal(size=(SIDE, SIDE)).astype(np.float16).astype(np.float32)
    model = product_with(weights)
    before, size = answer(model), len(model.SerializeToString())
    store_halved(model.graph)
    onnx.checker.check_model(model)
    assert np.array_equal(answer(model), before)
    assert len(model.SerializeToString()) < 0.6 * size
    assert [t.data_type for t in model.graph.initializer] == [onnx.TensorProto.FLOAT16, onnx.TensorProto.FLOAT]


@pytest.mark.filterwarnings("error")
def test_weights_beyond_half_precision_stay_as_they_are() -> None:
    model = product_with(np.full((SIDE, SIDE), 1e6, dtype=np.float32))
    before = answer(model)
    store_halved(model.graph)
    assert np.array_equal(answer(model), before)
