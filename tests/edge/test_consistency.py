"""Is the tracker as good as it says? Errors of many drawn flights against the covariances told, by chi-square."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from edge.tracking.heading import reversal
from edge.tracking.tracker import Tracker
from edge.tracking.view import View
from edge.types import Estimate, Mount, OwnShip, Track

K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 540.0], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
MOUNT = Mount(np.eye(3), np.zeros(3))
NORTH_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
DT_S = 1.0 / 15.0
FRAMES, RUNS = 45, 40
# What the network tells of itself, and what the filter says lies beyond that.
BEARING_STD_RAD = float(np.hypot(2.0, 1.0)) / K[0, 0]
TOLD_LOG_RANGE, LOG_RANGE_STD = 0.06, float(np.hypot(0.06, 0.01))
ROTATION_STD_RAD = np.deg2rad(6.0)
BIAS_SHARE, BIAS_TIME_S, COMMON_SHARE = 0.8, 4.0, 0.6
TILT_RAD, HEADING_RAD, PLACE_M, VELOCITY_MPS = np.deg2rad(0.7), np.deg2rad(2.0), 1.5, 0.3
JITTER_RAD, CLOCK_S = 1e-3, 0.005


@dataclass
class Run:
    """The last frame of one flight: the truth and what was told."""

    t_cam_m: np.ndarray
    t_ned_m: np.ndarray
    R_cam_target: np.ndarray
    track: Track


def fly(seed: int, wrong_side: float) -> Run:
    """A target that wanders as the filter supposes; a share `wrong_side` of networks sees the depth reversal."""
    rng = np.random.default_rng(seed)
    R_error = Rotation.from_rotvec(rng.normal(size=3) * [TILT_RAD, TILT_RAD, HEADING_RAD]).as_matrix()
    place_error, velocity_error = rng.normal(scale=PLACE_M, size=3), rng.normal(scale=VELOCITY_MPS, size=3)
    sees_reversal = rng.random() < wrong_side
    tracker = Tracker(4, MOUNT)
    own_v = np.array([20.0, 0.0, 0.0])
    heading = rng.uniform(-np.pi, np.pi)
    v = np.array([25.0 * np.cos(heading), 25.0 * np.sin(heading), rng.normal(scale=2.0)])
    target, own = np.array([rng.uniform(150.0, 350.0), rng.normal(scale=20.0), rng.normal(scale=15.0)]), np.zeros(3)
    bias, yaw, turn_radps = rng.normal(), 0.0, rng.normal(scale=0.05)
    common = Rotation.from_rotvec(rng.normal(scale=np.sqrt(COMMON_SHARE) * ROTATION_STD_RAD, size=3))
    fade = np.exp(-DT_S / BIAS_TIME_S)
    for i in range(FRAMES):
        if i:
            kick = rng.normal(size=3) * [3.0, 3.0, 1.5] * np.sqrt(DT_S)
            turn_radps += rng.normal(scale=0.02 * np.sqrt(DT_S))
            v_next = Rotation.from_euler("z", turn_radps * DT_S).apply(v) + kick
            target, own, v = target + 0.5 * DT_S * (v + v_next), own + DT_S * own_v, v_next
            bias = fade * bias + np.sqrt(1.0 - fade**2) * rng.normal()
        before, yaw = (yaw if i else None), float(np.arctan2(target[1] - own[1], target[0] - own[0]))
        R_ned_cam = Rotation.from_euler("z", yaw).as_matrix() @ NORTH_CAM
        turning_radps = 0.0 if before is None else (yaw - before) / DT_S
        t_cam = R_ned_cam.T @ (target - own)
        bank = np.arctan(np.linalg.norm(v) * turn_radps / 9.81)
        course = [np.arctan2(v[1], v[0]), np.arctan2(-v[2], np.hypot(*v[:2])), bank]
        R_ned_target = Rotation.from_euler("ZYX", course).as_matrix()
        R_cam_target = R_ned_cam.T @ R_ned_target
        along = t_cam / np.linalg.norm(t_cam)
        range_error = LOG_RANGE_STD * (np.sqrt(BIAS_SHARE) * bias + np.sqrt(1.0 - BIAS_SHARE) * rng.normal())
        across = (np.eye(3) - np.outer(along, along)) @ rng.normal(
            scale=BEARING_STD_RAD * np.linalg.norm(t_cam), size=3
        )
        white = Rotation.from_rotvec(rng.normal(scale=np.sqrt(1.0 - COMMON_SHARE) * ROTATION_STD_RAD, size=3))
        seen = (white * common).as_matrix() @ R_cam_target
        doubt = Rotation.from_matrix(reversal(seen, along) @ seen.T).as_rotvec()
        covariance = np.zeros((6, 6))
        told_across = (2.0 / K[0, 0]) ** 2 * (t_cam @ t_cam) * (np.eye(3) - np.outer(along, along))
        covariance[:3, :3] = told_across + TOLD_LOG_RANGE**2 * np.outer(t_cam, t_cam)
        covariance[3:, 3:] = np.diag(ROTATION_STD_RAD**2 + wrong_side * doubt**2)
        shown = reversal(seen, along) if sees_reversal else seen
        center = (K @ t_cam)[:2] / t_cam[2]
        box = np.concatenate([center - 30.0, center + 30.0])
        estimate = Estimate(0.9, box, shown, t_cam * (1.0 + range_error) + across, covariance, "track")
        time_ns = 1 + round(i * DT_S * 1e9)
        late_rad = turning_radps * rng.normal(scale=CLOCK_S) * np.array([0.0, 0.0, 1.0])
        shaken = Rotation.from_rotvec(rng.normal(scale=JITTER_RAD, size=3) + late_rad).as_matrix()
        told = OwnShip(time_ns, R_error @ shaken @ R_ned_cam, own + place_error, own_v + velocity_error, None)
        (track,) = tracker.update(time_ns, [estimate], told, K, SIZE_WH)
    return Run(t_cam, target, R_cam_target, track)


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return [fly(seed, wrong_side=0.35) for seed in range(RUNS)]


def nees(errors: list[np.ndarray], covariances: list[np.ndarray]) -> np.ndarray:
    """Normalised estimation error squared of each run."""
    return np.array([e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)])


def bounds_95(dof: int) -> tuple[float, float]:
    """Of the mean over the runs, if the covariances are right."""
    return tuple(chi2.ppf([0.025, 0.975], dof * RUNS) / RUNS)


def test_positions_are_as_sure_as_told(runs: list[Run]) -> None:
    _, high = bounds_95(3)
    in_cam = nees([r.track.t_cam_target_m - r.t_cam_m for r in runs], [r.track.covariance[:3, :3] for r in runs])
    # Cautious rather: these targets turn less than the filter allows for.
    assert 1.2 < np.mean(in_cam) < high


def test_positions_in_ned_hold_the_own_ships_errors(runs: list[Run]) -> None:
    """The own ship's attitude, place and velocity are off by what autopilots are; told as exact, this would fail."""
    low, high = bounds_95(3)
    errors = [r.track.t_ned_target_m - r.t_ned_m for r in runs]
    told = nees(errors, [r.track.covariance_ned[:3, :3] for r in runs])
    assert low < np.mean(told) < high
    own_left_out = nees(errors, [r.track.covariance[:3, :3] for r in runs])
    assert np.mean(own_left_out) > high


def test_rotations_are_at_least_as_sure_as_told(runs: list[Run]) -> None:
    """A mixture of two is no Gaussian: the covariance that holds both is cautious where the held one is right."""
    errors = [Rotation.from_matrix(r.R_cam_target @ r.track.R_cam_target.T).as_rotvec() for r in runs]
    told = nees(errors, [r.track.covariance[3:, 3:] for r in runs])
    assert np.mean(told) < bounds_95(3)[1]
    assert np.mean(told < chi2.ppf(0.95, 3)) >= 0.9


def test_most_wrong_sides_are_put_right_by_the_flight(runs: list[Run]) -> None:
    """A network that sees the reversal in 35 of 100 flights, and says so, is put right in more than half of them."""
    angles = [np.rad2deg((Rotation.from_matrix(r.R_cam_target.T @ r.track.R_cam_target)).magnitude()) for r in runs]
    assert np.mean(np.array(angles) > 30.0) < 0.35 / 2


def test_own_ship_errors_are_those_of_drawn_own_ships() -> None:
    """First order against thousands of drawn attitudes, places and velocities."""
    rng = np.random.default_rng(4)
    own_m, own_v = np.array([100.0, 50.0, -80.0]), np.array([18.0, 5.0, 0.0])
    target_m, target_v = np.array([300.0, -60.0, -120.0]), np.array([-10.0, 25.0, 1.0])
    view = View("ned", 0, np.eye(3), own_m, own_v)
    told = view.own_ship_covariance(target_m, target_v)
    drawn = []
    for _ in range(4000):
        tilt = Rotation.from_rotvec(rng.normal(size=3) * [TILT_RAD, TILT_RAD, HEADING_RAD])
        late_s = rng.normal(scale=CLOCK_S)
        t = own_m + rng.normal(scale=PLACE_M, size=3) + own_v * late_s + tilt.apply(target_m - own_m)
        v = own_v + rng.normal(scale=VELOCITY_MPS, size=3) + tilt.apply(target_v - own_v)
        drawn.append(np.concatenate([t - target_m, v - target_v, tilt.as_rotvec()]))
    sampled = np.cov(np.array(drawn).T)
    scale = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(told / np.outer(scale, scale), sampled / np.outer(scale, scale), atol=0.08)
