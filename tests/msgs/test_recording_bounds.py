"""What a recording keeps in memory and in one file is bounded, and what is within the bounds is not lost."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.reader import make_reader

from msgs import recording, topics
from msgs.mcap_file import Publisher
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from tests.waiting import until

from .recordings import ROOM, read, record_some, standing


def fill_twice(recorder: Recorder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice, while the disk stands still, give it three pictures of 1000 bytes to keep and two for which there is no
    room, where 3500 bytes may wait."""
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "WAITING_BYTES_MAX", 3500)
    recorder.start()
    try:
        for turn in (1, 2):
            stands, goes_on = standing(monkeypatch)
            record_some(recorder, [b"before"])  # opens the file; whether it is waiting or in hand, three have room
            assert stands.wait(60)
            for name in (b"kept", b"kept", b"kept", b"lost", b"lost"):
                recorder.record(topics.IMAGE, "uav1", None, name + bytes(996), 1)
            assert recorder.counters()["lost"] == 2 * turn
            goes_on.set()
            until(lambda written=4 * turn: recorder.counters()["recorded"] == written)  # type: ignore[misc]
    finally:
        goes_on.set()
        recorder.stop()


def test_pictures_wait_for_a_disk_up_to_so_many_bytes_each_time_it_stands_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_twice(Recorder(tmp_path, "uav1", ROOM, lambda *_: None), monkeypatch)
    kept = Counter(data[:4] for path in tmp_path.iterdir() for *_, data, _ in read(path))
    assert kept == {b"befo": 2, b"kept": 6}


@pytest.mark.parametrize(("gaps_s", "warnings"), [(0.0, 2), (3600.0, 1)])
def test_a_disk_that_is_too_slow_is_told_again_only_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gaps_s: float, warnings: int
) -> None:
    monkeypatch.setattr(recording, "GAPS_S", gaps_s)
    told: list[str] = []
    fill_twice(Recorder(tmp_path, "uav1", ROOM, lambda _, text: told.append(text)), monkeypatch)
    assert told == ["recording has gaps: the disk is too slow, 2 messages were lost"] * warnings


def test_a_writer_that_was_woken_to_be_switched_rests_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until its second ends, which lasts an hour here, or much is to be written."""
    syncs, real_sync = list[int](), os.fdatasync

    def sync(fd: int) -> None:
        syncs.append(fd)
        real_sync(fd)

    monkeypatch.setattr(os, "fdatasync", sync)
    monkeypatch.setattr(recording, "FLUSH_S", 3600.0)
    recorder = Recorder(tmp_path, "uav1", ROOM, print)
    recorder.start()
    record_some(recorder, [b"pose"])
    recorder.switch(True)
    until(lambda: recorder.counters()["recorded"] == 1)
    recorder.record(topics.IMAGE, "uav1", None, bytes(20 * 1024**2), 1)
    until(lambda: recorder.counters()["recorded"] == 2)
    assert len(syncs) == 2
    recorder.stop()


def test_made_up_names_fill_no_memory_and_do_not_push_out_what_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of topics that are told on change alone the last is kept of so many vehicles, and is kept up to date."""
    monkeypatch.setattr(recording, "STANDING_MAX", 2)
    recorder = Recorder(tmp_path, "ground", ROOM, print, on=False)
    recorder.start()
    for name, intrinsics in (("uav1", b"wide"), ("uav2", b"long"), ("forged", b"none"), ("uav1", b"narrow")):
        recorder.record(topics.CAMERA_INFO, name, None, intrinsics, 1)
    recorder.switch(True)
    record_some(recorder, [b"pose"])
    recorder.stop()
    (path,) = tmp_path.iterdir()
    told = {(topic, data) for topic, _, data, _ in read(path)}
    assert told == {
        ("/uav1/camera_info", b"narrow"), ("/uav2/camera_info", b"long"), ("/uav1/target/t0/pose", b"pose"),
    }  # fmt: skip


@pytest.mark.parametrize(("seconds_max", "files"), [(0.0, 3), (3600.0, 1)])
def test_a_file_ends_when_it_has_lasted_as_long_as_one_may(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds_max: float, files: int
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    limits = RecordingLimits(file_seconds_max=seconds_max, free_bytes_min=0)
    recorder = Recorder(tmp_path, "uav1", limits, print)
    recorder.start()
    for count in (1, 2, 3):
        record_some(recorder, [b"pose"])
        until(lambda count=count: recorder.counters()["recorded"] == count)  # type: ignore[misc]
    recorder.stop()
    assert [len(read(path)) for path in tmp_path.iterdir()] == [3 // files] * files


@pytest.mark.parametrize(("step_ns", "files"), [(400_000_000, 1), (-400_000_000, 1), (600_000_000, 2)])
def test_a_clock_that_is_slewed_does_not_cut_a_recording_and_one_that_steps_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_ns: int, files: int
) -> None:
    ahead_ns = [0]
    clock = SimpleNamespace(time_ns=lambda: time.time_ns() + ahead_ns[-1], monotonic_ns=time.monotonic_ns)
    monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=time.monotonic, **vars(clock)))
    recorder = Recorder(tmp_path, "uav1", ROOM, lambda *_: None)
    recorder.start()
    record_some(recorder, [b"pose"])
    ahead_ns.append(step_ns)
    record_some(recorder, [b"pose"])
    recorder.stop()
    assert [len(read(path)) for path in tmp_path.iterdir()] == [2 // files] * files


def test_each_sample_keeps_when_and_by_whom_it_was_published(tmp_path: Path) -> None:
    recorder, publisher = Recorder(tmp_path, "ground", ROOM, print), Publisher("0a", 16 * "0a")
    before_ns = time.time_ns()
    recorder.start()
    recorder.record(topics.POSE, "uav1", "t0", b"pose", 123, publisher)
    recorder.stop()
    (path,) = tmp_path.iterdir()
    with path.open("rb") as file:
        ((_, channel, message),) = make_reader(file).iter_messages()
    assert message.publish_time == 123
    assert before_ns <= message.log_time <= time.time_ns()
    assert channel.metadata == {"zenoh_session": "0a", "gid": 16 * "0a"}
