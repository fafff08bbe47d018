"""Recording on a disk that is full, stands still or has no room left."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from msgs import recording, topics
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from tests.waiting import until

from .recordings import ROOM, read, record_some, standing, turns


def test_a_full_disk_is_told_once_and_recording_goes_on_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "RETRY_S", 0.05)
    told: list[tuple[int, str]] = []
    folder = tmp_path / "disk"
    folder.mkdir()
    recorder = Recorder(folder, "uav1", ROOM, lambda *event: told.append(event))
    recorder.start()
    sent: list[bytes] = []

    def put(payload: bytes) -> None:
        sent.append(payload)
        record_some(recorder, sent[-1:])

    put(b"before")
    recorder.record(topics.CAMERA_INFO, "uav1", None, b"camera", 1)  # each file repeats it
    until(lambda: recorder.counters()["recorded"] == 2)
    full = os.open("/dev/full", os.O_WRONLY)
    real_write = os.write
    monkeypatch.setattr(os, "write", lambda _, data: real_write(full, data))
    until(lambda: told != [], lambda: put(b"lost"))
    assert not recorder.recording
    until(lambda: recorder.counters().get("failures", 0) >= 3)
    assert recorder.counters()["stopped"] == 1
    assert told == [(40, "recording stopped: No space left on device")]
    assert caplog.messages == [], "on the ground's terminal, what is logged is printed too"
    monkeypatch.setattr(os, "write", real_write)
    os.close(full)
    until(lambda: len(told) == 2, lambda: put(b"after"))
    assert told[1] == (20, "recording again")
    assert recorder.counters()["stopped"] == 0
    recorded = recorder.counters()["recorded"]
    until(lambda: recorder.counters()["recorded"] > recorded, lambda: put(b"after"))
    recorder.stop()
    assert len(told) == 2, "it was told once"
    first, *_, last = ([data for *_, data, _ in read(path)] for path in sorted(folder.iterdir()))
    assert (sorted(first), last[0], last[-1]) == ([b"before", b"camera"], b"camera", b"after")
    assert b"lost" not in last
    counters = recorder.counters()
    assert counters["recorded"] + counters["lost"] == len(sent) + 1


def test_a_failure_is_forgotten_when_recording_is_switched_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who switches it on again would otherwise be told that the disk takes nothing."""
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    full, real_write = os.open("/dev/full", os.O_WRONLY), os.write
    told: list[str] = []
    recorder = Recorder(tmp_path, "uav1", ROOM, lambda _, text: told.append(text))
    recorder.start()
    monkeypatch.setattr(os, "write", lambda _, data: real_write(full, data))
    until(lambda: told != [], lambda: record_some(recorder, [b"lost"]))
    recorder.switch(False)
    until(lambda: recorder.counters()["stopped"] == 0, what="the failure to be forgotten")
    monkeypatch.setattr(os, "write", real_write)
    os.close(full)
    recorder.switch(True)
    assert recorder.recording
    record_some(recorder, [b"after"])
    recorder.stop()
    assert told == ["recording stopped: No space left on device"], "it was switched on, and goes on from nothing"
    assert [data for path in tmp_path.iterdir() for *_, data, _ in read(path)] == [b"after"]


def test_a_disk_without_locks_is_told_and_costs_no_descriptors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "RETRY_S", 0.02)

    def lock(_descriptor: int, _operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", lock)
    told: list[str] = []
    recorder = Recorder(tmp_path, "uav1", ROOM, lambda _, text: told.append(text))
    recorder.start()
    before = len(os.listdir("/proc/self/fd"))
    until(lambda: recorder.counters().get("failures", 0) >= 10, lambda: record_some(recorder, [b"lost"]))
    recorder.stop()
    assert len(os.listdir("/proc/self/fd")) < before + 5
    assert told == ["recording stopped: No locks available"]
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_somebody_removes_while_it_is_written_is_told_and_another_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writing to it would succeed until it is full, and nothing of that would be left."""
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "RETRY_S", 0.05)
    told: list[str] = []
    folder = tmp_path / "recordings"
    recorder = Recorder(folder, "uav1", ROOM, lambda _, text: told.append(text))
    recorder.start()
    record_some(recorder, [b"before"])
    until(lambda: recorder.counters()["recorded"] == 1)
    shutil.rmtree(folder)
    until(lambda: len(told) == 2, lambda: record_some(recorder, [b"after"]), what="another file")
    recorder.stop()
    assert told == ["recording stopped: its file was removed", "recording again"]
    assert {data for path in folder.iterdir() for *_, data, _ in read(path)} == {b"after"}


def test_recording_goes_on_where_its_messages_reach_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message each time old recordings make room, and nobody reads them any more."""
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    refused: list[str] = []

    def refuse(_: int, text: str) -> None:
        refused.append(text)
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    recorder = Recorder(tmp_path, "uav1", RecordingLimits(5_000, total_bytes_max=15_000, free_bytes_min=0), refuse)
    recorder.start()
    until(lambda: len(refused) >= 3, lambda: record_some(recorder, [bytes(2000)]), what="old recordings to go")
    recorder.stop()
    assert recorder.counters().keys() == {"recorded"}
    assert all("old recordings removed" in one for one in refused)


def test_a_disk_that_stands_still_holds_up_nobody_and_what_was_lost_meanwhile_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "WAITING_MAX", 50)
    stands, goes_on = standing(monkeypatch)
    told: list[tuple[int, str]] = []
    recorder = Recorder(tmp_path, "uav1", ROOM, lambda *event: told.append(event))
    recorder.start()
    try:
        record_some(recorder, [b"before"])
        stands.wait()
        record_some(recorder, [b"kept"] * 50 + [b"lost"] * 20)
        assert recorder.counters()["lost"] == 20
        assert recorder.recording
    finally:
        goes_on.set()
    until(lambda: told != [])
    until(lambda: recorder.counters()["recorded"] == 51)
    record_some(recorder, [b"after"])
    recorder.stop()
    assert told == [(30, "recording has gaps: the disk is too slow, 20 messages were lost")]
    kept = Counter(data for path in tmp_path.iterdir() for *_, data, _ in read(path))
    assert kept == {b"before": 1, b"kept": 50, b"after": 1}


@contextmanager
def one_in_hand_and_three_waiting(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[Recorder, list[tuple[int, str]]]]:
    """A recorder before a disk that stands still, until the end, and what it tells."""
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    stands, goes_on = standing(monkeypatch)
    told: list[tuple[int, str]] = []
    recorder = Recorder(folder, "uav1", ROOM, lambda *event: told.append(event))
    recorder.start()
    try:
        record_some(recorder, [b"in hand"])
        stands.wait()
        record_some(recorder, [b"waiting"] * 3)
        yield recorder, told
    finally:
        goes_on.set()


def test_what_waits_when_the_disk_fails_is_lost_and_counted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "RETRY_S", 0.0)
    sync, broken = os.fdatasync, [True]

    def fail(descriptor: int) -> None:
        sync(descriptor)
        if broken:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fail)
    with one_in_hand_and_three_waiting(tmp_path, monkeypatch) as (recorder, told):
        pass
    until(lambda: told == [(40, "recording stopped: Input/output error")])
    broken.clear()
    until(lambda: recorder.recording)
    record_some(recorder, [b"after"])
    recorder.stop()
    assert [data for path in tmp_path.iterdir() for *_, data, _ in read(path)] == [b"after"]
    assert (recorder.counters()["recorded"], recorder.counters()["lost"]) == (1, 4)


def test_when_room_runs_out_and_nothing_may_go_recording_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the last turn, too, what is lost is counted once."""
    monkeypatch.setattr(recording, "FLUSH_S", 3600.0)
    told: list[tuple[int, str]] = []
    limits = RecordingLimits(free_bytes_min=2**62, when_full="stop")
    recorder = Recorder(tmp_path, "uav1", limits, lambda *event: told.append(event))
    recorder.start()
    record_some(recorder, [b"one"])
    recorder.stop()
    assert told == [(40, "recording stopped: no room left for recordings")]
    assert recorder.counters()["lost"] == 1


def test_a_disk_that_failed_is_tried_again_after_a_while_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "RETRY_S", 3600.0)
    looks = turns(monkeypatch)
    recorder = Recorder(tmp_path, "uav1", RecordingLimits(free_bytes_min=2**62), print)
    recorder.start()
    record_some(recorder, [b"one"])
    until(lambda: not recorder.recording)
    since = len(looks)
    until(lambda: len(looks) >= since + 3)
    recorder.stop()
    assert recorder.counters()["failures"] == 1


def test_nothing_is_written_before_there_is_something_to_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    looks = turns(monkeypatch)
    recorder = Recorder(tmp_path / "rec", "uav1", ROOM, print)
    recorder.start()
    until(lambda: len(looks) >= 3)
    recorder.stop()
    assert not list(tmp_path.rglob("*.mcap"))


def test_what_a_disk_that_stands_still_has_not_taken_at_the_end_is_told_as_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "STOP_TIMEOUT_S", 0.2)
    with one_in_hand_and_three_waiting(tmp_path, monkeypatch) as (recorder, told):
        recorder.stop()
        assert recorder.counters() == {"recorded": 0, "lost": 4}
        assert told == [(30, "recording ended before the disk had taken all: 4 messages may be lost")]


def test_the_writer_does_not_wait_for_the_second_to_end_while_much_is_to_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 3600.0)
    recorder = Recorder(tmp_path, "uav1", ROOM, print)
    recorder.start()
    recorder.record(topics.IMAGE, "uav1", None, bytes(20 * 1024**2), 1)
    until(lambda: recorder.counters()["recorded"] == 1)
    record_some(recorder, [b"pose"] * 1500)
    until(lambda: recorder.counters()["recorded"] > 1000)
    recorder.stop()
    assert recorder.counters() == {"recorded": 1501}
