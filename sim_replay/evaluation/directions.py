"""Targets of which a tracker tells the direction alone, because their range is not known. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_replay.evaluation.judge import JudgedFrame


def directions(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"targets", "bearing_error_deg": {"mean", "median"}, "false"} over the targets without a pose but with a
    direction, the errors None if there are none, and the directions that belong to no target; None without any
    direction, and thus without a tracker."""
    errors = [
        seen.bearing_error_deg
        for frame in judged
        if frame.directions
        for seen, told in zip(frame.directions, frame.matches, strict=True)
        if seen.estimate is not None and told.estimate is None
    ]
    false = sum(len(frame.false_directions) for frame in judged)
    if not errors and not false:
        return None
    mean, median = (round(float(of(np.array(errors, float))), 5) if errors else None for of in (np.mean, np.median))
    return {"targets": len(errors), "bearing_error_deg": {"mean": mean, "median": median}, "false": false}
