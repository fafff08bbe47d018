"""Makes an INT8 graph read the camera's bytes directly, without a float copy of the image.

A uint8 pixel is itself a quantised value, with scale 1 and a zero point of our choice. So the normalisation is folded
into the first convolution, and its input is quantised with these parameters: nothing remains to be computed before it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

# The pixel value that zero padding represents: close to each channel's mean, which it represents in the float network.
PIXEL_ZERO = 114


class _Entry(NamedTuple):
    """The nodes from the image to the first convolution."""

    before: list[onnx.NodeProto]  # Cast, Transpose, Sub, Div, in this or another order
    conv: onnx.NodeProto


def fold_normalisation(graph: onnx.GraphProto, image: str) -> str:
    """Reduce (pixel - mean) / std to pixel - PIXEL_ZERO by folding the rest into the first convolution.

    Returns the name of the convolution's input. Raises ValueError if the graph does not start with these nodes.
    """
    constants = {tensor.name: tensor for tensor in graph.initializer}
    entry = _entry(graph, image)
    sub, div = (next(node for node in entry.before if node.op_type == kind) for kind in ("Sub", "Div"))
    mean, std = (_per_channel(numpy_helper.to_array(constants[node.input[1]])) for node in (sub, div))
    weight, bias = (numpy_helper.to_array(constants[name]) for name in entry.conv.input[1:3])
    scaled = weight / std[None, :, None, None]
    moved = bias - (scaled * (mean - PIXEL_ZERO)[None, :, None, None]).sum((1, 2, 3))
    for name, value in zip(entry.conv.input[1:3], (scaled, moved), strict=True):
        constants[name].CopyFrom(numpy_helper.from_array(value.astype(np.float32), name))
    zero = numpy_helper.from_array(np.array(PIXEL_ZERO, np.float32), "pixel_zero")
    graph.initializer.append(zero)
    sub.input[1] = zero.name
    reader(graph, div.output[0]).input[0] = div.input[0]
    graph.node.remove(div)
    return str(entry.conv.input[0])


def quantised_as_pixels(tensor: str) -> dict[str, list[dict[str, object]]]:
    """ONNX Runtime's TensorQuantOverrides with which a uint8 pixel is its own quantised value."""
    return {tensor: [{"scale": np.array(1.0, np.float32), "zero_point": np.array(PIXEL_ZERO, np.uint8)}]}


def feed_pixels(graph: onnx.GraphProto, image: str) -> None:
    """Feed the uint8 image directly to where a graph quantised with `quantised_as_pixels` computes the same bytes."""
    node, path = reader(graph, image), []
    while node.op_type != "QuantizeLinear":
        path.append(node)
        node = reader(graph, node.output[0])
    turns = [step for step in path if step.op_type == "Transpose"]
    for step in path:
        graph.node.remove(step)
    at = list(graph.node).index(node)
    graph.node.remove(node)
    source = image
    for k, turn in enumerate(turns):
        output = node.output[0] if k == len(turns) - 1 else f"pixels_{k}"
        perm = next(attribute.ints for attribute in turn.attribute)
        graph.node.insert(
            at + k, helper.make_node("Transpose", [source], [output], f"/pixels/Transpose_{k}", perm=perm)
        )
        source = output
    drop_unread(graph)


def drop_unread(graph: onnx.GraphProto) -> None:
    """Remove constants that no node reads any more."""
    still_read = {name for node in graph.node for name in node.input}
    for tensor in [tensor for tensor in graph.initializer if tensor.name not in still_read]:
        graph.initializer.remove(tensor)


def _entry(graph: onnx.GraphProto, image: str) -> _Entry:
    before: list[onnx.NodeProto] = []
    node = reader(graph, image)
    while node.op_type in ("Cast", "Transpose", "Sub", "Div"):
        before.append(node)
        node = reader(graph, node.output[0])
    kinds = sorted(step.op_type for step in before if step.op_type in ("Sub", "Div"))
    if node.op_type != "Conv" or kinds != ["Div", "Sub"] or len(node.input) != 3:
        raise ValueError("the graph does not begin with (pixel - mean) / std and a convolution with a bias")
    return _Entry(before, node)


def reader(graph: onnx.GraphProto, tensor: str) -> onnx.NodeProto:
    """The only node that reads a tensor, not counting Shape nodes. Raises ValueError unless there is exactly one."""
    readers = [node for node in graph.node if tensor in node.input and node.op_type != "Shape"]
    if len(readers) != 1:
        raise ValueError(f"{tensor} is read by {len(readers)} nodes")
    return readers[0]


def _per_channel(constant: NDArray) -> NDArray[np.float64]:
    """The three values of a constant that is broadcast over pixels."""
    return np.asarray(constant, np.float64).reshape(3)
