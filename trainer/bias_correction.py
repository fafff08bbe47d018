"""Corrects the mean error of convolutions with rounded weights, in their biases: the INT8 graph takes no longer for it.

Rounding a channel's weights shifts its mean output, because inputs have a mean: after Relu they are never negative.
Such shifts add up over the layers. (Empirical bias correction: Nagel et al., "Data-Free Quantization Through Weight
Equalization and Bias Correction", ICCV 2019.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch.nn import functional


class _Rounded(NamedTuple):
    """A convolution whose weights are rounded."""

    node: onnx.NodeProto
    lost: torch.Tensor  # [O, I, h, w], float minus rounded weights
    bias: onnx.TensorProto  # int32
    bias_scale: NDArray[np.float32]  # [O]


def correct_biases(
    quantised: onnx.ModelProto, floats: onnx.GraphProto, inputs: Iterable[Mapping[str, NDArray]]
) -> None:
    """Add to each bias the channel's mean output that the rounded weights miss: over the pixels of each of `inputs`,
    then over these, however large they are.

    `floats` is the graph that `quantised` (QDQ, int32 biases) was made from, with the same names of nodes. Inputs of a
    convolution are taken as quantised, so that the correction does not depend on that of the layers before.
    """
    rounded = _rounded(quantised.graph, floats)
    shown = onnx.ModelProto()
    shown.CopyFrom(quantised)
    del shown.graph.output[:]
    names = list(dict.fromkeys(conv.node.input[0] for conv in rounded))
    shown.graph.output.extend(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None) for name in names)
    session = ort.InferenceSession(shown.SerializeToString(), providers=["CPUExecutionProvider"])
    sums = [np.zeros(len(conv.lost)) for conv in rounded]
    count = 0
    for feeds in inputs:
        seen = dict(zip(names, session.run(names, feeds), strict=True))
        for total, conv in zip(sums, rounded, strict=True):
            total += _convolved(conv.node, seen[conv.node.input[0]], conv.lost).mean((0, 2, 3)).numpy()
        count += 1
    for total, conv in zip(sums, rounded, strict=True):
        steps = np.rint(total / count / conv.bias_scale).astype(np.int32)
        conv.bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(conv.bias) + steps, conv.bias.name))


def _rounded(graph: onnx.GraphProto, floats: onnx.GraphProto) -> list[_Rounded]:
    constants = {tensor.name: tensor for tensor in graph.initializer}
    float_constants = {tensor.name: tensor for tensor in floats.initializer}
    float_weights = {node.name: float_constants[node.input[1]] for node in floats.node if node.op_type == "Conv"}
    dequantised = {node.output[0]: node for node in graph.node if node.op_type == "DequantizeLinear"}

    def values(name: str) -> NDArray:
        return numpy_helper.to_array(constants[name])

    found = []
    for node in graph.node:
        if node.op_type != "Conv" or node.input[1] not in dequantised:
            continue
        weight, bias = (dequantised[name].input for name in node.input[1:3])
        kept = values(weight[0]).astype(np.float32) * values(weight[1]).reshape(-1, 1, 1, 1)  # zero point is 0
        lost = torch.from_numpy(numpy_helper.to_array(float_weights[node.name]) - kept)
        found.append(_Rounded(node, lost, constants[bias[0]], values(bias[1])))
    return found


def _convolved(node: onnx.NodeProto, x: NDArray[np.float32], weight: torch.Tensor) -> torch.Tensor:
    """What `node` computes with another weight and no bias."""
    given = {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
    top, left, bottom, right = given.get("pads", (0, 0, 0, 0))
    padded = functional.pad(torch.from_numpy(x), (left, right, top, bottom))
    return functional.conv2d(
        padded,
        weight,
        stride=tuple(given.get("strides", (1, 1))),
        dilation=tuple(given.get("dilations", (1, 1))),
        groups=given.get("group", 1),
    )
