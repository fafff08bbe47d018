"""A sequence's gimbal attitude: from the camera's attitude at every frame, and as `gimbal.csv` for the autopilot.

The gimbal's axes are FRD when it looks ahead; the camera is mounted upright, looking along its x axis.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msgs.geometry import R_FORWARD_CAM, Array, R_from_q_wxyz, q_wxyz_from_R, slerp
from sim_replay.telemetry import TelemetryError

COLUMNS = ("t_ns", "q_ned_gimbal_w", "q_ned_gimbal_x", "q_ned_gimbal_y", "q_ned_gimbal_z")


@dataclass(frozen=True, eq=False)
class GimbalTrack:
    """N attitudes over time; `t_ns` is on the clock of the sequence's telemetry and increases."""

    t_ns: np.ndarray  # [N] int64
    q_ned_gimbal_wxyz: Array  # [N, 4]

    def at(self, t_ns: int) -> Array:
        """[4] at `t_ns`, by slerp between neighbours; constant before the first and after the last."""
        if t_ns <= self.t_ns[0] or t_ns >= self.t_ns[-1]:
            return self.q_ned_gimbal_wxyz[0 if t_ns <= self.t_ns[0] else -1]
        i = int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1
        share = float(t_ns - self.t_ns[i]) / float(self.t_ns[i + 1] - self.t_ns[i])
        R_a, R_b = R_from_q_wxyz(self.q_ned_gimbal_wxyz[i : i + 2])
        return q_wxyz_from_R(slerp(R_a, R_b, share))


def track_of(
    R_cam_ned: Sequence[Array], frame0_ns: int, fps: float, frames: Sequence[int] | None = None
) -> GimbalTrack:
    """The gimbal that gives the camera this attitude at each frame; R_cam_ned [3, 3] for each, as in cam_R_w2c.

    `frames` has their numbers, increasing; None: all from 0.
    """
    numbers = np.arange(len(R_cam_ned)) if frames is None else np.asarray(frames)
    t_ns = frame0_ns + np.round(numbers * 1e9 / fps).astype(np.int64)
    q_wxyz = [q_wxyz_from_R(R.T @ R_FORWARD_CAM.T) for R in R_cam_ned]
    return GimbalTrack(t_ns, np.array(q_wxyz))


def looped(track: GimbalTrack, frame0_ns: int, period_s: float, rounds: int) -> GimbalTrack:
    """The part that belongs to the frames, repeated; t_ns is 0 at the exposure of the first frame."""
    t_ns, period_ns = track.t_ns - frame0_ns, round(period_s * 1e9)
    inside = (t_ns >= 0) & (t_ns < period_ns)
    times = [t_ns[inside] + turn * period_ns for turn in range(rounds)]
    return GimbalTrack(np.concatenate(times), np.concatenate([track.q_ned_gimbal_wxyz[inside]] * rounds))


def write_gimbal(path: Path, track: GimbalTrack) -> None:
    """Write `gimbal.csv`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for t_ns, q_wxyz in zip(track.t_ns, track.q_ned_gimbal_wxyz, strict=True):
            writer.writerow([int(t_ns), *(f"{value:.9f}" for value in q_wxyz)])


def read_gimbal(path: Path) -> GimbalTrack:
    """Read `gimbal.csv`. Raises TelemetryError."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        t_ns = np.array([int(row[0]) for row in rows], dtype=np.int64)
        q_wxyz = np.array([[float(value) for value in row[1:5]] for row in rows]).reshape(-1, 4)
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, IndexError) as error:
        raise TelemetryError(f"{path}: does not hold a time and a quaternion in every line") from error
    unit = np.isfinite(q_wxyz).all() and np.allclose(np.linalg.norm(q_wxyz, axis=1), 1.0, atol=1e-3)
    if tuple(header) != COLUMNS or len(rows) < 2 or not (np.diff(t_ns) > 0).all() or not unit:
        raise TelemetryError(f"{path}: holds no unit quaternions at rising times under {','.join(COLUMNS)}")
    return GimbalTrack(t_ns, q_wxyz)
