"""A size that is fixed in advance, and threads with windows of their own, change how fast the shipped network answers,
never what."""

from __future__ import annotations

import threading
from dataclasses import astuple

import numpy as np
import onnxruntime as ort
import pytest

from edge.config import SHIPPED_MODEL
from edge.estimator.model import load_model
from msgs.contract import OUTPUT_NAMES


@pytest.mark.parametrize(
    ("windows", "threads", "shared_out"),
    [(1, 1, 0), (3, 1, 0), (1, 2, 0), (2, 2, 2), (5, 2, 2), (4, 3, 0), (3, 4, 3), (4, 4, 4)],
)
def test_track_windows_are_answered_bit_by_bit_as_by_the_plain_file(
    windows: int, threads: int, shared_out: int
) -> None:
    before = set(threading.enumerate())
    model = load_model(SHIPPED_MODEL, threads)
    assert model.contract.track_size_wh is not None
    width, height = model.contract.track_size_wh
    images = np.random.default_rng(7).integers(0, 256, (windows, height, width, 3), dtype=np.uint8)
    K = np.repeat([[[900.0, 0.0, width / 2], [0.0, 900.0, height / 2], [0.0, 0.0, 1.0]]], windows, axis=0)
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1 if shared_out else threads
    plain = ort.InferenceSession(str(SHIPPED_MODEL), options, providers=["CPUExecutionProvider"])
    expected = plain.run(list(OUTPUT_NAMES), {"image": images, "K": K.astype(np.float32)})
    for got, wanted in zip(astuple(model.run(images, K)), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
    beside = [thread.name for thread in threading.enumerate() if thread not in before]
    assert len(beside) == max(shared_out - 1, 0)
