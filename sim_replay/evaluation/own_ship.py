"""The own-ship pose as an autopilot would report it: with the errors that the tracker allows for. Pure."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from edge.tracking.view import (
    ATTITUDE_JITTER_RAD,
    EXPOSURE_STD_S,
    HEADING_STD_RAD,
    POSITION_STD_M,
    TILT_STD_RAD,
)
from msgs.geometry import Array, so3_exp


@dataclass(frozen=True, eq=False)
class OwnShipErrors:
    """The errors of one flight: attitude, position and clock have constant offsets, attitude also has jitter.

    Each is drawn from a normal distribution with the standard deviation defined in edge.tracking.view.
    """

    rng: np.random.Generator
    attitude_rad: Array  # [3], about north, east, down
    position_m: Array  # [3], ned
    clock_s: float  # delay of the own ship's timestamps

    @classmethod
    def of_flight(cls, name: str) -> OwnShipErrors:
        """The same for the same name."""
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        return cls(
            rng,
            rng.normal(scale=[TILT_STD_RAD, TILT_STD_RAD, HEADING_STD_RAD]),
            rng.normal(scale=POSITION_STD_M, size=3),
            float(rng.normal(scale=EXPOSURE_STD_S)),
        )

    def attitude(self, R_ned_body: Array, turning_radps: Array) -> Array:
        """R_ned_body [3, 3] as reported, of a body that turns at `turning_radps` [3], ned axes."""
        jitter_rad = self.rng.normal(scale=ATTITUDE_JITTER_RAD, size=3)
        return so3_exp(self.attitude_rad) @ so3_exp(jitter_rad + self.clock_s * turning_radps) @ R_ned_body

    def position(self, t_ned_m: Array, velocity_mps: Array) -> Array:
        """Position [3] as reported, of a body at t_ned_m that moves at `velocity_mps`, ned."""
        return t_ned_m + self.position_m + self.clock_s * velocity_mps
