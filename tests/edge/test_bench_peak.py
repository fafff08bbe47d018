"""The machine's peak, by which `uavpose-edge bench` judges the network: what is multiplied, and on which threads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest

from edge.bench import peak
from edge.bench.measure import measure
from edge.bench.peak import Peak
from edge.bench.report import table, to_tree

from .test_bench import Clocks
from .toy_model import write_toy_model


@pytest.mark.parametrize(("op", "types"), [("MatMul", (1, 1, 1)), ("MatMulInteger", (2, 3, 6))])
def test_the_peak_is_of_a_valid_graph_that_multiplies(op: str, types: tuple[int, int, int]) -> None:
    kind = onnx.helper.tensor_dtype_to_np_dtype(types[1])
    weight = np.random.default_rng(2).integers(-127, 128, (300, 7)).astype(kind)
    content = peak.matmul_model(op, *types, weight)
    model = onnx.load_from_string(content)
    onnx.checker.check_model(model, full_check=True)
    left = (
        np.random.default_rng(3)
        .integers(0, 256, (peak.ROWS, 300))
        .astype(onnx.helper.tensor_dtype_to_np_dtype(types[0]))
    )
    (product,) = ort.InferenceSession(content, providers=["CPUExecutionProvider"]).run(None, {"left": left})
    np.testing.assert_allclose(product, left.astype(np.int64) @ weight.astype(np.int64), rtol=1e-5, atol=1.0)


@pytest.mark.parametrize(("precision", "kind"), [("int8", np.int32), ("fp32", np.float32)])
def test_each_precision_has_a_peak_of_its_own_over_the_products_that_are_counted(precision: str, kind: type) -> None:
    (product,) = peak.product(precision, 1)()  # type: ignore[misc]
    assert (product.dtype, product.size * peak.INNER) == (kind, peak.MACS)


def test_threads_without_cores_of_their_own_have_no_peak(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge.bench.peak.MORE_THAN_ONE", 100.0)  # no machine's two threads are so much faster
    model = write_toy_model(tmp_path / "int8.onnx", precision="int8")
    measured = measure([model], [2], spinning=False, rounds=3, others=False, on_round=lambda _: None)
    tree, told = to_tree(measured), table(measured).splitlines()
    assert [(peak["threads"], peak["shared"]) for peak in tree["peaks"]] == [(1, False), (2, True)]
    assert {row["limit_ms"] for row in tree["rows"]} == {None}
    assert tree["ratios"]["over_vnni_limit"] is None
    assert told[-1].startswith("  2 threads: ")
    assert "hardly more than one" in told[-1]


def test_as_many_threads_as_cores_have_a_peak() -> None:
    one = Peak(1, 200.0, 40.0)
    assert Peak(2, 260.0, 52.0).beside(one).limit_ms(26 * 10**7, 52 * 10**7) == pytest.approx(1.0 + 10.0)
    assert Peak(2, 390.0, 51.9).beside(one).limit_ms(10**9, 10**9) is None
    assert Peak(2, 259.9, 70.0).beside(one).limit_ms(10**9, 10**9) is None
    assert not one.beside(one).shared


def test_peaks_are_of_their_precision_and_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By clocks that products move on: of INT8 in a quarter of the time, on two threads in half of it."""
    clocks = Clocks()
    took_ms = {("int8", 1): 4, ("fp32", 1): 16, ("int8", 2): 2, ("fp32", 2): 8}
    monkeypatch.setattr("edge.bench.timing.time", clocks)
    monkeypatch.setattr("edge.bench.timing.wait_until_quiet", lambda: None)
    monkeypatch.setattr(peak, "product", lambda *case: lambda: clocks.take(took_ms[case]))
    model = write_toy_model(tmp_path / "int8.onnx", precision="int8")
    peaks = to_tree(measure([model], [2], spinning=False, rounds=3, others=False, on_round=lambda _: None))["peaks"]
    rate = peak.MACS / 1e6
    assert peaks == [
        {"threads": 1, "int8_gmac_per_s": rate / 4, "fp32_gmac_per_s": rate / 16, "shared": False},
        {"threads": 2, "int8_gmac_per_s": rate / 2, "fp32_gmac_per_s": rate / 8, "shared": False},
    ]
