"""What a tracker makes of the estimates that it is given: its errors beside theirs, target by target. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_replay.evaluation.judge import JudgedFrame


def filtering(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"targets", "translation_error_m", "rotation_error_deg"}, the errors each {"measured", "track"}.

    They are means over the targets of which the tracker was given an estimate and told a pose in the same frame; None
    where there are none, and so without a tracker.
    """
    pairs = [
        (measured, told)
        for frame in judged
        if frame.measured
        for measured, told in zip(frame.measured, frame.matches, strict=True)
        if measured.estimate is not None and told.estimate is not None
    ]
    if not pairs:
        return None
    return {
        "targets": len(pairs),
        **{
            name: {
                whose: round(float(np.mean([getattr(pair[k], name) for pair in pairs])), 4)
                for k, whose in enumerate(("measured", "track"))
            }
            for name in ("translation_error_m", "rotation_error_deg")
        },
    }
