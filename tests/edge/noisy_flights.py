"""Simulated flights whose noise is known: a turning target, seen from a turning own ship."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, OwnShip, Track

FORWARD = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.5, 0.0, 0.2]))
K = np.array([[2000.0, 0.0, 960.0], [0.0, 2000.0, 540.0], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
RATE_HZ = 30
BEARING_STD_PX = 2.0
LOG_RANGE_STD = 0.05
ROTATION_STD_RAD = np.deg2rad(6.0)
BIAS_SHARE, BIAS_TIME_S = 0.8, 4.0  # of range errors: the rest is new in each frame


@dataclass
class Instant:
    """The truth of one frame, and a noisy estimate of it."""

    time_ns: int
    own_ship: OwnShip
    t_cam_target_m: np.ndarray
    R_cam_target: np.ndarray
    v_ned_target_mps: np.ndarray
    box_xyxy_px: np.ndarray
    estimate: Estimate


def euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


def flight(
    seed: int,
    frames: int = 240,
    offset_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    bias_share: float = BIAS_SHARE,
) -> Iterator[Instant]:
    """A target in a steady turn at 25 m/s; the own ship follows at 20 m/s, rolling and yawing."""
    rng = np.random.default_rng(seed)
    bias = rng.normal()
    memory = np.exp(-1.0 / RATE_HZ / BIAS_TIME_S)
    speed_mps, turn_radps = 25.0, 0.1
    for i in range(frames):
        t = i / RATE_HZ
        yaw = turn_radps * t
        radius_m = speed_mps / turn_radps
        target_m = np.array([250 + radius_m * np.sin(yaw), radius_m * (1 - np.cos(yaw)), -100.0]) + offset_ned_m
        v_mps = speed_mps * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        own_m = np.array([20.0 * t, 0.0, -100.0])
        towards = np.arctan2(target_m[1] - own_m[1], target_m[0] - own_m[0])
        R_ned_body = euler(0.3 * np.sin(t), 0.05 * np.sin(2 * t), 0.1 * np.sin(0.7 * t) + towards)
        R_cam_ned = (R_ned_body @ FORWARD.R_body_cam).T
        t_cam = R_cam_ned @ (target_m - own_m - R_ned_body @ FORWARD.t_body_cam_m)
        R_cam_target = R_cam_ned @ euler(0.3, 0.05, yaw)
        own_ship = OwnShip(1 + round(t * 1e9), R_ned_body, own_m, np.array([20.0, 0.0, 0.0]), None)
        bias = memory * bias + np.sqrt(1.0 - memory**2) * rng.normal()
        log_range_error = LOG_RANGE_STD * (np.sqrt(bias_share) * bias + np.sqrt(1 - bias_share) * rng.normal())
        yield Instant(own_ship.time_ns, own_ship, t_cam, R_cam_target, v_mps, box_at(t_cam), seen(
            rng, t_cam, R_cam_target, log_range_error
        ))  # fmt: skip


def box_at(t_cam_m: np.ndarray) -> np.ndarray:
    center = (K @ t_cam_m)[:2] / t_cam_m[2]
    half = K[0, 0] * np.array([4.0, 1.5]) / t_cam_m[2]
    return np.concatenate([center - half, center + half])


def seen(rng: np.random.Generator, t_cam_m: np.ndarray, R_cam_target: np.ndarray, log_range_error: float) -> Estimate:
    across_std_m = BEARING_STD_PX / K[0, 0] * np.linalg.norm(t_cam_m)
    along = t_cam_m / np.linalg.norm(t_cam_m)
    across = np.eye(3) - np.outer(along, along)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = across_std_m**2 * across + LOG_RANGE_STD**2 * np.outer(t_cam_m, t_cam_m)
    covariance[3:, 3:] = ROTATION_STD_RAD**2 * np.eye(3)
    measured_m = (1 + log_range_error) * t_cam_m + across @ rng.normal(scale=across_std_m, size=3)
    R = Rotation.from_rotvec(rng.normal(scale=ROTATION_STD_RAD, size=3)).as_matrix() @ R_cam_target
    return Estimate(0.9, box_at(t_cam_m) + rng.normal(scale=1.0), R, measured_m, covariance, "track")


def known(kind: str, own_ship: OwnShip) -> OwnShip | None:
    """What is left of the own ship's state."""
    if kind == "cam":
        return None
    return own_ship if kind == "ned" else replace(own_ship, t_ned_body_m=None, v_ned_body_mps=None)


def update(tracker: Tracker, now: Instant, kind: str, estimates: list[Estimate] | None = None) -> tuple[Track, ...]:
    found = [now.estimate] if estimates is None else estimates
    return tracker.update(now.time_ns, found, known(kind, now.own_ship), K, SIZE_WH)


def predict(tracker: Tracker, now: Instant, kind: str) -> list[Track]:
    return tracker.predict(now.time_ns, known(kind, now.own_ship), K, SIZE_WH)
