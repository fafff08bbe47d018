"""A size that is fixed in advance changes how fast the shipped network answers, never what."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import onnxruntime as ort
import pytest

from edge.config import SHIPPED_MODEL
from edge.estimator.model import load_model
from msgs.contract import OUTPUT_NAMES


@pytest.mark.parametrize("windows", [1, 3])
def test_the_track_window_is_answered_bit_by_bit_as_by_the_plain_file(windows: int) -> None:
    model = load_model(SHIPPED_MODEL, 1)
    assert model.contract.track_size_wh is not None
    width, height = model.contract.track_size_wh
    images = np.random.default_rng(7).integers(0, 256, (windows, height, width, 3), dtype=np.uint8)
    K = np.repeat([[[900.0, 0.0, width / 2], [0.0, 900.0, height / 2], [0.0, 0.0, 1.0]]], windows, axis=0)
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    plain = ort.InferenceSession(str(SHIPPED_MODEL), options, providers=["CPUExecutionProvider"])
    expected = plain.run(list(OUTPUT_NAMES), {"image": images, "K": K.astype(np.float32)})
    for got, wanted in zip(astuple(model.run(images, K)), expected, strict=True):
        np.testing.assert_array_equal(got, wanted)
