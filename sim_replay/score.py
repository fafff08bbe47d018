"""From poses and ground truth to the figures of a score: association, statistics, distance bands. Pure functions.

A target that no pose was found for counts as a failure in every rate; means and medians are over found targets.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msgs.geometry import Array
from sim_replay import metrics

RANGE_BANDS_M = ((0.0, 200.0), (200.0, 300.0), (300.0, 400.0), (400.0, np.inf))


@dataclass(frozen=True, eq=False)
class TargetPose:
    """A target's pose in one frame, true or estimated, in `cam`."""

    frame: int  # index into the sequence
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]


@dataclass(frozen=True, eq=False)
class Truth(TargetPose):
    """What the sequence says of one target."""

    object_id: int  # BOP's obj_id: which airframe
    diameter_m: float  # largest distance between two points of the target


@dataclass(frozen=True, eq=False)
class Match:
    """A true target and the pose that was found for it, if any."""

    truth: Truth
    estimate: TargetPose | None

    @property
    def rotation_error_deg(self) -> float | None:
        if self.estimate is None:
            return None
        return float(metrics.rotation_error_deg(self.estimate.R_cam_target, self.truth.R_cam_target))

    @property
    def translation_error_m(self) -> float | None:
        if self.estimate is None:
            return None
        return float(metrics.translation_error_m(self.estimate.t_cam_target_m, self.truth.t_cam_target_m))


def frame_of(capture_ns: int, start_ns: int, fps: float, frames: int) -> int | None:
    """Index of the frame exposed at start_ns + k / fps nearest to `capture_ns`; None beyond half a frame."""
    position = (capture_ns - start_ns) * fps * 1e-9
    index = round(position)
    return index if 0 <= index < frames and abs(position - index) < 0.5 else None


def match_poses(truths: Sequence[Truth], estimates: Iterable[TargetPose]) -> tuple[list[Match], int]:
    """Give each truth at most one pose of its frame: pairs by growing bearing error, at most one diameter apart.

    Association looks along the ray alone, so that a wrong depth or rotation is an error and not a miss.

    Returns:
        One match for each truth, in their order, and the number of poses that belong to no target.
    """
    by_frame: dict[int, list[TargetPose]] = {}
    for estimate in estimates:
        by_frame.setdefault(estimate.frame, []).append(estimate)
    pairs = []
    for i, truth in enumerate(truths):
        gate_deg = np.rad2deg(truth.diameter_m / np.linalg.norm(truth.t_cam_target_m))
        for estimate in by_frame.get(truth.frame, []):
            bearing_deg = float(metrics.bearing_error_deg(estimate.t_cam_target_m, truth.t_cam_target_m))
            if bearing_deg <= gate_deg:
                pairs.append((bearing_deg, i, estimate))
    found: dict[int, TargetPose] = {}
    taken: set[int] = set()
    for _, i, estimate in sorted(pairs, key=lambda pair: pair[:2]):
        if i not in found and id(estimate) not in taken:
            found[i] = estimate
            taken.add(id(estimate))
    false_poses = sum(len(group) for group in by_frame.values()) - len(taken)
    return [Match(truth, found.get(i)) for i, truth in enumerate(truths)], false_poses


def pose_statistics(matches: Sequence[Match]) -> dict[str, Any]:
    """The pose figures of a score: degrees, metres and shares 0..1; None where nothing was found or asked."""
    found = [(m.truth, m.estimate) for m in matches if m.estimate is not None]
    R_gt, t_gt = _stack([truth for truth, _ in found])
    R_est, t_est = _stack([estimate for _, estimate in found])
    rotation_deg = metrics.rotation_error_deg(R_est, R_gt)
    depth_rel = metrics.depth_error_rel(t_est, t_gt)
    good = metrics.pose_10deg_5pct(R_est, t_est, R_gt, t_gt)
    return {
        "detection_rate": _share(len(found), len(matches)),
        "rotation_error_deg": _mean_median(rotation_deg),
        "rotation_below_10deg": _share(int((rotation_deg < metrics.POSE_ROTATION_DEG).sum()), len(matches)),
        "translation_error_m": _mean_median(metrics.translation_error_m(t_est, t_gt)),
        "depth_error_m": _mean_median(metrics.depth_error_m(t_est, t_gt)),
        "depth_error_rel": _mean_median(depth_rel),
        "depth_below_5pct": _share(int((depth_rel < metrics.POSE_TRANSLATION_REL).sum()), len(matches)),
        "bearing_error_deg": _mean_median(metrics.bearing_error_deg(t_est, t_gt)),
        "pose_10deg_5pct": _share(int(good.sum()), len(matches)),
    }


def statistics_by_range(matches: Sequence[Match]) -> list[dict[str, Any]]:
    """`pose_statistics` for each band of true range that holds a target."""
    ranges_m = np.array([np.linalg.norm(m.truth.t_cam_target_m) for m in matches])
    bands = []
    for low_m, high_m in RANGE_BANDS_M:
        inside = [m for m, range_m in zip(matches, ranges_m, strict=True) if low_m <= range_m < high_m]
        if inside:
            limits = [low_m, None if np.isinf(high_m) else high_m]
            bands.append({"range_m": limits, "targets": len(inside)} | pose_statistics(inside))
    return bands


def latency_statistics(latencies_ms: ArrayLike) -> dict[str, float | None]:
    """p50, p95, p99 in milliseconds; None for each if there is no sample."""
    samples = np.asarray(latencies_ms, dtype=np.float64)
    names = ("p50", "p95", "p99")
    if samples.size == 0:
        return dict.fromkeys(names)
    return {name: _rounded(value) for name, value in zip(names, np.percentile(samples, [50, 95, 99]), strict=True)}


def _stack(poses: Sequence[TargetPose]) -> tuple[Array, Array]:
    R = np.array([pose.R_cam_target for pose in poses], dtype=np.float64).reshape(-1, 3, 3)
    return R, np.array([pose.t_cam_target_m for pose in poses], dtype=np.float64).reshape(-1, 3)


def _share(part: int, whole: int) -> float | None:
    return _rounded(part / whole) if whole else None


def _mean_median(values: Array) -> dict[str, float | None]:
    if values.size == 0:
        return {"mean": None, "median": None}
    return {"mean": _rounded(values.mean()), "median": _rounded(np.median(values))}


def _rounded(value: float | np.floating[Any]) -> float:
    return round(float(value), 4)
