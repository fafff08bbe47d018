"""Errors against covariances in which place and rotation hang together."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_replay import metrics


@pytest.mark.parametrize(("shift_m", "expected"), [(1.0, 2.0 / 1.9), (-1.0, 2.0 / 0.1)])
def test_errors_that_go_together_as_told_are_small_and_those_that_do_not_are_large(
    shift_m: float, expected: float
) -> None:
    """By hand: e' P^-1 e with variances 1, correlation 0.9 and e = (+-1, 1)."""
    P = np.eye(6)
    P[0, 3] = P[3, 0] = 0.9
    turned = Rotation.from_rotvec([1.0, 0.0, 0.0]).as_matrix()
    whole, position, rotation = metrics.nees(np.eye(3), np.zeros(3), turned, np.array([shift_m, 0.0, 0.0]), P)
    assert float(whole) == pytest.approx(expected)
    assert (float(position), float(rotation)) == pytest.approx((1.0, 1.0))
