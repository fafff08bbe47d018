"""What the shipped INT8 file is made of, read from its graph: QDQ, U8 activations, S8 weights for each channel."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, numpy_helper

from sim_replay.offline import SHIPPED_MODEL
from trainer.export import CALIBRATION_SEED, COMPARISON_SEED
from trainer.graph import QUANTISED_PARTS, read_contract


class Graph:
    def __init__(self) -> None:
        graph = onnx.load(str(SHIPPED_MODEL)).graph
        self.nodes = list(graph.node)
        self.inputs = {node.name: node.type.tensor_type.elem_type for node in graph.input}
        self.made_by = {name: node for node in self.nodes for name in node.output}
        self.readers: dict[str, list[onnx.NodeProto]] = {}
        for node in self.nodes:
            for name in node.input:
                self.readers.setdefault(name, []).append(node)
        self.constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}

    def convolutions(self, quantised: bool) -> list[onnx.NodeProto]:
        return [n for n in self.nodes if n.op_type == "Conv" and n.name.startswith(QUANTISED_PARTS) == quantised]


@pytest.fixture(scope="module")
def graph() -> Graph:
    return Graph()


def test_every_convolution_but_the_last_of_a_head_is_in_int8(graph: Graph) -> None:
    assert len(graph.convolutions(quantised=True)) > 50
    for conv in graph.convolutions(quantised=True):
        activation, weight = (graph.made_by[name] for name in conv.input[:2])
        assert activation.op_type == weight.op_type == "DequantizeLinear", conv.name
        assert graph.constants[activation.input[2]].dtype == np.uint8, conv.name
        assert graph.constants[activation.input[1]].size == 1
        stored = graph.constants[weight.input[0]]
        assert stored.dtype == np.int8, conv.name
        assert graph.constants[weight.input[1]].shape == (stored.shape[0],), f"{conv.name}: a scale for each channel"
        assert not graph.constants[weight.input[2]].any(), "symmetric"
    assert [conv.name.split("/")[1] for conv in graph.convolutions(quantised=False)] == ["head_hm"]


def test_it_is_of_standard_operators_alone(graph: Graph) -> None:
    assert {node.domain for node in graph.nodes} <= {"", "ai.onnx"}
    assert not any(node.op_type.startswith("QLinear") for node in graph.nodes)


def test_the_pictures_bytes_go_into_the_first_convolution_as_they_are(graph: Graph) -> None:
    assert graph.inputs == {"image": TensorProto.UINT8, "K": TensorProto.FLOAT}
    (quads,) = [node for node in graph.readers["image"] if node.op_type != "Shape"]
    assert quads.op_type == "Reshape"
    (turned,) = graph.readers[quads.output[0]]
    assert turned.op_type == "Transpose"
    (scaled,) = [node for node in graph.readers[turned.output[0]] if node.op_type != "Shape"]
    assert scaled.op_type == "DequantizeLinear"
    assert graph.constants[scaled.input[1]] == 1.0
    (conv,) = graph.readers[scaled.output[0]]
    assert next(list(a.ints) for a in conv.attribute if a.name == "strides") == [2, 1], "four pixels at a time"


def test_it_says_what_it_was_made_from() -> None:
    contract = read_contract(SHIPPED_MODEL)
    assert contract.precision == "int8"
    assert contract.training["seed"] not in (CALIBRATION_SEED, COMPARISON_SEED)
    assert contract.metrics["track_windows"] >= 256
    assert contract.airframes
    assert len(contract.weights_sha256) == 64
