"""What is sent of a target is where it is, as surely as told, however frames, detections and own ship come and go."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.links.outgoing import rangeless, rotation_known, sendable
from edge.tracking.tracker import Tracker
from edge.types import Array, Estimate, FrameMeta, OwnShip, Report, Track

from .noisy_flights import FORWARD, SIZE_WH, K, euler, known, seen

D2_MAX = 45.0  # squared Mahalanobis distance, 3 degrees of freedom: more than chance allows
LOG_RANGE_STD, COMMON_SHARE, COMMON_S = 0.05, 0.8, 4.0
ROLLS_IN_S = 0.5
MAX_AGE_MS = 500.0


class Leg(NamedTuple):
    """Some frames of a flight, after what may happen before the first of them."""

    kind: Literal["ned", "ned_relative", "cam"]  # what is known of the own ship
    step_ms: int
    frames: int
    seen_share: float
    turn_radps: float
    before: Literal["nothing", "other origin", "other north", "no frames for a second"]


@dataclass
class Sky:
    """A target that turns at 30 m/s, and an own ship that follows it, rolling and looking about."""

    rng: np.random.Generator
    time_s: float = 1.0
    target_m: Array = field(default_factory=lambda: np.array([250.0, 20.0, -120.0]))
    yaw: float = 0.5
    turn_radps: float = 0.0
    own_m: Array = field(default_factory=lambda: np.array([0.0, 0.0, -100.0]))
    v_own_mps: Array = field(default_factory=lambda: np.array([25.0, 0.0, 0.0]))
    R_axes: Array = field(default_factory=lambda: np.eye(3))  # from the sky's axes to those that the autopilot tells
    origin_m: Array = field(default_factory=lambda: np.zeros(3))
    axes_epoch: int = 0
    origin_epoch: int = 0
    common_error: float = 0.0

    @property
    def v_target_mps(self) -> Array:
        return 30.0 * np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0])

    def fly(self, dt_s: float, turn_radps: float) -> None:
        self.turn_radps += (turn_radps - self.turn_radps) * (1.0 - np.exp(-dt_s / ROLLS_IN_S))
        self.yaw += self.turn_radps * dt_s
        self.target_m = self.target_m + dt_s * self.v_target_mps
        away_m = self.target_m - self.own_m
        towards = np.array([*away_m[:2], 0.0]) / np.linalg.norm(away_m)
        self.v_own_mps += (min(np.linalg.norm(away_m) / 9.0, 45.0) * towards - self.v_own_mps) * min(0.3 * dt_s, 1.0)
        self.own_m = self.own_m + dt_s * self.v_own_mps
        remembered = np.exp(-dt_s / COMMON_S)
        self.common_error = remembered * self.common_error + np.sqrt(1.0 - remembered**2) * self.rng.normal()
        self.time_s += dt_s

    def happens(self, before: str) -> None:
        if before == "other origin":
            self.origin_m, self.origin_epoch = 200.0 * self.rng.normal(size=3), self.origin_epoch + 1
        if before == "other north":
            self.R_axes = euler(0.0, 0.0, self.rng.uniform(-3.0, 3.0))
            self.axes_epoch, self.origin_epoch = self.axes_epoch + 1, self.origin_epoch + 1

    def own_ship(self) -> OwnShip:
        away_m, t = self.target_m - self.own_m, self.time_s
        up, aside = -np.arctan2(away_m[2], np.hypot(*away_m[:2])), np.arctan2(away_m[1], away_m[0])
        R = euler(0.3 * np.sin(t), up + 0.05 * np.sin(2.0 * t), aside + 0.15 * np.sin(0.7 * t))
        own_m, v_mps = self.R_axes @ self.own_m + self.origin_m, self.R_axes @ self.v_own_mps
        time_ns = round(t * 1e9)
        return OwnShip(
            time_ns, self.R_axes @ R, own_m, v_mps, None, axes_epoch=self.axes_epoch, origin_epoch=self.origin_epoch
        )

    def in_cam(self, own_ship: OwnShip) -> tuple[Array, Array]:
        """The true t_cam_target_m [3] and R_cam_target [3, 3]."""
        R_cam_ned = (own_ship.R_ned_body @ FORWARD.R_body_cam).T
        camera_m = own_ship.t_ned_body_m + own_ship.R_ned_body @ FORWARD.t_body_cam_m
        bank = np.arctan(30.0 * self.turn_radps / 9.81)
        t_ned_m = self.R_axes @ self.target_m + self.origin_m
        return R_cam_ned @ (t_ned_m - camera_m), R_cam_ned @ self.R_axes @ euler(bank, 0.02, self.yaw)

    def estimate(self, t_cam_m: Array, R_cam_target: Array) -> Estimate:
        own = np.sqrt(COMMON_SHARE) * self.common_error + np.sqrt(1.0 - COMMON_SHARE) * self.rng.normal()
        return seen(self.rng, t_cam_m, R_cam_target, LOG_RANGE_STD * own)


def d2(off: Array, covariance: Array) -> float:
    return float(off @ np.linalg.solve(covariance, off))


def flown(seed: int, legs: list[Leg]) -> Iterator[tuple[Track, Sky, OwnShip, int, Leg]]:
    """Each track as a link would send it, the sky and the own ship at that time, and when the target was seen last."""
    sky, tracker, seen_ns = Sky(np.random.default_rng(seed)), Tracker(3, FORWARD), 0
    for leg in legs:
        sky.happens(leg.before)
        for index in range(leg.frames):
            pause_s = 1.0 if index == 0 and leg.before == "no frames for a second" else 0.0
            sky.fly(leg.step_ms / 1e3 + pause_s, leg.turn_radps)
            own_ship = sky.own_ship()
            now_ns, told = own_ship.time_ns, known(leg.kind, own_ship)
            estimates = [sky.estimate(*sky.in_cam(own_ship))] if sky.rng.random() < leg.seen_share else []
            seen_ns = now_ns if estimates else seen_ns
            tracks = tracker.update(now_ns, estimates, told, K, SIZE_WH)
            report = Report(FrameMeta(0, now_ns, now_ns), K, SIZE_WH, tracks, told)
            for track in (*sendable(report, now_ns, MAX_AGE_MS), *rangeless(report, now_ns, MAX_AGE_MS)):
                yield track, sky, own_ship, seen_ns, leg


def legs(rng: np.random.Generator) -> list[Leg]:
    return [
        Leg(
            rng.choice(["ned", "ned", "ned_relative", "cam"]),
            int(rng.choice([33, 66, 100, 200, 400])),
            int(rng.integers(3, 25)),
            float(rng.choice([1.0, 1.0, 0.8, 0.4, 0.0])),
            float(rng.uniform(-0.25, 0.25)),
            rng.choice(["nothing", "nothing", "other origin", "other north", "no frames for a second"]),
        )
        for _ in range(12)
    ]


@pytest.mark.parametrize("seed", range(20))
def test_what_is_sent_is_where_it_is_told_to_be(seed: int) -> None:
    sent = 0
    for track, sky, own_ship, seen_ns, leg in flown(seed, legs(np.random.default_rng(seed))):
        sent += 1
        assert track.measured_ns <= seen_ns <= track.time_ns == own_ship.time_ns
        t_cam_m, R_cam_target = sky.in_cam(own_ship)
        assert d2(track.t_cam_target_m - t_cam_m, track.covariance[:3, :3]) < D2_MAX
        if rotation_known(track):
            off_rad = Rotation.from_matrix(track.R_cam_target @ R_cam_target.T).as_rotvec()
            assert d2(off_rad, track.covariance[3:, 3:]) < D2_MAX
        assert (track.t_ned_target_m is None) == (leg.kind == "cam")
        if track.t_ned_target_m is None or track.covariance_ned is None or track.v_ned_target_mps is None:
            continue
        t_ned_m, v_ned_mps = sky.R_axes @ sky.target_m + sky.origin_m, sky.R_axes @ sky.v_target_mps
        if leg.kind == "ned_relative":
            t_ned_m, v_ned_mps = t_ned_m - own_ship.t_ned_body_m, v_ned_mps - own_ship.v_ned_body_mps
        assert d2(track.t_ned_target_m - t_ned_m, track.covariance_ned[:3, :3]) < D2_MAX
        assert d2(track.v_ned_target_mps - v_ned_mps, track.covariance_ned[3:6, 3:6]) < D2_MAX
    assert sent > 30
