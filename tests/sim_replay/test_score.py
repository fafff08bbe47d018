"""A score of known poses: what is matched, what is missed, and what the figures then say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_replay.score import (
    TargetPose,
    Truth,
    frame_of,
    latency_statistics,
    match_poses,
    pose_statistics,
    statistics_by_range,
)

START_NS, FPS = 5_000_000_000, 30.0


def truth(frame: int, range_m: float = 300.0, x_m: float = 0.0) -> Truth:
    return Truth(frame, np.eye(3), np.array([x_m, 0.0, range_m]), object_id=1, diameter_m=12.0)


def estimate(of: Truth, turned_deg: float = 0.0, stretched: float = 1.0) -> TargetPose:
    R = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    return TargetPose(of.frame, R, of.t_cam_target_m * stretched)


def test_truth_as_estimate_scores_perfectly() -> None:
    truths = [truth(k) for k in range(10)]
    matches, false_poses = match_poses(truths, [estimate(t) for t in truths])
    figures = pose_statistics(matches)
    assert false_poses == 0
    assert figures["detection_rate"] == figures["pose_10deg_5pct"] == 1.0
    assert figures["rotation_error_deg"] == {"mean": 0.0, "median": 0.0}
    assert figures["translation_error_m"]["mean"] == 0.0


def test_a_missed_target_lowers_rates_and_leaves_means_alone() -> None:
    truths = [truth(k) for k in range(4)]
    matches, _ = match_poses(truths, [estimate(truths[0], 6.0), estimate(truths[2], 2.0, stretched=1.1)])
    figures = pose_statistics(matches)
    assert figures["detection_rate"] == 0.5
    assert figures["pose_10deg_5pct"] == 0.25
    assert figures["rotation_error_deg"]["mean"] == pytest.approx(4.0)
    assert figures["depth_error_rel"]["mean"] == pytest.approx(0.05)
    assert figures["translation_error_m"]["mean"] == pytest.approx(15.0)


def test_a_pose_in_another_direction_is_false_and_the_target_missed() -> None:
    target = truth(0)
    elsewhere = TargetPose(0, np.eye(3), np.array([40.0, 0.0, 300.0]))
    matches, false_poses = match_poses([target], [elsewhere])
    assert matches[0].estimate is None
    assert false_poses == 1


def test_two_targets_each_get_their_own_pose_and_a_duplicate_is_false() -> None:
    left, right = truth(0, x_m=-5.0), truth(0, x_m=5.0)
    poses = [estimate(right), estimate(left), estimate(right, stretched=1.2)]
    matches, false_poses = match_poses([left, right], poses)
    assert [np.sign(m.estimate.t_cam_target_m[0]) for m in matches if m.estimate] == [-1.0, 1.0]
    assert false_poses == 1


def test_a_pose_of_another_frame_does_not_help() -> None:
    matches, false_poses = match_poses([truth(3)], [estimate(truth(4))])
    assert matches[0].estimate is None
    assert false_poses == 1


def test_nothing_found_gives_null_and_not_nan() -> None:
    matches, _ = match_poses([truth(0)], [])
    figures = pose_statistics(matches)
    assert figures["detection_rate"] == 0.0
    assert figures["rotation_error_deg"]["mean"] is None
    assert latency_statistics([]) == {"p50": None, "p95": None, "p99": None}


@pytest.mark.parametrize(
    ("late_ms", "index"),
    [(0.0, 0), (16.0, 0), (17.0, 1), (-16.0, 0), (-17.0, None), (9 * 100 / 3, 9), (9.6 * 100 / 3, None)],
)
def test_stamp_goes_to_the_nearest_of_ten_frames_within_half_a_frame(late_ms: float, index: int | None) -> None:
    assert frame_of(START_NS + round(late_ms * 1e6), START_NS, FPS, frames=10) == index


def test_bands_split_by_true_range() -> None:
    truths = [truth(0, 150.0), truth(1, 250.0), truth(2, 250.0)]
    matches, _ = match_poses(truths, [estimate(truths[1])])
    bands = statistics_by_range(matches)
    assert [(band["range_m"], band["targets"], band["detection_rate"]) for band in bands] == [
        ([0.0, 200.0], 1, 0.0),
        ([200.0, 300.0], 2, 0.5),
    ]


def test_latency_percentiles_of_a_ramp() -> None:
    assert latency_statistics(np.arange(101.0)) == {"p50": 50.0, "p95": 95.0, "p99": 99.0}
