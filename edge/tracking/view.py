"""The camera pose in the filter's frame at one instant, and the own ship's errors.

The own ship's errors are typical values for a small aircraft's autopilot, not measurements: the messages give attitude
and position without their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from edge.tracking import so3
from edge.types import Array, Mount, OwnShip

FrameKind = Literal["ned", "ned_relative", "cam"]
NS_PER_S = 1e9

ATTITUDE_JITTER_RAD = 1e-3  # from frame to frame: vibration of the mount, rounding
EXPOSURE_STD_S = 0.005  # of the camera's timestamps; times the turn rate, an error of attitude
RATE_GAP_MAX_S = 0.5  # frames further apart do not give the camera's turn rate

# Slow errors, common to all frames: they move a track in ned, but nothing in `cam`.
TILT_STD_RAD = float(np.deg2rad(0.7))
HEADING_STD_RAD = float(np.deg2rad(2.0))
POSITION_STD_M = 1.5
VELOCITY_STD_MPS = 0.3


@dataclass(frozen=True)
class View:
    """The camera in a frame at one instant."""

    kind: FrameKind
    time_ns: int
    R_frame_cam: Array  # [3, 3]
    t_frame_cam_m: Array  # [3]
    v_frame_cam_mps: Array | None  # [3]; zero in the frames that move with the own ship; None: unknown
    nose_frame: Array | None = None  # [3], the own ship's; None in `cam`
    turning_radps: float = 0.0  # the camera's turn rate
    clock_std_s: float = EXPOSURE_STD_S  # of the exposure time relative to attitude and position
    attitude_std_rad: float = 0.0  # of this frame's attitude, in addition to timing and jitter
    axes_epoch: int = 0  # see OwnShip
    origin_epoch: int = 0

    @classmethod
    def of(cls, time_ns: int, own_ship: OwnShip | None, mount: Mount, before: View | None = None) -> View:
        """`before`: the view of an earlier frame."""
        if own_ship is None:
            return cls("cam", time_ns, so3.IDENTITY, np.zeros(3), np.zeros(3))
        camera = own_ship.camera(mount)
        R_ned_cam = own_ship.R_ned_body @ camera.R_body_cam
        lever_ned_m = own_ship.R_ned_body @ camera.t_body_cam_m
        epochs = own_ship.axes_epoch, own_ship.origin_epoch
        if before is not None and before.axes_epoch != own_ship.axes_epoch:
            before = None
        nose, turning = own_ship.R_ned_body[:, 0], _turning_radps(before, time_ns, R_ned_cam)
        doubts = float(np.hypot(EXPOSURE_STD_S, own_ship.clock_std_s)), own_ship.attitude_std_rad, *epochs
        if own_ship.t_ned_body_m is None:
            return cls("ned_relative", time_ns, R_ned_cam, lever_ned_m, np.zeros(3), nose, turning, *doubts)
        t_m = own_ship.t_ned_body_m + lever_ned_m
        v_mps = own_ship.v_ned_body_mps
        if v_mps is None and before is not None and before.kind == "ned" and before.origin_epoch == epochs[1]:
            v_mps = _moved_mps(before, time_ns, t_m)
        return cls("ned", time_ns, R_ned_cam, t_m, v_mps, nose, turning, *doubts)

    def same_frame(self, other: View) -> bool:
        """Whether both views use the same coordinate frame."""
        if self.kind != other.kind or self.kind == "cam":
            return self.kind == other.kind
        same_origin = self.kind == "ned_relative" or self.origin_epoch == other.origin_epoch
        return same_origin and self.axes_epoch == other.axes_epoch

    def linked_by_cam(self, other: View) -> bool:
        """Whether the two frames have only the camera's axes in common."""
        return "cam" in (self.kind, other.kind) or self.axes_epoch != other.axes_epoch

    @property
    def attitude_variance(self) -> float:
        """Variance of one frame's attitude, rad^2 about each axis; 0 in `cam`, where attitude is not used."""
        if self.kind == "cam":
            return 0.0
        by_clock_rad = self.clock_std_s * self.turning_radps
        return ATTITUDE_JITTER_RAD**2 + by_clock_rad**2 + self.attitude_std_rad**2

    def aim_covariance(self, t_cam_m: Array) -> Array:
        """[3, 3], of a position in `cam` due to the error of this frame's attitude."""
        across = so3.skew(t_cam_m)
        return self.attitude_variance * across @ across.T

    def moved_to(self, time_ns: int) -> View:
        """The same camera later, at constant velocity and attitude."""
        if self.v_frame_cam_mps is None:
            return replace(self, time_ns=time_ns)
        dt_s = (time_ns - self.time_ns) / NS_PER_S
        return replace(self, time_ns=time_ns, t_frame_cam_m=self.t_frame_cam_m + dt_s * self.v_frame_cam_mps)

    def own_ship_covariance(self, t_m: Array, v_mps: Array) -> Array:
        """[9, 9] (position, velocity, rotation), covariance of a target at t_m, v_mps in ned due to own-ship errors.

        First order in the errors of attitude a, position p, velocity u and clock s: the target's position changes by
        a x (t - t_own) + p + u_own s, its velocity by a x (v - v_own) + u, its rotation by a.
        """
        velocity = np.zeros(3) if self.v_frame_cam_mps is None else self.v_frame_cam_mps
        by_attitude = np.concatenate([-so3.skew(t_m - self.t_frame_cam_m), -so3.skew(v_mps - velocity), so3.IDENTITY])
        attitude = np.array([TILT_STD_RAD, TILT_STD_RAD, HEADING_STD_RAD]) ** 2 + self.attitude_variance
        covariance = (by_attitude * attitude) @ by_attitude.T
        if self.kind == "ned":
            covariance[:3, :3] += POSITION_STD_M**2 * so3.IDENTITY + self.clock_std_s**2 * np.outer(velocity, velocity)
            covariance[3:6, 3:6] += VELOCITY_STD_MPS**2 * so3.IDENTITY
        return covariance


def _turning_radps(before: View | None, time_ns: int, R_ned_cam: Array) -> float:
    if before is None or before.kind == "cam":
        return 0.0
    dt_s = (time_ns - before.time_ns) / NS_PER_S
    if not 0.0 < dt_s <= RATE_GAP_MAX_S:
        return 0.0
    return float(np.linalg.norm(so3.log(R_ned_cam @ before.R_frame_cam.T))) / dt_s


def _moved_mps(before: View, time_ns: int, t_frame_cam_m: Array) -> Array | None:
    """Mean velocity [3] of the camera since an earlier view; None after a gap."""
    dt_s = (time_ns - before.time_ns) / NS_PER_S
    return (t_frame_cam_m - before.t_frame_cam_m) / dt_s if 0.0 < dt_s <= RATE_GAP_MAX_S else None


def between(old: View, new: View) -> Array:
    """R_new_old [3, 3] between the frames of two views at one time; ned and ned_relative have the same axes."""
    if old.linked_by_cam(new):
        return new.R_frame_cam @ old.R_frame_cam.T
    return so3.IDENTITY
