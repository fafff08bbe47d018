"""Stores the float weights of a graph in half precision: the file shrinks, computation stays in float32.

A Cast converts each back; ONNX Runtime evaluates it once, on loading. Checkpoints use half precision too, so weights
lose nothing unless something was folded into them.
"""

from __future__ import annotations

import numpy as np
import onnx

STORED_LEAST = 4096  # values; fewer are not worth a node


def store_halved(graph: onnx.GraphProto) -> None:
    """Store large float32 weights as float16, each followed by a Cast; those out of float16's range are unchanged."""
    casts = []
    for tensor in graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT or int(np.prod(tensor.dims)) < STORED_LEAST:
            continue
        with np.errstate(over="ignore"):
            halved = onnx.numpy_helper.to_array(tensor).astype(np.float16)
        if not np.isfinite(halved).all():
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(halved, f"{name}_half"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], f"{name}_Cast", to=onnx.TensorProto.FLOAT))
    for k, cast in enumerate(casts):
        graph.node.insert(k, cast)
