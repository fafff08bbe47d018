"""A sequence flown faster or slower than its original speed, on the real clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sim_replay.gimbal import GimbalTrack
from sim_replay.ground_truth import PlayedSequence
from sim_replay.telemetry import FLOWN_CSV, Telemetry, read_telemetry, write_telemetry


def at_speed(sequence: PlayedSequence, speed: float, folder: Path) -> PlayedSequence:
    """The same flight `speed` times as fast: frames closer together, own ship and gimbal turn and move faster.

    Its telemetry is written into `folder`.
    """
    telemetry = read_telemetry(sequence.telemetry_csv)
    values = telemetry.values.copy()
    values[:, np.r_[4:7, 10:13]] *= speed  # rates, velocity
    path = folder / FLOWN_CSV
    write_telemetry(path, Telemetry(_scaled_ns(telemetry.t_ns, sequence.frame0_ns, speed), values))
    track = sequence.gimbal
    gimbal = track and GimbalTrack(_scaled_ns(track.t_ns, sequence.frame0_ns, speed), track.q_ned_gimbal_wxyz)
    return replace(sequence, fps=sequence.fps * speed, telemetry_csv=path, frame0_ns=0, gimbal=gimbal)


def _scaled_ns(t_ns: np.ndarray, frame0_ns: int, speed: float) -> np.ndarray:
    """Times [N] int64 on a clock that is 0 at the first exposure and runs `speed` times as fast."""
    return np.round((t_ns - frame0_ns) / speed).astype(np.int64)
