"""Metrics of windows: seven of them, with errors that are known, worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs.contract import ScoreCalibration
from trainer.comparison import Measured, Tolerance, Views, comparison_table
from trainer.data import TrainingBatch
from trainer.evaluate import Predictions, calibrated, difference, measure, measure_each

PRESENT = np.array([True, True, True, True, False, False, True])
SCORES = np.array([0.9, 0.4, 0.2, 0.8, 0.4, 0.1, 0.9])


def labelled() -> TrainingBatch:
    """Targets 200 m ahead in five windows of seven; the last also shows another aircraft."""
    count = len(PRESENT)
    others = np.zeros((count, 2, 2), dtype=bool)
    others[-1, 0, 0] = True
    size_px = np.tile(np.float32([20.0, 10.0]), (count, 1))
    size_px[0] = 2.0
    return TrainingBatch(
        np.zeros((count, 8, 8, 3), np.uint8),
        np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        PRESENT,
        np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        np.tile(np.float32([0.0, 0.0, 200.0]), (count, 1)),
        np.full((count, 2), 40.0, np.float32),
        size_px,
        np.zeros((count, 2, 2), np.float32),
        np.zeros((count, 3, 2, 2), np.float32),
        others,
        np.full(count, 10.0, np.float32),
        np.zeros(count, np.int32),
    )


def predicted() -> Predictions:
    """Turned by 12 degrees and 5 m aside in the second, 8 m too far in the third, 13 m off in the fourth."""
    labels = labelled()
    R, t_m = labels.R_cam_target.copy(), labels.t_cam_target_m.copy()
    R[1] = Rotation.from_euler("y", 12.0, degrees=True).as_matrix()
    t_m[1:4] = [3.0, 4.0, 200.0], [0.0, 0.0, 208.0], [0.0, 5.0, 212.0]
    center_px, size_px = labels.center_px.copy(), labels.size_px.copy()
    center_px[:4, 0] += [3.0, 9.0, 0.0, -11.0]
    size_px[2] *= 2.0
    sigma = np.ones((len(PRESENT), 6), np.float32)
    return Predictions(SCORES.astype(np.float32), center_px, size_px, center_px, t_m, R, sigma)


def test_windows_are_measured_as_worked_by_hand() -> None:
    """Found are the first, whose box is so small that 4 px count, and the second; a window of two aircraft is none."""
    found = measure(predicted(), [labelled()], threshold=0.3)
    assert found == pytest.approx(
        {
            "windows": 6.0,
            "E_r_mean_deg": 3.0,
            "E_r_median_deg": 0.0,
            "rot_lt_10deg": 0.75,
            "E_t_mean_m": 6.5,
            "E_t_median_m": 6.5,
            "E_z_mean_m": 5.0,
            "depth_rel_mean": 0.025,
            "depth_rel_median": 0.02,
            "depth_lt_5pct": 0.75,
            "pose_10deg_5pct": 0.5,
            "bearing_median_deg": np.degrees(np.arctan(5 / 212) / 2),
            "box_iou_mean": (0.0 + 11 / 29 + 1 / 4 + 9 / 31) / 4,
            "recall": 0.5,
            "false_alarms": 0.5,
            "score_auc": 6.5 / 8,
            "score_median": 0.6,
        },
        abs=1e-5,
    )
    stricter = measure(predicted(), [labelled()], threshold=0.85)
    assert (stricter["recall"], stricter["false_alarms"]) == (0.25, 0.0)


def test_each_part_is_measured_by_itself_and_an_empty_one_is_left_out() -> None:
    parts = {"near": np.arange(7) < 2, "none": np.zeros(7, dtype=bool), "empty": ~PRESENT}
    found = measure_each(predicted(), [labelled()], parts)
    assert set(found) == {"near", "empty"}
    assert found["near"]["E_t_mean_m"] == pytest.approx(2.5)
    assert np.isnan(found["empty"]["E_t_mean_m"])
    assert np.isnan(found["near"]["false_alarms"])


def test_two_networks_differ_by_so_much() -> None:
    differ = difference(predicted(), Predictions(SCORES, *labelled_answers()), np.arange(7) < 4)
    assert differ["rotation_deg_p95"] == pytest.approx(np.percentile([0, 12, 0, 0], 95), abs=1e-4)
    assert differ["depth_rel_median"] == pytest.approx(0.02)
    assert differ["center_px_median"] == pytest.approx(6.0)
    assert differ["sigma_rel_median"] == pytest.approx(0.75)


def test_int8_is_held_against_fp32_as_worked_by_hand() -> None:
    """Turned by 12 degrees, 4 % too far, a quarter of the sigma, and seen too faintly to be found."""
    fp32 = Predictions(SCORES.astype(np.float32), *labelled_answers())
    fp32.score[:] = np.where(PRESENT, 0.9, SCORES)
    turn = Rotation.from_euler("y", 12.0, degrees=True).as_matrix().astype(np.float32)
    int8 = fp32._replace(
        score=np.full(7, 0.2, np.float32),
        R_cam_target=turn @ fp32.R_cam_target,
        t_cam_target_m=1.04 * fp32.t_cam_target_m,
        sigma=fp32.sigma / 4,
    )
    views = Views([labelled()], [labelled()])
    table, strayed = comparison_table(views, "", Measured(None, int8), Measured(fp32, fp32), (0.3, 0.95))
    assert strayed == pytest.approx((12.0, 4.0, 100.0, 75.0, 100.0), abs=1e-3)
    assert strayed.refusal(Tolerance()) == (
        "median rotation differs from FP32's by 12 degrees, more than --tolerance 2"
    )
    (row,) = [" ".join(line.split()) for line in table.splitlines() if "acquire" in line]
    differences = "12.000 / 12.000 4.000 / 4.000 0.000 / 0.000 75.000 / 75.000 0.700 / 0.700"
    assert row == f"acquire {differences} 0.0 / 100.0 0.0 / 100.0 0.0 / 50.0"
    _, better = comparison_table(views, "", Measured(fp32, fp32), Measured(None, int8), (0.3, 0.95))
    assert better[2:] == (0.0, 0.0, 0.0)  # poses, sigma, recall
    crowded = labelled()._replace(others=np.ones((7, 2, 2), dtype=bool))
    alike = comparison_table(Views([], [crowded]), "", Measured(None, fp32), Measured(None, fp32), (0.3, 0.95))[1]
    assert alike == (0.0, 0.0, 0.0, 0.0, 0.0)  # of poses such windows tell nothing


def labelled_answers() -> tuple[np.ndarray, ...]:
    """The labels as the answers of a network, with sigmas four times as large."""
    labels = labelled()
    sigma = np.full((len(PRESENT), 6), 4.0, np.float32)
    return labels.center_px, labels.size_px, labels.center_px, labels.t_cam_target_m, labels.R_cam_target, sigma


def test_peaks_become_probabilities_by_the_size_of_their_boxes() -> None:
    law = ScoreCalibration(offset=-6.0, slope=3.0, size_slope=1.5, size_cap_px=45.0)
    size_px = np.tile(np.float32([12.0, 27.0]), (7, 1))  # as large as a square of 18 px
    told = calibrated(predicted()._replace(size_px=size_px), law).score
    assert told == pytest.approx([law.probability(score, 18.0) for score in SCORES], abs=1e-5)
