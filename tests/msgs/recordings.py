"""What tests record, and how they read it back."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from msgs import recording, topics
from msgs.recording import Recorder, Sample
from msgs.recording_store import RecordingLimits

ROOM = RecordingLimits(free_bytes_min=0)


def read(path: Path) -> list[tuple[str, str, bytes, int]]:
    """(topic, schema's name, payload, log time) of each message."""
    with open(path, "rb") as file:
        return [(c.topic, s.name if s else "", m.data, m.log_time) for s, c, m in make_reader(file).iter_messages()]


def record_some(recorder: Recorder, payloads: list[bytes]) -> None:
    for payload in payloads:
        recorder.record(topics.POSE, "uav1", "t0", payload, time.time_ns())


def standing(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Events of a disk: it stands still since something was written, and it goes on."""
    stands, goes_on, real_sync = threading.Event(), threading.Event(), os.fdatasync

    def sync(fd: int) -> None:
        stands.set()
        goes_on.wait()
        real_sync(fd)

    monkeypatch.setattr(os, "fdatasync", sync)
    return stands, goes_on


def turns(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one each time that a recorder's writer looks for samples."""
    looks, split = list[int](), recording._between_clock_steps

    def looked(samples: Iterable[Sample]) -> list[list[Sample]]:
        looks.append(len(looks))
        return split(samples)

    monkeypatch.setattr(recording, "_between_clock_steps", looked)
    return looks
