"""Assignment of estimates to targets that is best as a whole. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.tracking import motion as ekf
from edge.tracking import rotation
from edge.tracking.motion import Innovation, Motion
from edge.tracking.rotation import Attitude
from edge.tracking.view import View
from edge.types import Array, Estimate

POSITION_GATE_D2 = 49.0  # squared Mahalanobis distance, 3 degrees of freedom; wide, as motion.py has a soft gate inside
ROTATION_D2_MAX = 9.0  # limit of a rotation's cost: the network may be wrong, and aircraft roll


class Pair(NamedTuple):
    """A target and the estimate assigned to it, by their indices in the arguments."""

    target: int
    estimate: int
    seen: Innovation
    left_out: list[int]  # targets without an estimate that this one fits too


def associate(
    targets: Sequence[tuple[Motion, Attitude]], estimates: Sequence[Estimate], K: Array, view: View
) -> list[Pair]:
    """Pairs inside the gate, each target and estimate at most once: as many pairs as possible, at least total distance.

    If a target or an estimate has several candidates, rotation counts too: crossing aircraft differ in it.
    """
    seen: dict[tuple[int, int], Innovation] = {}
    cost = np.full((len(targets), len(estimates)), np.inf)
    for i, (motion, _) in enumerate(targets):
        for j, estimate in enumerate(estimates):
            one = ekf.innovation(motion, estimate, K, view)
            d2 = distance_d2(one, estimate)
            if d2 < POSITION_GATE_D2:
                seen[i, j], cost[i, j] = one, d2
    contested = np.isfinite(cost)
    for i, j in seen:
        if contested[i].sum() > 1 or contested[:, j].sum() > 1:
            d2 = rotation.disagreement_d2(targets[i][1], estimates[j], view)
            cost[i, j] += min(d2, ROTATION_D2_MAX)
    best = best_pairs(cost)
    idle = set(range(len(targets))) - {i for i, _ in best}
    return [Pair(i, j, seen[i, j], sorted(k for k in idle if (k, j) in seen)) for i, j in best]


def distance_d2(seen: Innovation, estimate: Estimate) -> float:
    """Squared Mahalanobis distance, 3 degrees of freedom, of an estimate to a target, with the network's own variances.

    The larger of two: by log range, which is how measurements err, and in metres, which is how predictions do. By log
    range alone, a target predicted to be near, give or take a good part of that range, would fit any other beyond it.
    """
    ray = seen.predicted_m
    predicted = seen.predicted_covariance + seen.attitude
    measured = seen.across + seen.log_range_variance * np.outer(ray, ray)
    apart_m = estimate.t_cam_target_m - ray
    farther = max(float(np.linalg.norm(estimate.t_cam_target_m) / np.linalg.norm(ray)), 1.0)
    in_metres = apart_m @ np.linalg.solve(predicted + farther**2 * measured, apart_m)
    return max(float(seen.residual_m @ np.linalg.solve(predicted + measured, seen.residual_m)), float(in_metres))


def best_pairs(cost: Array) -> list[tuple[int, int]]:
    """The assignment with the most pairs, and of those the least total cost; infinite cost: not a possible pair.

    Takes uncontested pairs first, then tries all combinations, which is fast for a few targets.
    """
    possible = np.isfinite(cost)
    choices, rivals = possible.sum(axis=1), possible.sum(axis=0)
    alone = [(int(i), int(j)) for i, j in np.argwhere(possible) if choices[i] == 1 and rivals[j] == 1]
    settled = {i for i, _ in alone}
    if len(settled) == np.count_nonzero(choices):
        return alone
    rows = [i for i in range(len(cost)) if choices[i] and i not in settled]
    _, _, rest = _best(cost, rows, frozenset())
    return sorted([*alone, *rest])


def _best(cost: Array, rows: list[int], taken: frozenset[int]) -> tuple[int, float, list[tuple[int, int]]]:
    """(minus the number of pairs, their cost, the pairs) of the best assignment of `rows` with columns `taken`."""
    if not rows:
        return 0, 0.0, []
    i, others = rows[0], rows[1:]
    ways = [_best(cost, others, taken)]
    for j in np.flatnonzero(np.isfinite(cost[i])):
        if int(j) not in taken:
            count, price, pairs = _best(cost, others, taken | {int(j)})
            ways.append((count - 1, price + float(cost[i, j]), [(i, int(j)), *pairs]))
    return min(ways, key=lambda way: way[:2])
