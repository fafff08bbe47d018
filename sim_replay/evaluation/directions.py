"""Targets of which a tracker tells the direction alone, because their range is not known. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_replay.evaluation.judge import JudgedFrame


def directions(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"targets", "bearing_error_deg": {"mean", "median"}} over the targets without a pose but with a direction; None
    where there are none, and thus without a tracker."""
    errors = [
        seen.bearing_error_deg
        for frame in judged
        if frame.directions
        for seen, told in zip(frame.directions, frame.matches, strict=True)
        if seen.estimate is not None and told.estimate is None
    ]
    if not errors:
        return None
    mean, median = np.mean(np.array(errors, float)), np.median(np.array(errors, float))
    return {
        "targets": len(errors),
        "bearing_error_deg": {"mean": round(float(mean), 5), "median": round(float(median), 5)},
    }
