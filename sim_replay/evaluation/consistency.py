"""Whether predicted covariances are consistent over many flights: NEES compared with chi-square. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from msgs.geometry import Array
from sim_replay import metrics
from sim_replay.evaluation.instances import instances
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.score import Match, stacked

DEGREES_OF_FREEDOM = 3
SHARE_INSIDE = 0.95
_Scene = tuple[str, int]  # folder and number: the scenes of an imagewise dataset share a folder


def consistency(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"flights", "singular", "position", "rotation"}; None if no pose has a covariance.

    e' P^-1 e (Bar-Shalom's NEES) is averaged over the frames of each flight, one target through one scene. Frames of a
    flight share most of their error, so a flight counts as one draw of chi-square with 3 degrees of freedom: the mean
    over n consistent flights is 3, is inside `bounds_95` 95 times in 100, and 95 % of the flights are inside their own.
    A lower mean says that covariances are too wide, a higher one that they are too narrow. Rotation's is over the poses
    of known rotation, and over the flights with such a pose: None where there are none. A singular covariance, of
    position or of rotation, defines no such error: `singular` counts the poses with one, and no mean includes them.
    """
    flights = [_mean_nees(matches) for matches in _flights(judged).values()]
    if not flights:
        return None
    position, rotation, singular = np.array(flights).T
    return {
        "flights": len(flights),
        "singular": int(singular.sum()),
        "position": _judged(position[np.isfinite(position)]),
        "rotation": _judged(rotation[np.isfinite(rotation)]),
    }


def _mean_nees(matches: Sequence[Match]) -> tuple[float, float, int]:
    """Mean NEES of position and of rotation, and the number of poses left out of one or both as singular.

    NaN if no pose has such an error, or a known rotation. Each match has an estimate with covariance.
    """
    estimates = [match.estimate for match in matches if match.estimate is not None]
    R_gt, t_gt = stacked([match.truth for match in matches])
    R_est, t_est = stacked(estimates)
    covariance = np.array([estimate.covariance for estimate in estimates])
    _, position, rotation = metrics.nees(R_est, t_est, R_gt, t_gt, covariance)
    known = np.array([estimate.rotation_known for estimate in estimates], dtype=np.bool_)
    singular = np.isnan(position) | (known & np.isnan(rotation))
    return _mean(position), _mean(rotation[known]), int(singular.sum())


def _mean(values: Array) -> float:
    told = values[~np.isnan(values)]
    return float(told.mean()) if told.size else np.nan


def bounds_95(flights: int) -> tuple[float, float]:
    """Interval that contains the mean of this many draws of chi-square with 3 degrees of freedom 95 times in 100."""
    from scipy.stats import chi2  # slow to import

    tail = (1.0 - SHARE_INSIDE) / 2.0
    low, high = chi2.ppf([tail, 1.0 - tail], DEGREES_OF_FREEDOM * flights) / flights
    return float(low), float(high)


def _flights(judged: Sequence[JudgedFrame]) -> dict[tuple[_Scene, int, int], list[Match]]:
    by_scene: dict[_Scene, list[Match]] = {}
    for frame in judged:
        scene = frame.picture.scene
        by_scene.setdefault((str(scene.folder), scene.scene_id), []).extend(frame.matches)
    flights: dict[tuple[_Scene, int, int], list[Match]] = {}
    for of_scene, matches in by_scene.items():
        truths = [match.truth for match in matches]
        numbers = instances(truths, [truth.t_cam_target_m for truth in truths])
        for match, number in zip(matches, numbers, strict=True):
            if match.estimate is not None and match.estimate.covariance is not None:
                flights.setdefault((of_scene, match.truth.object_id, number), []).append(match)
    return flights


def _judged(means: Array) -> dict[str, Any] | None:
    if not means.size:
        return None
    low, high = bounds_95(1)
    return {
        "nees_mean": round(float(means.mean()), 4),
        "nees_median": round(float(np.median(means)), 4),
        "bounds_95": [round(bound, 4) for bound in bounds_95(len(means))],
        "flights_inside": round(float(np.mean((means >= low) & (means <= high))), 4),
        "flights_above": round(float(np.mean(means > high)), 4),
    }
