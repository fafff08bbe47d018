"""The errors of a tracker beside those of its input estimates, target by target. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_replay.evaluation.judge import JudgedFrame


def filtering(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"targets", "translation_error_m", "rotation_error_deg"}, the errors each {"measured", "track"}.

    They are means over the targets for which the tracker was given an estimate and returned a pose in the same frame;
    None where there are none, and thus without a tracker. For rotation, over those of known rotation.
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
        "translation_error_m": _means([(m.translation_error_m, t.translation_error_m) for m, t in pairs]),
        "rotation_error_deg": _means([(m.rotation_error_deg, t.rotation_error_deg) for m, t in pairs]),
    }


def _means(errors: Sequence[tuple[float | None, float | None]]) -> dict[str, float | None]:
    """Means of the measured and of the tracked errors, where both are known."""
    known = np.array([pair for pair in errors if None not in pair], dtype=np.float64)
    if not known.size:
        return {"measured": None, "track": None}
    measured, track = known.mean(axis=0)
    return {"measured": round(float(measured), 4), "track": round(float(track), 4)}
