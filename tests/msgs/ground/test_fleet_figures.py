"""What a row says of a target is what its poses hold."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from msgs import cdr
from msgs.ground.fleet import closing_mps, target_row
from msgs.receive import TargetPose

NOW_NS = 1_700_000_000_000_000_000


def test_how_sure_a_range_is_is_told_along_the_sight_line() -> None:
    """Seen far off the axis: 0.3 m about the place, and 5 % of the range."""
    t_m = np.array([120.0, -60.0, 200.0])
    covariance = np.eye(6)
    covariance[:3, :3] = 0.09 * np.eye(3) + np.outer(0.05 * t_m, 0.05 * t_m)
    message = cdr.PoseWithCovarianceStamped(
        NOW_NS, "camera_optical_frame", t_m, np.array([0.0, 0.0, 0.0, 1.0]), covariance
    )
    row = target_row(TargetPose("uav1", "t0", message, 1, NOW_NS), None, None, None)
    assert row.range_m == pytest.approx(np.linalg.norm(t_m))
    assert row.sigma_range_m == pytest.approx(math.hypot(0.3, 0.05 * row.range_m))


@pytest.mark.parametrize(("span_s", "expected"), [(0.3, None), (0.6, pytest.approx(20.0))])
def test_how_fast_a_target_nears_is_not_told_of_too_short_a_time(span_s: float, expected: object) -> None:
    ranges = deque((NOW_NS + round(t_s * 1e9), 300.0 - 20.0 * t_s) for t_s in np.linspace(0.0, span_s, 10))
    assert closing_mps(ranges) == expected
