"""What tests record, and how they read it back."""

from __future__ import annotations

import time
from pathlib import Path

from mcap.reader import make_reader

from msgs import topics
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits

ROOM = RecordingLimits(free_bytes_min=0)


def read(path: Path) -> list[tuple[str, str, bytes, int]]:
    """(topic, schema's name, payload, log time) of each message."""
    with open(path, "rb") as file:
        return [(c.topic, s.name if s else "", m.data, m.log_time) for s, c, m in make_reader(file).iter_messages()]


def record_some(recorder: Recorder, payloads: list[bytes]) -> None:
    for payload in payloads:
        recorder.record(topics.POSE, "uav1", "t0", payload, time.time_ns())
