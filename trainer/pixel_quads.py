"""The first convolution of an INT8 graph, over four pixels at a time.

ONNX Runtime gathers a kernel's pixels one by one; with only three channels that takes longer than the arithmetic. Here
four neighbouring pixels of a row are treated as one pixel of twelve channels, which is their memory layout anyway. A
convolution over those computes two output columns at once: its weights are the original ones twice, shifted by two
pixels, and zeros elsewhere. The output bytes are the same. (On a processor without 8-bit dot products ONNX Runtime's
sums may overflow, in either graph.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from trainer.image_input import reader

PIXELS = 4  # of a row, grouped together
STRIDE = 2


class WideWeights(NamedTuple):
    """Parameters of a convolution with stride (2, 1) over quads, equivalent to one with stride (2, 2) over pixels."""

    weights: NDArray[np.int8]  # [2 O, 12, rows, quads]
    quads_left: int  # of padding
    quads_right: int


def wide_weights(weights: NDArray[np.int8], pixels_left: int) -> WideWeights:
    """Converts weights [O, 3, rows, columns] of a convolution with left padding `pixels_left`.

    The first O output channels are the even columns, the last O the odd ones.
    """
    outputs, channels, rows, columns = weights.shape
    made = PIXELS // STRIDE
    first, last = -pixels_left, STRIDE * (made - 1) + columns - 1 - pixels_left  # pixels that both columns need
    quads_left, quads_right = -(first // PIXELS), last // PIXELS
    wide = np.zeros((made * outputs, PIXELS * channels, rows, quads_left + 1 + quads_right), weights.dtype)
    for k in range(made):
        for column in range(columns):
            quad, pixel = divmod(STRIDE * k + column - pixels_left, PIXELS)
            place = (slice(k * outputs, (k + 1) * outputs), slice(channels * pixel, channels * (pixel + 1)))
            wide[(*place, slice(None), quads_left + quad)] = weights[..., column]
    return WideWeights(wide, quads_left, quads_right)


def take_quads(graph: onnx.GraphProto, image: str) -> None:
    """Rewrite the first convolution of a QDQ graph, after `image_input.feed_pixels`, to read quads of pixels.

    The image width must then be a multiple of four; rows are unaffected. Raises ValueError, with the graph unchanged,
    if the convolution's output is not half the image's width or is not quantised.
    """
    turn = reader(graph, image)
    conv = reader(graph, reader(graph, turn.output[0]).output[0])
    made = {node.output[0]: node for node in graph.node}
    constants = {tensor.name: tensor for tensor in graph.initializer}
    weight, bias = (made[name] for name in conv.input[1:3])
    weights = numpy_helper.to_array(constants[weight.input[0]])
    attributes = {attribute.name: attribute for attribute in conv.attribute}
    top, left, bottom, right = attributes["pads"].ints
    columns, quantise = weights.shape[3], reader(graph, conv.output[0])
    if quantise.op_type != "QuantizeLinear":
        raise ValueError(f"{conv.name}: its output is not quantised")
    if list(attributes["strides"].ints) != [STRIDE, STRIDE] or columns - STRIDE not in (left + right, left + right - 1):
        raise ValueError(f"{conv.name}: its output has not half the picture's width")
    wide = wide_weights(weights, left)
    copies = len(wide.weights) // len(weights)
    constants[weight.input[0]].CopyFrom(numpy_helper.from_array(wide.weights, weight.input[0]))
    for name in {*weight.input[1:], *bias.input}:
        constants[name].CopyFrom(numpy_helper.from_array(np.tile(numpy_helper.to_array(constants[name]), copies), name))
    attributes["kernel_shape"].ints[:] = wide.weights.shape[2:]
    attributes["strides"].ints[:] = [STRIDE, 1]
    attributes["pads"].ints[:] = [top, wide.quads_left, bottom, wide.quads_right]

    shapes = {"quads_shape": [0, 0, -1, PIXELS * weights.shape[1]], "columns_shape": [0, 0, -1, len(weights)]}
    for name, shape in shapes.items():
        graph.initializer.append(numpy_helper.from_array(np.array(shape, np.int64), name))
    turn.input[0] = "quads"
    quads = helper.make_node("Reshape", [image, "quads_shape"], ["quads"], "/pixels/Reshape")
    graph.node.insert(list(graph.node).index(turn), quads)
    # In the channels-last output, too, the two columns are adjacent in memory.
    output, quantise.output[0] = quantise.output[0], "column_pairs"
    steps = [
        helper.make_node("Transpose", ["column_pairs"], ["pairs_last"], "/pixels/Transpose_pairs", perm=[0, 2, 3, 1]),
        helper.make_node("Reshape", ["pairs_last", "columns_shape"], ["columns_last"], "/pixels/Reshape_columns"),
        helper.make_node("Transpose", ["columns_last"], [output], "/pixels/Transpose_columns", perm=[0, 3, 1, 2]),
    ]
    at = list(graph.node).index(quantise) + 1
    for k, step in enumerate(steps):
        graph.node.insert(at + k, step)
    del graph.value_info[:]  # shapes inferred for the original graph
