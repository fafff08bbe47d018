"""All attitudes of the vehicle over a measurement, as the link tells them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edge.tracking.own_ship import ATTITUDE_GAP_MAX_NS, LONG_AGO_NS, OwnShipBuffer
from edge.types import Array
from msgs.geometry import R_from_q_wxyz, slerp, so3_exp, so3_log

REACH, STEP_MIN_NS = 3, 2_000_000  # samples on each side that an attitude is smoothed with, and their finest grid
LOOKED_NS = 200_000_000  # shorter, the noise of the attitudes would add up


@dataclass(frozen=True, eq=False)
class Attitudes:
    """N samples in order of time."""

    times_ns: np.ndarray  # [N] int64, monotonic
    R_ned_body: Array  # [N, 3, 3]
    epoch: np.ndarray  # [N] int: between samples of different epochs, the axes may have changed
    clock_std_s: float = 0.0  # of `times_ns`, all in common

    def at(self, times_ns: ArrayLike) -> tuple[Array, np.ndarray]:
        """R_ned_body [M, 3, 3] at times [M], as the daemon interpolates it, and the epochs [M]; -1: not known."""
        wanted = np.asarray(times_ns, dtype=np.float64)
        if len(self.times_ns) < 2:
            return np.broadcast_to(np.eye(3), (len(wanted), 3, 3)), np.full(len(wanted), -1)
        after = np.clip(np.searchsorted(self.times_ns, wanted, side="right"), 1, len(self.times_ns) - 1)
        since_ns, gap_ns = wanted - self.times_ns[after - 1], self.times_ns[after] - self.times_ns[after - 1]
        known = (since_ns >= 0) & (since_ns <= gap_ns) & (gap_ns <= ATTITUDE_GAP_MAX_NS)
        known &= self.epoch[after] == self.epoch[after - 1]
        share = np.where(known, since_ns / gap_ns, 0.0)
        R = slerp(self.R_ned_body[after - 1], self.R_ned_body[after], share)
        return R, np.where(known, self.epoch[after], -1)

    def smoothed(self) -> Attitudes:
        """The same on a grid that is finer than the samples: a parabola through the samples around each time.

        Between two samples, interpolation alone halves the noise of both. Where camera and autopilot run in step, the
        least is then left of the turns if all pictures lie there, wherever they were taken.
        """
        if len(self.times_ns) < 2:
            return self
        gap_ns = self.usual_gap_ns
        grid_ns = np.arange(self.times_ns[0], self.times_ns[-1], max(gap_ns / 4.0, STEP_MIN_NS))
        R, epoch = self.at(grid_ns)
        grid_ns, R, epoch = grid_ns[epoch >= 0], R[epoch >= 0], epoch[epoch >= 0]
        after = np.searchsorted(self.times_ns, grid_ns, side="right")
        near = after[:, None] + np.arange(-REACH, REACH)
        there = (near >= 0) & (near < len(self.times_ns))
        near = near.clip(0, len(self.times_ns) - 1)
        u = (self.times_ns[near] - grid_ns[:, None]) / (REACH * gap_ns)
        weights = np.where(
            there & (self.epoch[near] == epoch[:, None]), (1.0 - np.minimum(np.abs(u), 1.0) ** 3) ** 3, 0.0
        )
        off_rad = so3_log(R.swapaxes(-1, -2)[:, None] @ self.R_ned_body[near])
        powers = np.stack([np.ones_like(u), u, u * u], axis=-1)
        normal = np.einsum("mk,mki,mkj->mij", weights, powers, powers) + np.diag([1e-9, 1e-6, 1e-3])
        found = np.linalg.solve(normal, np.einsum("mk,mki,mkx->mix", weights, powers, off_rad))
        return Attitudes(np.round(grid_ns).astype(np.int64), R @ so3_exp(found[:, 0]), epoch, self.clock_std_s)

    def turned_rad(self) -> Array:
        """[3], sizes of the turns about the body's axes added up."""
        if len(self.times_ns) < 2:
            return np.zeros(3)
        R, epoch = self.at(np.arange(self.times_ns[0], self.times_ns[-1], LOOKED_NS))
        known = (epoch[:-1] >= 0) & (epoch[:-1] == epoch[1:])
        return np.asarray(np.abs(so3_log(R[:-1].swapaxes(-1, -2) @ R[1:])[known]).sum(axis=0))

    @property
    def usual_gap_ns(self) -> float:
        """The median interval between samples; infinite if there are none."""
        return float(np.median(np.diff(self.times_ns))) if len(self.times_ns) > 1 else np.inf


class AttitudeLog(OwnShipBuffer):
    """An own-ship buffer that forgets no attitude."""

    def __init__(self) -> None:
        super().__init__()
        self._all: list[tuple[int, tuple[float, ...], int, float]] = []
        self._epoch = 0

    def add_attitude(
        self, time_ns: int, q_ned_body_wxyz: ArrayLike, rates_body_radps: ArrayLike, clock_std_s: float = 0.0
    ) -> bool:
        added = super().add_attitude(time_ns, q_ned_body_wxyz, rates_body_radps, clock_std_s)
        if added and (not self._all or time_ns > self._all[-1][0]):
            q_wxyz = tuple(np.asarray(q_ned_body_wxyz, dtype=np.float64).tolist())
            self._all.append((time_ns, q_wxyz, self._epoch, clock_std_s))
        return added

    def clear(self, *, same_axes: bool = False, same_autopilot: bool = False, until_ns: int = LONG_AGO_NS) -> None:
        super().clear(same_axes=same_axes, same_autopilot=same_autopilot, until_ns=until_ns)
        self._epoch += not same_axes

    @property
    def heard(self) -> bool:
        """Whether any has come."""
        return bool(self._all)

    def attitudes(self) -> Attitudes:
        """All so far. From any thread."""
        rows = list(self._all)
        times_ns = np.array([row[0] for row in rows], dtype=np.int64)
        R_ned_body = R_from_q_wxyz(np.array([row[1] for row in rows]).reshape(-1, 4)).reshape(-1, 3, 3)
        clock_std_s = float(np.median([row[3] for row in rows])) if rows else 0.0
        return Attitudes(times_ns, R_ned_body, np.array([row[2] for row in rows], dtype=np.int64), clock_std_s)
