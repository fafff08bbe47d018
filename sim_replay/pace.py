"""A sequence flown faster or slower than its original speed, on the real clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sim_replay.gimbal import GimbalTrack
from sim_replay.ground_truth import PlayedSequence
from sim_replay.telemetry import FLOWN_CSV, Telemetry, read_telemetry, write_telemetry

RATES_AND_VELOCITIES = np.r_[4:7, 10:13]  # columns of Telemetry.values


def at_speed(sequence: PlayedSequence, speed: float, folder: Path) -> PlayedSequence:
    """The same flight `speed` times as fast: frames closer together, own ship and gimbal turn and move faster.

    Its telemetry is written into `folder`.
    """
    path = folder / FLOWN_CSV
    write_telemetry(path, sped_up(read_telemetry(sequence.telemetry_csv), sequence.frame0_ns, speed))
    track = sequence.gimbal
    gimbal = track and GimbalTrack(_sooner(track.t_ns, sequence.frame0_ns, speed), track.q_ned_gimbal_wxyz)
    return replace(sequence, fps=sequence.fps * speed, telemetry_csv=path, gimbal=gimbal)


def sped_up(telemetry: Telemetry, frame0_ns: int, speed: float) -> Telemetry:
    """The same path flown `speed` times as fast; the exposure time of the first frame is unchanged."""
    values = telemetry.values.copy()
    values[:, RATES_AND_VELOCITIES] *= speed
    return Telemetry(_sooner(telemetry.t_ns, frame0_ns, speed), values)


def _sooner(t_ns: np.ndarray, frame0_ns: int, speed: float) -> np.ndarray:
    """Times [N] int64 brought `speed` times as near to that of the first exposure."""
    return frame0_ns + np.round((t_ns - frame0_ns) / speed).astype(np.int64)
