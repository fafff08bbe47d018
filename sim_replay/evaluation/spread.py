"""Confidence intervals: how far a rate may be from its value over many more flights. Pure.

Frames of one flight show one aircraft against one sky and are right or wrong together, so flights are resampled, not
frames (the percentile bootstrap over clusters, Efron and Tibshirani, An Introduction to the Bootstrap, chapter 13).

If all targets of all flights are right, or none of any, every resample says the same, which is no certainty. The
interval is then the exact one of as many trials as flights, each right or wrong as a whole (Clopper and Pearson, 1934):
of 30 flights without a miss, 88.4 to 100 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from msgs.geometry import Array
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.score import Match, pose_statistics

RATES = ("recall", "rot_10deg", "depth_5pct", "pose_10deg_5pct")
DRAWS = 4000
TAILS_PERCENT = (2.5, 97.5)
# Of n flights, the lowest and the highest lie on one side of the median flight with probability 2 / 2^n: of fewer than
# these, in more than 5 of 100 cases, and the bootstrap goes no farther than they do.
FLIGHTS_LEAST = 6


def intervals_95(judged: Sequence[JudgedFrame]) -> dict[str, tuple[float, float]] | None:
    """95 % confidence interval of each rate over all targets; None for fewer than FLIGHTS_LEAST flights with a target.

    The resampling is deterministic.
    """
    by_flight: dict[tuple[str, int], list[Match]] = {}
    for frame in judged:
        if frame.matches:
            scene = frame.picture.scene
            by_flight.setdefault((str(scene.folder), scene.scene_id), []).extend(frame.matches)
    if len(by_flight) < FLIGHTS_LEAST:
        return None
    groups = [pose_statistics(0, matches, None) for matches in by_flight.values()]
    targets = np.array([float(group["targets"]) for group in groups])
    return {name: _interval(np.array([group[name] for group in groups]), targets) for name in RATES}


def _interval(rates: Array, targets: Array) -> tuple[float, float]:
    """Interval of the rate over all targets, from the rates of N flights and the number of targets of each."""
    least_if_all = round(float((TAILS_PERCENT[0] / 100) ** (1 / len(rates))), 4)
    if rates.min() == 1.0:
        return least_if_all, 1.0
    if rates.max() == 0.0:
        return 0.0, round(1.0 - least_if_all, 4)
    drawn = np.random.default_rng(0).integers(len(rates), size=(DRAWS, len(rates)))
    overall = (rates * targets)[drawn].sum(axis=1) / targets[drawn].sum(axis=1)
    low, high = np.percentile(overall, TAILS_PERCENT)
    return round(float(low), 4), round(float(high), 4)
