"""Whether told covariances are honest over many flights: the normalised error squared against chi-square. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_replay import metrics
from sim_replay.evaluation.instances import instances
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.score import Match, stacked

DEGREES_OF_FREEDOM = 3
SHARE_INSIDE = 0.95


def consistency(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """{"flights", "position", "rotation"}; None where no pose has a covariance, rotation None where none is known.

    e' P^-1 e (Bar-Shalom's NEES) is averaged over the frames of each flight, one target through one scene. Frames of a
    flight share most of their error, so a flight counts as one draw of chi-square with 3 degrees of freedom: the mean
    over n honest flights is 3 and lies inside `bounds_95` 95 times in 100, and 95 % of them lie inside their own.
    A mean below says that covariances are too wide, one above that they are too narrow. Rotation's is over the poses
    that tell one, and over the flights that have such a pose.
    """
    flights = [_mean_nees(matches) for matches in _flights(judged).values()]
    if not flights:
        return None
    position, rotation = np.array(flights).T
    turned = rotation[np.isfinite(rotation)]
    return {
        "flights": len(flights),
        "position": _judged(position),
        "rotation": _judged(turned) if turned.size else None,
    }


def _mean_nees(matches: Sequence[Match]) -> tuple[float, float]:
    """Mean of position's and of rotation's normalised error squared, the latter NaN where no pose tells a rotation.

    Each match has an estimate with covariance.
    """
    estimates = [match.estimate for match in matches if match.estimate is not None]
    R_gt, t_gt = stacked([match.truth for match in matches])
    R_est, t_est = stacked(estimates)
    covariance = np.array([estimate.covariance for estimate in estimates])
    _, position, rotation = metrics.nees(R_est, t_est, R_gt, t_gt, covariance)
    turned = rotation[[estimate.rotation_known for estimate in estimates]]
    return float(position.mean()), float(turned.mean()) if turned.size else np.nan


def bounds_95(flights: int) -> tuple[float, float]:
    """Between which the mean of so many draws of chi-square with 3 degrees of freedom lies 95 times in 100."""
    from scipy.stats import chi2  # takes its time

    tail = (1.0 - SHARE_INSIDE) / 2.0
    low, high = chi2.ppf([tail, 1.0 - tail], DEGREES_OF_FREEDOM * flights) / flights
    return float(low), float(high)


def _flights(judged: Sequence[JudgedFrame]) -> dict[tuple[str, int, int], list[Match]]:
    by_scene: dict[str, list[Match]] = {}
    for frame in judged:
        by_scene.setdefault(str(frame.picture.scene.folder), []).extend(frame.matches)
    flights: dict[tuple[str, int, int], list[Match]] = {}
    for scene, matches in by_scene.items():
        truths = [match.truth for match in matches]
        numbers = instances(truths, [truth.t_cam_target_m for truth in truths])
        for match, number in zip(matches, numbers, strict=True):
            if match.estimate is not None and match.estimate.covariance is not None:
                flights.setdefault((scene, match.truth.object_id, number), []).append(match)
    return flights


def _judged(means: np.ndarray) -> dict[str, Any]:
    low, high = bounds_95(1)
    return {
        "nees_mean": round(float(means.mean()), 4),
        "nees_median": round(float(np.median(means)), 4),
        "bounds_95": [round(bound, 4) for bound in bounds_95(len(means))],
        "flights_inside": round(float(np.mean((means >= low) & (means <= high))), 4),
        "flights_above": round(float(np.mean(means > high)), 4),
    }
