"""Statistics of one peer's data of a flight: errors, covariance consistency, age, continuity, tracks. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from msgs.geometry import R_FORWARD_CAM, Array, euler_from_R
from sim_replay import metrics
from sim_replay.report.continuity import continuity, follows
from sim_replay.score import Match, TargetPose, stacked, statistics

COORDINATES = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
# 95 % quantiles of chi-square, by degrees of freedom (any table of its quantiles).
CHI2_95 = {3: 7.815, 6: 12.592}


def peer_figures(
    frames: int,
    fps: float,
    matches: Sequence[Match],
    false_poses: Sequence[TargetPose],
    ages: Sequence[tuple[int, float]],
    unrecorded: Collection[int] = (),
    also_occupied: Collection[int] = (),
) -> dict[str, Any]:
    """JSON's types: shares 0..1, degrees, metres, milliseconds, seconds; None where there is no data.

    Args:
        frames: Number of frames of the sequence.
        matches: Of every visible target of every frame.
        false_poses: Those of a frame that belong to no target.
        ages: Of each pose in the order of arrival: its frame, and ms from exposure to arrival.
        unrecorded: Frames without an image.
        also_occupied: As in `sim_replay.score.statistics`.
    """
    return {
        **statistics(frames, matches, false_poses, also_occupied),
        "rmse": rmse(matches),
        "range_error_m": range_error_m(matches),
        "nees": nees(matches),
        "age_ms": percentiles([age_ms for _, age_ms in ages]),
        "longest_silence_s": longest_silence_s(matches, ages, fps, unrecorded),
        "continuity": continuity(matches, fps, unrecorded),
        "tracks": tracks(matches, false_poses),
    }


def coordinates(poses: Sequence[TargetPose]) -> Array:
    """[N, 6] of poses: x, y, z in `cam`, metres; roll, pitch, yaw against the camera's axes, degrees.

    Roll, pitch and yaw are zero for a target that flies straight away from the camera, wings along the rows; NaN if the
    rotation is unknown.
    """
    R, t_m = stacked(poses)
    angles = np.rad2deg(np.column_stack(euler_from_R(R_FORWARD_CAM @ R)))
    angles[[not pose.rotation_known for pose in poses]] = np.nan
    return np.column_stack([t_m, angles])


def coordinate_errors(found: Sequence[tuple[TargetPose, TargetPose]]) -> Array:
    """[N, 6]: estimate minus truth of pairs (truth, estimate), ordered as in `coordinates`; angles within ±180°."""
    error = coordinates([estimate for _, estimate in found]) - coordinates([truth for truth, _ in found])
    error[:, 3:] = (error[:, 3:] + 180.0) % 360.0 - 180.0
    return error


def pairs(matches: Sequence[Match]) -> list[tuple[TargetPose, TargetPose]]:
    """(truth, estimate) of all targets that were found."""
    return [(match.truth, match.estimate) for match in matches if match.estimate is not None]


def rmse(matches: Sequence[Match]) -> dict[str, float | None]:
    """Root of the mean square error of each of COORDINATES (paper, its figures of a sequence); None without any."""
    values = [root_mean_square(column) for column in coordinate_errors(pairs(matches)).T]
    told = [None if value is None else round(value, 4) for value in values]
    return dict(zip(COORDINATES, told, strict=True))


def root_mean_square(errors: Array) -> float | None:
    """Over the values that are not NaN; None if there are none."""
    known = errors[np.isfinite(errors)]
    return float(np.sqrt((known**2).mean())) if known.size else None


def range_error_m(matches: Sequence[Match]) -> dict[str, float | None]:
    """Estimated minus true range: its mean (a bias) and root mean square, metres, and the mean as a share."""
    found = pairs(matches)
    if not found:
        return {"mean": None, "rms": None, "mean_rel": None}
    _, t_gt = stacked([truth for truth, _ in found])
    _, t_est = stacked([estimate for _, estimate in found])
    range_m = np.linalg.norm(t_gt, axis=1)
    error = np.linalg.norm(t_est, axis=1) - range_m
    values = {"mean": error.mean(), "rms": np.sqrt((error**2).mean()), "mean_rel": (error / range_m).mean()}
    return {name: round(float(value), 6) for name, value in values.items()}


def nees(matches: Sequence[Match]) -> dict[str, dict[str, float] | None] | None:
    """Normalised estimation error squared, e' P^-1 e (Bar-Shalom), of the pose and of its two halves.

    For a consistent covariance the mean is the degrees of freedom and 95 % lie below their chi-square quantile. Errors
    of neighbouring frames are correlated, so the mean of one flight scatters more than its count suggests. Position is
    over all poses, pose and rotation over those of known rotation. None: no covariances, or no such pose. `singular`
    counts those that are left out because their covariance is singular.
    """
    sure = [(truth, estimate) for truth, estimate in pairs(matches) if estimate.covariance is not None]
    if not sure:
        return None
    R_gt, t_gt = stacked([truth for truth, _ in sure])
    R_est, t_est = stacked([estimate for _, estimate in sure])
    covariance = np.array([estimate.covariance for _, estimate in sure])
    turned = np.array([estimate.rotation_known for _, estimate in sure], dtype=np.bool_)
    pose, position, rotation = metrics.nees(R_est, t_est, R_gt, t_gt, covariance)
    return {
        "pose": _honesty(pose[turned], 6),
        "position": _honesty(position, 3),
        "rotation": _honesty(rotation[turned], 3),
    }


def _honesty(told: Array, dof: int) -> dict[str, float] | None:
    nees = told[~np.isnan(told)]
    if nees.size == 0:
        return None
    return {
        "mean": round(float(nees.mean()), 4),
        "median": round(float(np.median(nees)), 4),
        "degrees_of_freedom": dof,
        "within_95pct": round(float((nees <= CHI2_95[dof]).mean()), 6),
        "singular": len(told) - len(nees),
    }


def percentiles(values_ms: Sequence[float]) -> dict[str, float | None]:
    """p50, p95, p99 and the maximum."""
    if not values_ms:
        return dict.fromkeys(("p50", "p95", "p99", "max"))
    found = np.percentile(values_ms, [50, 95, 99, 100])
    return {name: round(float(v), 3) for name, v in zip(("p50", "p95", "p99", "max"), found, strict=True)}


def longest_silence_s(
    matches: Sequence[Match], ages: Sequence[tuple[int, float]], fps: float, unrecorded: Collection[int] = ()
) -> float | None:
    """The longest time without a pose of a target while one was visible, from the first on; None: there was no such
    pose."""
    found = {match.truth.frame for match in matches if match.estimate is not None}
    arrivals = sorted(frame / fps + age_ms * 1e-3 for frame, age_ms in ages if frame in found)
    if not arrivals:
        return None
    frames = np.unique([match.truth.frame for match in matches])
    gone = [not follows(int(before), int(after), unrecorded) for before, after in pairwise(frames)]
    spans = np.split(frames, np.flatnonzero(gone) + 1) if len(frames) else []
    views_s = [(span[0] / fps, (span[-1] + 1) / fps) for span in spans]
    bounds = [*arrivals, max([arrivals[-1], *(stop for _, stop in views_s)])]
    silences = [min(after, stop) - max(before, start) for before, after in pairwise(bounds) for start, stop in views_s]
    return round(float(max([0.0, *silences])), 4)  # below 0 where the view ended before the first pose arrived


def tracks(matches: Sequence[Match], false_poses: Sequence[TargetPose]) -> dict[str, dict[str, Any]]:
    """Each track by the daemon's name for it: its lifetime, the target that it followed, and its errors."""
    found: dict[str, list[Match]] = {}
    for match in matches:
        if match.estimate is not None:
            found.setdefault(match.estimate.track, []).append(match)
    false: dict[str, int] = {}
    for pose in false_poses:
        false[pose.track] = false.get(pose.track, 0) + 1
    return {name: _track(found.get(name, []), false.get(name, 0)) for name in sorted({*found, *false})}


def _track(followed: Sequence[Match], false_poses: int) -> dict[str, Any]:
    frames = [match.truth.frame for match in followed]
    R_gt, t_gt = stacked([truth for truth, _ in pairs(followed)])
    R_est, t_est = stacked([estimate for _, estimate in pairs(followed)])
    turned = np.array([estimate.rotation_known for _, estimate in pairs(followed)], dtype=np.bool_)
    errors = {
        "rotation_error_deg": metrics.rotation_error_deg(R_est, R_gt)[turned],
        "translation_error_m": metrics.translation_error_m(t_est, t_gt),
        "bearing_error_deg": metrics.bearing_error_deg(t_est, t_gt),
    }
    return {
        "poses": len(followed) + false_poses,
        "false_poses": false_poses,
        "first_frame": min(frames, default=None),
        "last_frame": max(frames, default=None),
        "targets": sorted({match.truth.airframe_label for match in followed}),
        **{name: round(float(values.mean()), 4) if values.size else None for name, values in errors.items()},
        "range_error_m": range_error_m(followed)["mean"],
    }
