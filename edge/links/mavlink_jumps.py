"""Jumps of own attitude and position. A change that no flight can cause is a reset of the autopilot's estimator; one
that no motor can cause, a gimbal that lost its reference or was replaced.

Tracks are kept in ned: a jump of the own ship taken for flight would shift every target relative to the camera.
"""

from __future__ import annotations

import numpy as np

from edge.tracking.own_ship import GimbalFrame
from edge.types import Array
from msgs.geometry import rotation_angle, so3_exp, so3_log

POSITION_MIN_M, ACCELERATION_MPS2, POSITION_GAP_MAX_NS = 3.0, 30.0, 2_000_000_000
# Steps of the attitude below its minimum are within the errors that the tracker assumes. Rates that change by at most
# the given acceleration deviate by a quarter of it times dt^2 from the mean of the two that are known.
ATTITUDE_MIN_RAD, TURNING_RADPS2, ATTITUDE_GAP_MAX_NS = 0.05, 50.0, 500_000_000
GIMBAL_MIN_RAD, GIMBAL_RADPS = 0.1, 12.0  # no gimbal turns faster
NS_PER_S = 1e9


class Jumps:
    """Compares each sample with the previous one; times are monotonic ns of the measurement."""

    def __init__(self) -> None:
        self._attitude: tuple[int, Array, Array] | None = None  # time, R_ned_body, rates
        self._position: tuple[int, Array, Array] | None = None  # time, t_ned_m, v_ned_mps
        self._gimbal: tuple[int, Array, GimbalFrame] | None = None  # time, R_frame_gimbal, frame

    def attitude(self, time_ns: int, R_ned_body: Array, rates_radps: Array) -> bool:
        """Whether this attitude [3, 3] is not reachable from the last sample with the body rates [3] of both."""
        last, self._attitude = self._attitude, (time_ns, R_ned_body, rates_radps)
        if last is None or not 0 < time_ns - last[0] <= ATTITUDE_GAP_MAX_NS:
            return False
        dt_s = (time_ns - last[0]) / NS_PER_S
        turned = last[1] @ so3_exp(0.5 * (last[2] + rates_radps) * dt_s)
        return float(rotation_angle(turned, R_ned_body)) > ATTITUDE_MIN_RAD + 0.25 * TURNING_RADPS2 * dt_s**2

    def turning_radps(self, time_ns: int, R_ned_body: Array) -> Array:
        """Mean body rates [3] from the last sample to this one, which is not added; zeros after a gap."""
        if self._attitude is None or not 0 < time_ns - self._attitude[0] <= ATTITUDE_GAP_MAX_NS:
            return np.zeros(3)
        return so3_log(self._attitude[1].T @ R_ned_body) / ((time_ns - self._attitude[0]) / NS_PER_S)

    def gimbal(self, time_ns: int, R_frame_gimbal: Array, frame: GimbalFrame) -> bool:
        """Whether this attitude of the gimbal [3, 3] is not reachable from the last sample in the same frame."""
        last, self._gimbal = self._gimbal, (time_ns, R_frame_gimbal, frame)
        if last is None or last[2] is not frame or not 0 < time_ns - last[0] <= ATTITUDE_GAP_MAX_NS:
            return False
        dt_s = (time_ns - last[0]) / NS_PER_S
        return float(rotation_angle(last[1], R_frame_gimbal)) > GIMBAL_MIN_RAD + GIMBAL_RADPS * dt_s

    def position(self, time_ns: int, t_ned_m: Array, v_ned_mps: Array) -> bool:
        """Whether this position [3] is not reachable from the last sample with the velocities [3] of both."""
        last, self._position = self._position, (time_ns, t_ned_m, v_ned_mps)
        if last is None or not 0 < time_ns - last[0] <= POSITION_GAP_MAX_NS:
            return False
        dt_s = (time_ns - last[0]) / NS_PER_S
        off_m = float(np.linalg.norm(t_ned_m - last[1] - 0.5 * (last[2] + v_ned_mps) * dt_s))
        return off_m > POSITION_MIN_M + 0.5 * ACCELERATION_MPS2 * dt_s**2
