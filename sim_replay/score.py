"""Computes a score from poses and ground truth: association, statistics, distance bands. Pure functions.

A target without a pose counts as a failure in every rate; means and medians are over the targets that were found. A
pose of unknown rotation counts as a failure in the rates that require a rotation, and in no rotation error statistic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msgs.geometry import Array
from sim_replay import metrics

RANGE_BANDS_M = ((100.0, 200.0), (200.0, 300.0), (300.0, 400.0), (400.0, 500.0))  # the paper's
_RANGE_DIGITS = 5  # of metres: the norm of a translation written in millimetres is no more exact
ADD_FRACTIONS = {"add_0_5d": 0.5, "add_0_1d": 0.1}


@dataclass(frozen=True, eq=False)
class TargetPose:
    """A target's pose in one frame, true or estimated, in `cam`; an estimate may have a covariance."""

    frame: int  # index into the sequence
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]
    score: float | None = field(default=None, kw_only=True)
    covariance: Array | None = field(default=None, kw_only=True)  # [6, 6], as in edge.types.Estimate
    track: str = field(default="", kw_only=True)  # the sender's name of the target; empty: none
    rotation_known: bool = field(default=True, kw_only=True)  # False: R_cam_target is only a placeholder


@dataclass(frozen=True, eq=False)
class Truth(TargetPose):
    """Ground truth of one target."""

    object_id: int  # BOP's obj_id: which airframe
    diameter_m: float  # largest distance between two points of the target
    airframe: str = ""  # its name; empty: not in the dataset
    points_body_m: Array | None = None  # [P, 3] model points for ADD, where the dataset has a model
    instance: int = field(default=0, kw_only=True)  # distinguishes several targets of the same object
    visible: bool = field(default=True, kw_only=True)  # False: not visible according to the dataset
    occluded: bool = field(default=False, kw_only=True)  # True: not visible, as it is entirely behind something
    wanted: bool = field(default=True, kw_only=True)  # False: present, but not to be estimated according to the dataset

    @property
    def target(self) -> tuple[int, int]:
        """Which of the sequence's targets it is, the same in every frame."""
        return self.object_id, self.instance

    @property
    def airframe_label(self) -> str:
        """The airframe's name, otherwise one made from its number in BOP's files."""
        return self.airframe or f"obj_{self.object_id:06d}"


@dataclass(frozen=True, eq=False)
class Match:
    """A true target and the pose matched to it, if any."""

    truth: Truth
    estimate: TargetPose | None

    @property
    def rotation_error_deg(self) -> float | None:
        if self.estimate is None or not self.estimate.rotation_known:
            return None
        return float(metrics.rotation_error_deg(self.estimate.R_cam_target, self.truth.R_cam_target))

    @property
    def translation_error_m(self) -> float | None:
        if self.estimate is None:
            return None
        return float(metrics.translation_error_m(self.estimate.t_cam_target_m, self.truth.t_cam_target_m))

    @property
    def bearing_error_deg(self) -> float | None:
        if self.estimate is None:
            return None
        return float(metrics.bearing_error_deg(self.estimate.t_cam_target_m, self.truth.t_cam_target_m))

    @cached_property
    def add_m(self) -> float | None:
        """ADD; None if nothing was found, or the rotation or the target's model is unknown."""
        if self.estimate is None or not self.estimate.rotation_known or self.truth.points_body_m is None:
            return None
        est, gt = self.estimate, self.truth
        points = self.truth.points_body_m
        return float(metrics.add_m(est.R_cam_target, est.t_cam_target_m, gt.R_cam_target, gt.t_cam_target_m, points))


def frame_of(capture_ns: int, start_ns: int, fps: float, frames: int) -> int | None:
    """Index of the frame exposed at start_ns + k / fps nearest to `capture_ns`; None beyond half a frame of all."""
    index = round((capture_ns - start_ns) * fps * 1e-9)
    return index if 0 <= index < frames else None


def match_poses(truths: Sequence[Truth], estimates: Iterable[TargetPose]) -> tuple[list[Match], list[TargetPose]]:
    """Match each truth to at most one pose of its frame: pairs by increasing bearing error, at most one diameter apart.

    Visible truths are matched first: a pose of a hidden target can only be a coincidence or a prediction.

    Association uses the bearing alone, so that a wrong depth or rotation counts as an error and not as a miss. A pose
    nearer than half a diameter is never matched: the target would contain the camera, so its bearing means nothing.

    Returns:
        One match for each truth, in their order, and the poses that belong to no target.
    """
    by_frame: dict[int, list[TargetPose]] = {}
    for estimate in estimates:
        by_frame.setdefault(estimate.frame, []).append(estimate)
    pairs = []
    for i, truth in enumerate(truths):
        range_m = float(np.linalg.norm(truth.t_cam_target_m))
        if not truth.visible and range_m < 0.5 * truth.diameter_m:
            continue  # it would take every pose: some datasets list what is not there at the origin
        gate_deg = np.rad2deg(truth.diameter_m / range_m)
        for estimate in by_frame.get(truth.frame, []):
            bearing_deg = float(metrics.bearing_error_deg(estimate.t_cam_target_m, truth.t_cam_target_m))
            has_direction = np.linalg.norm(estimate.t_cam_target_m) >= 0.5 * truth.diameter_m
            if has_direction and bearing_deg <= gate_deg:
                pairs.append((not truth.visible, bearing_deg, i, estimate))
    found: dict[int, TargetPose] = {}
    taken: set[int] = set()
    for _, _, i, estimate in sorted(pairs, key=lambda pair: pair[:3]):
        if i not in found and id(estimate) not in taken:
            found[i] = estimate
            taken.add(id(estimate))
    false_poses = [pose for group in by_frame.values() for pose in group if id(pose) not in taken]
    return [Match(truth, found.get(i)) for i, truth in enumerate(truths)], false_poses


def statistics(
    frames: int, matches: Sequence[Match], false_poses: Sequence[TargetPose] = (), also_occupied: Iterable[int] = ()
) -> dict[str, Any]:
    """All figures of a score: {"overall", "by_range", "by_airframe"}, each in the form of `pose_statistics`.

    `frames` is their number; matches and poses refer to frames by index 0..frames-1. `also_occupied` are the indices of
    frames that show an aircraft which is not to be estimated. A range band counts the frames with a target in it, and
    the false positives whose own range lies in it; an airframe has no false positives.
    """
    with_target = {match.truth.frame for match in matches}.union(also_occupied)
    in_empty = [pose for pose in false_poses if pose.frame not in with_target]
    empty = frames - len(with_target)
    false_rate = lambda poses: _told(metrics.false_positives_per_1000(len(poses), empty))  # noqa: E731
    overall = pose_statistics(frames, matches, false_rate(in_empty))
    overall["false_poses"] = len(false_poses)
    by_range = {}
    for band, inside in _bands(matches, lambda match: match.truth).items():
        strays = _bands(in_empty, lambda pose: pose).get(band, [])
        by_range[band] = pose_statistics(_frames_of(inside), inside, false_rate(strays))
    by_airframe = {}
    for name in sorted({match.truth.airframe_label for match in matches}):
        inside = [match for match in matches if match.truth.airframe_label == name]
        by_airframe[name] = pose_statistics(_frames_of(inside), inside, None)
    return {"overall": overall, "by_range": by_range, "by_airframe": by_airframe}


def pose_statistics(frames: int, matches: Sequence[Match], false_positives_per_1000: float | None) -> dict[str, Any]:
    """The figures of one group of targets: degrees, metres and shares 0..1; None where there is no data."""
    found = [(m.truth, m.estimate) for m in matches if m.estimate is not None]
    R_gt, t_gt = stacked([truth for truth, _ in found])
    R_est, t_est = stacked([estimate for _, estimate in found])
    turned = np.array([estimate.rotation_known for _, estimate in found], dtype=np.bool_)
    rate = lambda good: _share(int(np.sum(good)), len(matches))  # noqa: E731
    return {
        "frames": frames,
        "targets": len(matches),
        "recall": _told(metrics.recall(len(found), len(matches))),
        "rotations_not_known": len(found) - int(np.sum(turned)),
        "false_positives_per_1000": false_positives_per_1000,
        "rotation_error_deg": _mean_median(metrics.rotation_error_deg(R_est, R_gt)[turned]),
        "translation_error_m": _mean_median(metrics.translation_error_m(t_est, t_gt)),
        "depth_error_m": _mean_median(metrics.depth_error_m(t_est, t_gt)),
        "depth_error_rel": _mean_median(metrics.depth_error_rel(t_est, t_gt)),
        "bearing_error_deg": _mean_median(metrics.bearing_error_deg(t_est, t_gt)),
        "rot_10deg": rate(turned & metrics.rot_10deg(R_est, R_gt)),
        "depth_5pct": rate(metrics.depth_5pct(t_est, t_gt)),
        "pose_10deg_5pct": rate(turned & metrics.pose_10deg_5pct(R_est, t_est, R_gt, t_gt)),
        **_add_rates(matches),
        "calibration": calibration(matches),
    }


def direction_statistics(seen: Sequence[Match], matches: Sequence[Match], false: int) -> dict[str, Any] | None:
    """{"targets", "bearing_error_deg": {"mean", "median"}, "false"} of the targets without a pose but with a direction.

    `seen` and `matches` are of the same targets in the same order, with their directions and with their poses; `false`
    is the number of directions that belong to no target. None without a false one and without such a target.
    """
    alone = [one.bearing_error_deg for one, told in zip(seen, matches, strict=True) if told.estimate is None]
    errors = np.array([error for error in alone if error is not None], dtype=np.float64)
    if not errors.size and not false:
        return None
    mean, median = (round(float(of(errors)), 5) if errors.size else None for of in (np.mean, np.median))
    return {"targets": errors.size, "bearing_error_deg": {"mean": mean, "median": median}, "false": false}


def calibration(matches: Sequence[Match]) -> dict[str, dict[str, float | None]] | None:
    """Share of the true values within one and two predicted standard deviations, by axis; None without covariances.

    For a consistent Gaussian 0.683 and 0.954. Depth has one axis, bearing two, rotation three, each counted separately.
    Rotation is over the poses of known rotation; None where there are none.
    """
    sure = [(m.truth, m.estimate) for m in matches if m.estimate is not None and m.estimate.covariance is not None]
    if not sure:
        return None
    R_gt, t_gt = stacked([truth for truth, _ in sure])
    R_est, t_est = stacked([estimate for _, estimate in sure])
    covariance = np.array([estimate.covariance for _, estimate in sure])
    turned = np.array([estimate.rotation_known for _, estimate in sure], dtype=np.bool_)
    inside: dict[str, Callable[[float], metrics.Booleans]] = {
        "depth": lambda sigmas: metrics.depth_inside(t_est, t_gt, covariance, sigmas),
        "bearing": lambda sigmas: metrics.bearing_inside(t_est, t_gt, covariance, sigmas),
        "rotation": lambda sigmas: metrics.rotation_inside(R_est, R_gt, covariance, sigmas)[turned],
    }
    return {
        name: {f"inside_{sigmas}sigma": _mean(within(sigmas)) for sigmas in (1, 2)} for name, within in inside.items()
    }


def latency_statistics(latencies_ms: ArrayLike) -> dict[str, float | None]:
    """p50, p95, p99 in milliseconds; None for each if there is no sample."""
    samples = np.asarray(latencies_ms, dtype=np.float64)
    names = ("p50", "p95", "p99")
    if samples.size == 0:
        return dict.fromkeys(names)
    return {name: _rounded(value) for name, value in zip(names, np.percentile(samples, [50, 95, 99]), strict=True)}


def range_band(range_m: float) -> str:
    """The band of a true range, metres; 500 m, but for rounding, belongs to the last of the paper's."""
    range_m = round(range_m, _RANGE_DIGITS)
    for low_m, high_m in RANGE_BANDS_M:
        if low_m <= range_m < high_m or range_m == high_m == RANGE_BANDS_M[-1][1]:
            return f"{low_m:.0f}-{high_m:.0f}"
    return f"below-{RANGE_BANDS_M[0][0]:.0f}" if range_m < RANGE_BANDS_M[0][0] else f"above-{RANGE_BANDS_M[-1][1]:.0f}"


def stacked(poses: Sequence[TargetPose]) -> tuple[Array, Array]:
    """R_cam_target [N, 3, 3] and t_cam_target_m [N, 3] of N poses."""
    R = np.array([pose.R_cam_target for pose in poses], dtype=np.float64).reshape(-1, 3, 3)
    return R, np.array([pose.t_cam_target_m for pose in poses], dtype=np.float64).reshape(-1, 3)


def _bands(items: Sequence[Any], pose: Callable[[Any], TargetPose]) -> dict[str, list[Any]]:
    """Items by the range of their pose, near to far: always the paper's bands, others only if they are not empty."""
    order = ["below-100", *(f"{low:.0f}-{high:.0f}" for low, high in RANGE_BANDS_M), "above-500"]
    groups: dict[str, list[Any]] = {name: [] for name in order}
    for item in items:
        groups[range_band(float(np.linalg.norm(pose(item).t_cam_target_m)))].append(item)
    return {name: group for name, group in groups.items() if group or name[0].isdigit()}


def _frames_of(matches: Sequence[Match]) -> int:
    return len({match.truth.frame for match in matches})


def _add_rates(matches: Sequence[Match]) -> dict[str, float | None]:
    """ADD rates over the targets with a known model, found or not."""
    modelled = [m for m in matches if m.truth.points_body_m is not None]
    add = np.array([np.inf if m.add_m is None else m.add_m for m in modelled])
    diameter_m = np.array([m.truth.diameter_m for m in modelled])
    return {
        name: _share(int(np.sum(metrics.add_within(add, diameter_m, fraction))), len(modelled))
        for name, fraction in ADD_FRACTIONS.items()
    }


def _share(part: int, whole: int) -> float | None:
    return _told(part / whole if whole else None)


def _told(value: float | None) -> float | None:
    """Rounded as all figures are; None stays None."""
    return None if value is None else _rounded(value)


def _mean(values: Array | metrics.Booleans) -> float | None:
    return _rounded(values.mean()) if values.size else None


def _mean_median(values: Array) -> dict[str, float | None]:
    if values.size == 0:
        return {"mean": None, "median": None}
    return {"mean": _rounded(values.mean()), "median": _rounded(np.median(values))}


def _rounded(value: float | np.floating[Any]) -> float:
    # Tables round once more: of 0.7895 for 15 of 19 they would make 79.0 %.
    return round(float(value), 6)
