"""The filter of a target's rotation: two hypotheses of one outline, and measurements that fit neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.tracking import rotation
from edge.tracking.heading import Flight, flown_odds, network_opinion, reversal
from edge.tracking.rotation import COMMON_SHARE, ODD_FRAMES, Attitude
from edge.tracking.view import View
from edge.types import Array, Estimate, OwnShip

from .test_tracker_parts import LOOKING_NORTH, NORTH_EAST

FRAME_S = 1.0 / 30.0
T_CAM_M = np.array([60.0, -40.0, 200.0])
ALONG_CAM = T_CAM_M / np.linalg.norm(T_CAM_M)
R_NED_BODY = Rotation.from_euler("ZYX", [0.4, 0.1, -0.3]).as_matrix()
VIEW = View.of(0, OwnShip(0, R_NED_BODY, np.zeros(3), np.zeros(3), None), LOOKING_NORTH)
ALONG = VIEW.R_frame_cam @ ALONG_CAM


def measured(R_cam_target: Array, std_rad: float = 0.1) -> Estimate:
    covariance = np.diag([0.04, 0.04, 16.0, *std_rad**2 * np.array([1.0, 2.0, 3.0])])
    return Estimate(0.9, np.zeros(4), R_cam_target, T_CAM_M, covariance, "track")


def seen_as(R_target: Array) -> Estimate:
    """Of a target whose true rotation relative to that which is held first is R_target [3, 3], in its own axes."""
    return measured(NORTH_EAST @ R_target)


@pytest.mark.parametrize("other_side", [False, True])
def test_a_measurement_of_either_side_corrects_the_held_one_by_the_rules_of_bayes(other_side: bool) -> None:
    """With the reversal's error mirrored along the sight line. Of the variance, a share is common to all frames."""
    P, common = np.diag([0.01, 0.02, 0.04]), np.diag([0.03, 0.01, 0.02])
    w = np.array([0.05, -0.08, 0.03])
    R_ned_target = VIEW.R_frame_cam @ NORTH_EAST
    held = Attitude(R_ned_target, P, common, picked=1.0)
    shown = VIEW.R_frame_cam.T @ Rotation.from_rotvec(w).as_matrix() @ R_ned_target
    estimate = measured(reversal(shown, ALONG_CAM) if other_side else shown)

    log_odds, noise = network_opinion(estimate, ALONG_CAM)
    mirror = np.eye(3) - 2.0 * np.outer(ALONG_CAM, ALONG_CAM) if other_side else np.eye(3)
    N = VIEW.R_frame_cam @ mirror @ noise @ mirror.T @ VIEW.R_frame_cam.T
    weight = np.linalg.inv((1.0 - COMMON_SHARE) * N)
    expected_P = np.linalg.inv(np.linalg.inv(P) + weight)
    fade = np.exp(-0.5)

    corrected = rotation.correct(held, estimate, VIEW, 0.5)
    np.testing.assert_allclose(corrected.P, expected_P, atol=1e-9)
    moved = Rotation.from_matrix(corrected.R_frame_target @ R_ned_target.T).as_rotvec()
    np.testing.assert_allclose(moved, expected_P @ weight @ w, atol=1e-6)
    np.testing.assert_allclose(corrected.common, fade * common + (1.0 - fade) * COMMON_SHARE * N, atol=1e-9)
    opinion = min(2.0 * log_odds, 3.0) * (-1.0 if other_side else 1.0)
    assert corrected.picked == pytest.approx(fade + (1.0 - fade) * opinion)


def test_a_rotation_far_beyond_its_uncertainty_moves_the_held_one_little() -> None:
    """By 50 degrees, of which three quarters would be taken over if it were as sure as it tells."""
    held = Attitude(NORTH_EAST, 0.005 * np.eye(3), 0.005 * np.eye(3))
    view = View.of(0, None, LOOKING_NORTH)
    off = Rotation.from_rotvec(np.deg2rad(50.0) * ALONG_CAM).as_matrix()
    corrected = rotation.correct(held, measured(off @ NORTH_EAST, 0.05), view, FRAME_S)
    moved = Rotation.from_matrix(corrected.R_frame_target @ NORTH_EAST.T).magnitude()
    assert np.deg2rad(3.0) < moved < np.deg2rad(20.0)


def test_a_rotation_that_was_switched_is_not_switched_back_at_once() -> None:
    """Each time the evidence has to be against it for a fifth of a second, without a break."""
    attitude = rotation.begin(seen_as(np.eye(3)), VIEW)
    for picked in [*[3.0] * 10, *[-3.0] * 4, 0.0, *[-3.0] * 4, 0.0]:
        held = attitude.R_frame_target
        attitude = rotation.weighed(replace(attitude, picked=picked), ALONG, None, 0.045, settled=True)
        assert attitude.R_frame_target is held
    for _ in range(2):
        before = attitude.R_frame_target
        attitude = replace(attitude, picked=-3.0)
        frames = 0
        while attitude.R_frame_target is before:
            attitude = rotation.weighed(attitude, ALONG, None, 0.045, settled=True)
            frames += 1
        assert frames == 5
        np.testing.assert_allclose(attitude.R_frame_target, reversal(before, ALONG))


def doubt(attitude: Attitude, axis_target: Array) -> float:
    """Standard deviation, rad, about an axis [3] of the target, if it is known which side is seen."""
    axis = attitude.R_frame_target @ axis_target
    return float(np.sqrt(axis @ rotation.covariance(replace(attitude, log_odds=20.0), ALONG) @ axis))


NOSE = np.array([1.0, 0.0, 0.0])
ROLLED = Rotation.from_rotvec(np.deg2rad(110.0) * NOSE).as_matrix()  # from itself, and from its reversal, by far


def follow(attitude: Attitude, rolled: list[bool]) -> Attitude:
    """The attitude after frames that show the target as it is held, or rolled."""
    for one in rolled:
        attitude = rotation.correct(attitude, seen_as(ROLLED if one else np.eye(3)), VIEW, FRAME_S)
    return attitude


def test_where_every_other_frame_shows_another_rotation_the_doubt_is_as_large_as_the_difference() -> None:
    sure = follow(rotation.begin(seen_as(np.eye(3)), VIEW), [False] * 30)
    torn = follow(sure, [False, True] * 60)
    half = np.sqrt(0.5) * np.deg2rad(110.0)  # either of the two with equal chance
    assert doubt(sure, NOSE) < 0.2 * half
    assert doubt(follow(sure, [True]), NOSE) < 0.25 * half, "a single frame counts for little"
    assert doubt(torn, NOSE) == pytest.approx(half, rel=0.15)
    np.testing.assert_allclose(torn.R_frame_target, sure.R_frame_target, atol=0.02)
    assert doubt(follow(torn, [False] * 120), NOSE) < 0.2 * half, "once they agree again, it is sure again"


def test_another_rotation_that_stays_is_taken_with_doubt_that_fades() -> None:
    sure = follow(rotation.begin(seen_as(np.eye(3)), VIEW), [False] * 30)
    waiting = follow(sure, [True] * (ODD_FRAMES - 1))
    np.testing.assert_allclose(waiting.R_frame_target, sure.R_frame_target)
    interrupted = follow(waiting, [False, True])
    assert Rotation.from_matrix(interrupted.R_frame_target @ sure.R_frame_target.T).magnitude() < 0.1
    taken = follow(waiting, [True])
    off = VIEW.R_frame_cam @ NORTH_EAST @ ROLLED
    np.testing.assert_allclose(taken.R_frame_target, off, atol=1e-6)
    assert doubt(taken, NOSE) == pytest.approx(np.sqrt(0.5) * np.deg2rad(110.0), rel=0.05)
    assert doubt(follow(taken, [True] * 120), NOSE) < 0.2 * doubt(taken, NOSE)


def test_nose_and_tail_that_may_be_confused_are_a_doubt_about_the_turn_between_them_that_passes() -> None:
    """Flying west while both rotations point east: what the odds are above even ones, against a prior of e^3."""
    R, north = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 0.0, 0.0])
    held = Attitude(R, 0.002 * np.eye(3), 0.002 * np.eye(3), picked=3.0)
    westwards, eastwards = (Flight(np.array([0.0, v, 0.0]), np.eye(3), 0.0, 1e-4, None) for v in (-25.0, 25.0))
    confused = rotation.weighed(held, north, westwards, FRAME_S, settled=True)
    sure = rotation.weighed(confused, north, eastwards, FRAME_S, settled=True)
    unknown = rotation.weighed(confused, north, None, FRAME_S, settled=True)
    added = rotation.covariance(confused, north) - rotation.covariance(sure, north)
    _, odds = flown_odds(R, reversal(R, north), held.P + held.common, westwards)
    share = np.expm1(odds) / (np.expm1(odds) + np.exp(3.0))
    np.testing.assert_allclose(added, np.diag([0.0, 0.0, share * np.pi**2]), atol=1e-6)
    assert sure.tail_first == unknown.tail_first == 0.0


def test_in_other_axes_a_rotation_and_its_doubts_are_the_same() -> None:
    attitude = Attitude(VIEW.R_frame_cam @ NORTH_EAST, np.diag([0.01, 0.02, 0.03]), np.diag([0.06, 0.05, 0.04]))
    R = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    moved = rotation.reframe(attitude, R, 0.0)
    np.testing.assert_allclose(moved.R_frame_target, R @ attitude.R_frame_target)
    told = R @ rotation.covariance(attitude, ALONG) @ R.T
    np.testing.assert_allclose(rotation.covariance(moved, R @ ALONG), told, atol=1e-9)
