"""Confidence intervals: how far a rate may be from its value over many more flights. Pure.

Frames of one flight show one aircraft against one sky and are right or wrong together, so flights are resampled, not
frames (the percentile bootstrap over clusters, Efron and Tibshirani, An Introduction to the Bootstrap, chapter 13).

How far a rate of nearly 1 may be off depends on the few flights with a miss, as that of a rate of nearly 0 on the few
with a hit: how many other flights are like them, and how much worse than they. A resample cannot tell: of one miss in
240 frames of 24 flights it makes 98.8 to 100 %, of none 100 to 100 %. With fewer than FLIGHTS_LEAST such flights the
interval therefore contains the exact one of as many trials as flights, each right or wrong as a whole (Clopper and
Pearson, 1934): 85.0 and 85.8 to 100 %.
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
# these, in more than 5 of 100 cases, and the bootstrap goes no farther than they do. So it is with those that have a
# miss, or a hit, if they alone make the rate differ from 1, or 0.
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
    drawn = np.random.default_rng(0).integers(len(rates), size=(DRAWS, len(rates)))
    overall = (rates * targets)[drawn].sum(axis=1) / targets[drawn].sum(axis=1)
    low, high = np.percentile(overall, TAILS_PERCENT)
    if min((rates < 1.0).sum(), (rates > 0.0).sum()) < FLIGHTS_LEAST:
        low_exact, high_exact = _exact(float(rates @ targets / targets.sum()), len(rates))
        low, high = min(low, low_exact), max(high, high_exact)
    return round(float(low), 4), round(float(high), 4)


def _exact(rate: float, trials: int) -> tuple[float, float]:
    """Clopper and Pearson's interval; the number of successes need not be whole."""
    from scipy.stats import beta  # slow to import

    tail = TAILS_PERCENT[0] / 100
    right, wrong = rate * trials, (1.0 - rate) * trials
    low = float(beta.ppf(tail, right, wrong + 1.0)) if right > 0.0 else 0.0
    high = float(beta.ppf(1.0 - tail, right + 1.0, wrong)) if wrong > 0.0 else 1.0
    return low, high
