"""A flown path: attitude, position, velocity and rates over time, interpolated at any time between samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs.geometry import slerp, so3_exp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Track:
    """N states of one body (FRD) in local NED; `t_s` increases."""

    t_s: Array  # [N]
    R_ned_body: Array  # [N, 3, 3]
    t_ned_body_m: Array  # [N, 3]
    v_ned_body_mps: Array  # [N, 3]
    rates_body_radps: Array  # [N, 3], p q r

    def at(self, t_s: Array) -> Track:
        """The states at times [M]: slerp, and the cubic Hermite curve through positions and velocities.

        Raises ValueError for a time outside the track.
        """
        wanted = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        slack = 1e-9
        if wanted.size and (wanted.min() < self.t_s[0] - slack or wanted.max() > self.t_s[-1] + slack):
            raise ValueError(f"the track holds {self.t_s[0]:.3f} to {self.t_s[-1]:.3f} s")
        i, share, step = spans(self.t_s, wanted)
        u, h = share[:, None], step[:, None]
        p0, p1 = self.t_ned_body_m[i], self.t_ned_body_m[i + 1]
        v0, v1 = self.v_ned_body_mps[i], self.v_ned_body_mps[i + 1]
        rise = (p1 - p0) / h
        position = p0 + h * u * (v0 + u * (3 * rise - 2 * v0 - v1 + u * (v0 + v1 - 2 * rise)))
        velocity = v0 + u * (2 * (3 * rise - 2 * v0 - v1) + 3 * u * (v0 + v1 - 2 * rise))
        rates = (1 - u) * self.rates_body_radps[i] + u * self.rates_body_radps[i + 1]
        return Track(wanted, slerp(self.R_ned_body[i], self.R_ned_body[i + 1], share), position, velocity, rates)

    def turned(self, yaw_rad: float) -> Track:
        """The same flight with the world rotated by `yaw_rad` about down: gravity and height are unchanged."""
        R = so3_exp([0.0, 0.0, yaw_rad])
        return Track(
            self.t_s, R @ self.R_ned_body, self.t_ned_body_m @ R.T, self.v_ned_body_mps @ R.T, self.rates_body_radps
        )

    def moved(self, t_ned_m: Array, v_ned_mps: Array | None = None) -> Track:
        """The same flight shifted by [3], in an air mass that has drifted at `v_ned_mps` [3] since t = 0."""
        drift = np.zeros(3) if v_ned_mps is None else v_ned_mps
        position = self.t_ned_body_m + t_ned_m + self.t_s[:, None] * drift
        return Track(self.t_s, self.R_ned_body, position, self.v_ned_body_mps + drift, self.rates_body_radps)


def spans(grid: Array, t: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """For times [M] on an increasing grid [N]: index of the sample before, fraction to the next, step; each [M]."""
    i = np.clip(np.searchsorted(grid, t, side="right") - 1, 0, len(grid) - 2)
    step = grid[i + 1] - grid[i]
    return i, np.clip((t - grid[i]) / step, 0.0, 1.0), step
