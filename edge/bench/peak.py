"""The machine's peak rate of multiplication: one large matrix product, INT8 and FP32, in ONNX Runtime.

The two one-node graphs are serialised here by hand (protobuf fields of onnx.proto), as nothing else in the daemon needs
the `onnx` package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from edge.estimator.model import session_options

ROWS, INNER, COLUMNS = 512, 1024, 1024
MACS = ROWS * INNER * COLUMNS
MORE_THAN_ONE = 1.3
_FLOAT, _UINT8, _INT8, _INT32 = 1, 2, 3, 6  # onnx.TensorProto.DataType
_IR_VERSION, _OPSET = 8, 17


@dataclass(frozen=True)
class Peak:
    """10^9 multiply-accumulates a second on the given number of threads."""

    threads: int
    int8_gmac_per_s: float
    fp32_gmac_per_s: float
    shared: bool = False  # several threads are hardly faster than one: it is no peak of so many

    def beside(self, one: Peak) -> Peak:
        """The same, with `shared` by the peak of one thread."""
        rates = (self.int8_gmac_per_s, one.int8_gmac_per_s), (self.fp32_gmac_per_s, one.fp32_gmac_per_s)
        return replace(self, shared=self.threads > 1 and any(own < MORE_THAN_ONE * single for own, single in rates))

    def limit_ms(self, int8_macs: int, float_macs: int) -> float | None:
        """Least time for these MACs, one after the other at the peak rate; None: the peak is shared."""
        if self.shared:
            return None
        return int8_macs / self.int8_gmac_per_s / 1e6 + float_macs / self.fp32_gmac_per_s / 1e6


def product(precision: str, threads: int) -> Callable[[], object]:
    """A call that multiplies once, `int8` (unsigned by signed, like the network's layers) or `fp32`.

    Its threads spin between calls. A thread that sleeps is often woken on the core that the first one uses, and moved
    to one of its own only after longer than a product takes: the rate would be that of one thread.
    """
    rng = np.random.default_rng(0)
    left: NDArray[np.generic]
    if precision == "int8":
        left = rng.integers(0, 256, (ROWS, INNER), dtype=np.uint8)
        graph = matmul_model("MatMulInteger", _UINT8, _INT8, _INT32, rng.integers(-127, 128, (INNER, COLUMNS), np.int8))
    else:
        left = rng.standard_normal((ROWS, INNER), dtype=np.float32)
        graph = matmul_model("MatMul", _FLOAT, _FLOAT, _FLOAT, rng.standard_normal((INNER, COLUMNS), np.float32))
    options = session_options(threads, spinning=True)
    session = ort.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, {"left": left})


def matmul_model(op: str, left: int, right: int, out: int, weight: NDArray[np.generic]) -> bytes:
    """An ONNX file: `product` [M, N] = `op`(`left` [M, K], weight [K, N]); element types by onnx's numbers."""
    tensor = _int(1, weight.shape[0]) + _int(1, weight.shape[1]) + _int(2, right)
    tensor += _text(8, "weight") + _bytes(9, weight.tobytes())
    node = _text(1, "left") + _text(1, "weight") + _text(2, "product") + _text(4, op)
    graph = _bytes(1, node) + _text(2, "peak") + _bytes(5, tensor)
    graph += _bytes(11, _value("left", left, (ROWS, weight.shape[0])))
    graph += _bytes(12, _value("product", out, (ROWS, weight.shape[1])))
    return _int(1, _IR_VERSION) + _bytes(7, graph) + _bytes(8, _int(2, _OPSET))


def _value(name: str, kind: int, shape: tuple[int, ...]) -> bytes:
    dims = b"".join(_bytes(1, _int(1, side)) for side in shape)
    return _text(1, name) + _bytes(2, _bytes(1, _int(1, kind) + _bytes(2, dims)))


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _int(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _bytes(field, text.encode())
