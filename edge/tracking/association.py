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
# In `cam` any place is plausible soon, as the camera may have turned: a target missed for this long is taken up again
# only within this many times its apparent size. What is seen farther off may be another aircraft.
OUT_OF_SIGHT_NS = 250_000_000
SIZES_OFF_MAX = 5.0
# A target seen that recently, or in the frame before, is predicted as well as can be, whatever the camera does.
FRESH_NS = 150_000_000
ROTATION_D2_MAX = 9.0  # limit of a rotation's cost: the network may be wrong, and aircraft roll


class Pair(NamedTuple):
    """A target and the estimate assigned to it, by their indices in the arguments."""

    target: int
    estimate: int
    seen: Innovation
    left_out: list[int]  # targets without an estimate that this one fits too


def associate(
    targets: Sequence[tuple[Motion, Attitude, int]], estimates: Sequence[Estimate], K: Array, view: View
) -> list[Pair]:
    """Pairs inside the gate, each target and estimate at most once: as many pairs as possible, at least total distance.

    `targets`: each with the number of frames in which it was missed since it was seen. If a target or an estimate has
    several candidates, rotation counts too: crossing aircraft differ in it. An estimate that fits a target seen just
    now goes to the likeliest: by distance alone, one long missed, which fits everywhere, would take the detections of
    its neighbour.
    """
    seen: dict[tuple[int, int], Innovation] = {}
    cost = np.full((len(targets), len(estimates)), np.inf)
    for i, (motion, _, misses) in enumerate(targets):
        for j, estimate in enumerate(estimates):
            one = ekf.innovation(motion, estimate, K, view)
            d2 = distance_d2(one, estimate)
            elsewhere = out_of_sight(motion, misses, view) and _elsewhere(estimate, one.predicted_m, K)
            if d2 < POSITION_GATE_D2 and not elsewhere:
                seen[i, j], cost[i, j] = one, d2
    contested = np.isfinite(cost)
    fresh = np.array([misses == 0 or view.time_ns - motion.seen_ns <= FRESH_NS for motion, _, misses in targets], bool)
    for (i, j), one in seen.items():
        if contested[i].sum() > 1 or contested[:, j].sum() > 1:
            d2 = rotation.disagreement_d2(targets[i][1], estimates[j], view)
            cost[i, j] += min(d2, ROTATION_D2_MAX)
            if np.any(contested[:, j] & fresh):
                cost[i, j] += float(np.linalg.slogdet(sum(_covariances(one)))[1])
    best = best_pairs(cost)
    idle = set(range(len(targets))) - {i for i, _ in best}
    return [Pair(i, j, seen[i, j], sorted(k for k in idle if (k, j) in seen)) for i, j in best]


def distance_d2(seen: Innovation, estimate: Estimate) -> float:
    """Squared Mahalanobis distance, 3 degrees of freedom, of an estimate to a target, with the network's own variances.

    The larger of two: by log range, which is how measurements err, and in metres, which is how predictions do. By log
    range alone, a target predicted to be near, give or take a good part of that range, would fit any other beyond it.
    """
    ray = seen.predicted_m
    predicted, measured = _covariances(seen)
    apart_m = estimate.t_cam_target_m - ray
    farther = max(float(np.linalg.norm(estimate.t_cam_target_m) / np.linalg.norm(ray)), 1.0)
    in_metres = apart_m @ np.linalg.solve(predicted + farther**2 * measured, apart_m)
    return max(float(seen.residual_m @ np.linalg.solve(predicted + measured, seen.residual_m)), float(in_metres))


def out_of_sight(motion: Motion, misses: int, view: View) -> bool:
    """Whether a target was missed for so long that it could be anywhere; `view` is in the motion's frame.

    After a gap in the frames, what is seen is most probably what was seen before.
    """
    return motion.kind == "cam" and misses > 0 and view.time_ns - motion.seen_ns >= OUT_OF_SIGHT_NS


def _elsewhere(estimate: Estimate, predicted_m: Array, K: Array) -> bool:
    size_rad = float(np.linalg.norm(estimate.box_xyxy_px[2:] - estimate.box_xyxy_px[:2])) / K[0, 0]
    cosine = rotation.unit(predicted_m) @ rotation.unit(estimate.t_cam_target_m)
    return bool(np.arccos(np.clip(cosine, -1.0, 1.0)) > SIZES_OFF_MAX * size_rad)


def _covariances(seen: Innovation) -> tuple[Array, Array]:
    """Of the predicted and of the measured position, [3, 3] each."""
    ray = seen.predicted_m
    return seen.predicted_covariance + seen.attitude, seen.across + seen.log_range_variance * np.outer(ray, ray)


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
