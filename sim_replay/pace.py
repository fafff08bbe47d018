"""A sequence flown faster or slower than it was made for, on the real clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sim_replay.ground_truth import PlayedSequence
from sim_replay.telemetry import Telemetry, read_telemetry, write_telemetry


def at_speed(sequence: PlayedSequence, speed: float, folder: Path) -> PlayedSequence:
    """The same flight `speed` times as fast: frames closer together, and an own ship that turns and moves faster.

    Its telemetry is written into `folder`.
    """
    telemetry = read_telemetry(sequence.telemetry_csv)
    values = telemetry.values.copy()
    values[:, np.r_[4:7, 10:13]] *= speed  # rates, velocity
    since_frame0_ns = telemetry.t_ns - sequence.frame0_ns
    faster = Telemetry(np.round(since_frame0_ns / speed).astype(np.int64), values)
    path = folder / "telemetry.csv"
    write_telemetry(path, faster)
    return replace(sequence, fps=sequence.fps * speed, telemetry_csv=path, frame0_ns=0)
