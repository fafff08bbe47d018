"""Places two flights relative to each other: range at the middle exactly as planned, aspect as drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msgs.geometry import so3_exp
from sim_replay.flight.track import Array, Mask, Track

ELEVATION_LIMIT_RAD = np.radians(38.0)


@dataclass(frozen=True)
class Layouts:
    """M ways to place a second flight relative to a first: rotate it about the vertical, then move it."""

    yaw_rad: Array  # [M] rotation of the second flight
    offset_ned_m: Array  # [M, 3] from first to second at mid sequence

    @property
    def R_ned_turned(self) -> Array:
        """[M, 3, 3] rotation of the second flight about the vertical."""
        return so3_exp(np.stack([0 * self.yaw_rad, 0 * self.yaw_rad, self.yaw_rad], axis=-1))

    def relative_m(self, first: Track, second: Track, middle: int) -> Array:
        """Second minus first [M, N, 3] in NED at the tracks' common times; they are placed at sample `middle`."""
        along = second.t_ned_body_m - second.t_ned_body_m[middle]
        passed = first.t_ned_body_m - first.t_ned_body_m[middle]
        return self.offset_ned_m[:, None] + np.einsum("mij,nj->mni", self.R_ned_turned, along) - passed

    def only(self, k: int) -> Layouts:
        """Layout `k` alone, M = 1."""
        return Layouts(self.yaw_rad[k : k + 1], self.offset_ned_m[k : k + 1])

    def laid(self, k: int, first: Track, second: Track, middle_s: float) -> Track:
        """The second flight in the first one's axes, in layout `k`."""
        turned = second.turned(float(self.yaw_rad[k]))
        goal = first.at(np.array([middle_s])).t_ned_body_m[0] + self.offset_ned_m[k]
        return turned.moved(goal - turned.at(np.array([middle_s])).t_ned_body_m[0])


def draw_layouts(rng: np.random.Generator, count: int, range_m: float) -> Layouts:
    """Half with a random heading relative to the first flight's, half nearly parallel; seen from random directions."""
    parallel = rng.random(count) < 0.5
    yaw = np.where(parallel, rng.normal(0.0, 0.12, count), rng.uniform(-np.pi, np.pi, count))
    azimuth = rng.uniform(-np.pi, np.pi, count)
    elevation = np.arcsin(rng.uniform(-np.sin(ELEVATION_LIMIT_RAD), np.sin(ELEVATION_LIMIT_RAD), count))
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)], axis=-1
    )
    return Layouts(yaw, range_m * direction)


def flyable(relative_m: Array, near_m: float, far_m: float) -> Mask:
    """Whether layouts [M] keep within the limits of range and elevation at all times of `relative_m` [M, N, 3]."""
    range_m = np.linalg.norm(relative_m, axis=-1)
    steepest = np.abs(relative_m[..., 2]) <= np.sin(ELEVATION_LIMIT_RAD) * range_m
    kept: Mask = np.all((range_m >= near_m) & (range_m <= far_m) & steepest, axis=1)
    return kept


def seen_from(layouts: Layouts, second: Track, middle: int) -> Array:
    """Directions [M, 3], in the second aircraft's body axes, from which the first one sees it at mid sequence."""
    direction = -layouts.offset_ned_m / np.linalg.norm(layouts.offset_ned_m, axis=-1, keepdims=True)
    return np.einsum("mij,mi->mj", layouts.R_ned_turned @ second.R_ned_body[middle], direction)


def draw_aspect(rng: np.random.Generator) -> Array:
    """A direction [3] in body axes to be seen from: any azimuth, up to 40 degrees above and below."""
    azimuth = rng.uniform(-np.pi, np.pi)
    elevation = np.arcsin(rng.uniform(-0.64, 0.64))
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)])
