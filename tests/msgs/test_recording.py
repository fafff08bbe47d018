"""Recordings as mcap's own reader and rosbags read them, after kills too."""

from __future__ import annotations

import fcntl
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag2 import Reader

from msgs import mcap_file, recording, topics
from msgs.definitions import definition
from msgs.mcap_file import McapFile, Publisher, finish_unfinished
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from tests.waiting import until

from . import make_definitions
from .conftest import pose_now
from .recordings import ROOM, read, record_some
from .ros_oracle import STORE, deserialize, serialize


def is_whole(path: Path) -> bool:
    """Whether its end has been written."""
    return path.stat().st_size > 500 and path.read_bytes().endswith(MCAP0_MAGIC)


def test_definitions_are_those_of_the_interfaces() -> None:
    assert make_definitions.PATH.read_text() == make_definitions.interfaces()
    for topic in topics.TOPICS:
        assert definition(topic.ros_type) == make_definitions.whole_definition(topic.ros_type)


def test_a_recording_holds_the_bytes_that_were_sent_and_ros_reads_them(tmp_path: Path) -> None:
    told: list[tuple[int, str]] = []
    recorder = Recorder(tmp_path / "new", "uav1", ROOM, lambda *event: told.append(event))
    recorder.start()
    payloads = [pose_now(z).encode() for z in (250.0, 251.0, 252.0)]
    record_some(recorder, payloads)
    recorder.record(topics.EVENTS, "uav1", None, b"an event", time.time_ns())
    recorder.stop()
    (path,) = (tmp_path / "new").iterdir()
    came = read(path)
    assert [data for topic, _, data, _ in came if topic == "/uav1/target/t0/pose"] == payloads
    assert Counter(topic for topic, *_ in came) == {"/uav1/target/t0/pose": 3, "/uav1/events": 1}
    assert recorder.counters() == {"recorded": 4}
    assert told == []
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None
    for schema in summary.schemas.values():
        assert (schema.encoding, schema.data.decode()) == (
            "ros2msg",
            STORE.generate_msgdef(schema.name, ros_version=2)[0],
        )
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    message = deserialize(came[0][2], came[0][1])
    assert serialize(message) == payloads[0]


WRITER = """
import sys, time
from pathlib import Path
from msgs import topics
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
recorder = Recorder(Path(sys.argv[1]), "uav1", RecordingLimits(free_bytes_min=0), print)
recorder.start()
PERIOD_S = 0.005
n = 0
while True:
    recorder.record(topics.EVENTS, "uav1", None, n.to_bytes(4, "little"), time.time_ns())
    n += 1
    print(n, recorder.counters()["recorded"], flush=True)
    time.sleep(PERIOD_S)
"""


def test_a_killed_recorder_loses_at_most_a_second_and_the_next_start_makes_the_file_whole(tmp_path: Path) -> None:
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    on_disk = 0
    try:
        for line in writer.stdout:
            on_disk = int(line.split()[1])
            if on_disk >= 100:
                break
    finally:
        writer.kill()
        writer.wait()
    (path,) = tmp_path.iterdir()
    torn = path.read_bytes()
    # As a kill in the middle of a write leaves it.
    path.write_bytes(torn + b"\x06" + (1000).to_bytes(8, "little") + b"half of a chunk")
    recorder = Recorder(tmp_path, "uav1", ROOM, print)
    recorder.start()
    recorder.record(topics.EVENTS, "uav1", None, b"next", time.time_ns())
    recorder.stop()
    numbers = [int.from_bytes(data, "little") for *_, data, _ in read(path)]
    assert len(numbers) >= on_disk
    assert numbers == list(range(len(numbers)))
    first, second = sorted(tmp_path.iterdir())
    assert (first, [data for *_, data, _ in read(second)]) == (path, [b"next"])


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    file = McapFile(tmp_path / "whole.mcap")
    for n in range(3):
        file.write("uav1/events", "rcl_interfaces/msg/Log", bytes([n]), n, n)
        file.flush()
    file.close()
    return (tmp_path / "whole.mcap").read_bytes()


def test_a_file_cut_anywhere_is_readable_once_finished(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "cut.mcap"
    lengths = []
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size] + bytes(size % 3 * 50))
        assert finish_unfinished(path)
        lengths.append(len(read(path)) if path.exists() else 0)
        if path.exists():
            assert not finish_unfinished(path)
    assert lengths == sorted(lengths)
    assert set(lengths) == {0, 1, 2, 3}


def test_a_file_with_zeros_for_what_was_never_written_is_readable_once_finished(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "torn.mcap"
    counts = []
    opening = len(MCAP0_MAGIC) + 9 + int.from_bytes(whole[9:17], "little")  # written whole when recording begins
    for size in range(len(whole)):
        # A hole, where blocks came to the disk in another order, and all that follows.
        for end in (min(size + 40, len(whole)) if size >= opening else len(whole), len(whole)):
            path.write_bytes(whole[:size] + bytes(end - size) + whole[end:-4])
            assert finish_unfinished(path)
            counts.append(len(read(path)) if path.exists() else 0)
    assert counts[1::2] == sorted(counts[1::2])
    assert set(counts) == {0, 1, 2, 3}


@pytest.mark.parametrize("total_bytes_max", [None, 10**9])
def test_a_recording_that_cannot_be_mended_does_not_keep_the_next_from_being_made(
    tmp_path: Path, total_bytes_max: int | None
) -> None:
    broken = tmp_path / "uav1_000000_20260101T000000Z.mcap"
    broken.symlink_to(tmp_path / "nowhere")
    recorder = Recorder(tmp_path, "uav1", replace(ROOM, total_bytes_max=total_bytes_max), print)
    recorder.start()
    recorder.record(topics.EVENTS, "uav1", None, b"next", time.time_ns())
    recorder.stop()
    (made,) = (path for path in tmp_path.iterdir() if path != broken)
    assert [data for *_, data, _ in read(made)] == [b"next"]


@pytest.mark.parametrize("torn", [False, True], ids=["closed", "torn and finished"])
def test_rosbags_reads_it_as_a_ros_2_bag(tmp_path: Path, torn: bool) -> None:
    file = McapFile(tmp_path / "one.mcap")
    payloads = [pose_now(z).encode() for z in (250.0, 251.0)]
    for n, payload in enumerate(payloads):
        file.write("uav1/target/t0/pose", topics.POSE.ros_type, payload, n, n)
        file.flush()
    if torn:
        file.abandon()
    else:
        file.close()
    with Reader(file.path) as bag:
        came = [(one.topic, one.msgtype, stamp_ns, bytes(raw)) for one, stamp_ns, raw in bag.messages()]
    assert came == [("/uav1/target/t0/pose", topics.POSE.ros_type, n, payload) for n, payload in enumerate(payloads)]


def test_a_file_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "live.mcap")
    file.write("uav1/events", "rcl_interfaces/msg/Log", b"a", 1, 1)
    assert not finish_unfinished(file.path)
    file.close()
    assert len(read(file.path)) == 1


def test_files_rotate_by_size_and_the_oldest_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    limits = RecordingLimits(file_bytes_max=20_000, total_bytes_max=60_000, free_bytes_min=0)
    (tmp_path / "of_somebody_else.mcap").write_bytes(bytes(50_000))
    told: list[tuple[int, str]] = []
    recorder = Recorder(tmp_path, "uav1", limits, lambda *event: told.append(event))
    recorder.start()
    sent: list[int] = []

    def step() -> None:
        sent.append(len(sent))
        recorder.record(topics.EVENTS, "uav1", None, sent[-1].to_bytes(4, "little") + bytes(2000), time.time_ns())

    until(lambda: "000008" in "".join(path.name for path in tmp_path.iterdir()), step)
    recorder.stop()
    ours = sorted(path for path in tmp_path.iterdir() if path.name.startswith("uav1_"))
    assert ours[0].name[:11] > "uav1_000000"
    assert sum(path.stat().st_size for path in ours) <= 60_000 + 2 * 20_000
    numbers = [int.from_bytes(data[:4], "little") for path in ours for *_, data, _ in read(path)]
    assert numbers == sent[-len(numbers) :]
    assert (tmp_path / "of_somebody_else.mcap").exists()
    words = re.compile(r"old recordings removed to make room: (\d+), up to uav1_(\d{6})_\w+\.mcap")
    removals = [match for level, text in told if level == 20 and (match := words.fullmatch(text))]
    assert len(removals) == len(told)
    assert sum(int(one[1]) for one in removals) == int(removals[-1][2]) + 1 == int(ours[0].name[5:11])


def test_a_recording_that_another_process_writes_stays_when_the_oldest_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    try:
        next(line for line in writer.stdout if int(line.split()[1]) > 0)
        writer.send_signal(signal.SIGSTOP)  # it holds its file, which no longer grows
        (held,) = tmp_path.iterdir()
        limits = RecordingLimits(file_bytes_max=20_000, total_bytes_max=100_000, free_bytes_min=0)
        recorder = Recorder(tmp_path, "uav1", limits, print)
        recorder.start()
        until(
            lambda: list(tmp_path.glob("uav1_000010_*")),
            lambda: recorder.record(topics.EVENTS, "uav1", None, bytes(2000), time.time_ns()),
        )
        recorder.stop()
    finally:
        writer.kill()
        writer.wait()
    ours = sorted(tmp_path.iterdir())
    assert ours[0] == held
    assert ours[1].name[:11] > "uav1_000001"
    assert sum(path.stat().st_size for path in ours) <= 100_000 + 2 * 20_000
    finish_unfinished(held)
    numbers = [int.from_bytes(data, "little") for *_, data, _ in read(held)]
    assert numbers == list(range(len(numbers)))
    assert numbers


def test_nothing_is_removed_where_that_would_not_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    monkeypatch.setattr(recording, "RETRY_S", 0.02)
    old = [tmp_path / f"uav1_{n:06d}_20260101T000000Z.mcap" for n in range(5)]
    for path in old:
        path.write_bytes(MCAP0_MAGIC + bytes(5000) + MCAP0_MAGIC)
    told: list[tuple[int, str]] = []
    recorder = Recorder(tmp_path, "uav1", RecordingLimits(free_bytes_min=2**62), lambda *event: told.append(event))
    recorder.start()
    record_some(recorder, [b"one"])
    until(lambda: recorder.counters().get("failures", 0) >= 3)
    recorder.stop()
    assert told == [(40, "recording stopped: no room left for recordings")]
    assert sorted(tmp_path.iterdir()) == old


def test_what_a_file_at_the_limit_holds_is_not_counted_as_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    limits = RecordingLimits(total_bytes_max=50_000, free_bytes_min=0, when_full="stop")
    recorder, put = Recorder(tmp_path, "uav1", limits, lambda *_: None), list[bytes]()

    def put_one() -> None:
        put.append(bytes(5000))
        record_some(recorder, put[-1:])

    recorder.start()
    until(lambda: not recorder.recording, put_one, what="the limit")
    recorder.stop()
    held = sum(len(read(path)) for path in tmp_path.iterdir())
    counters = recorder.counters()
    assert counters["recorded"] == held > 5
    assert held + counters.get("lost", 0) == len(put)


def test_a_file_that_another_recorder_removes_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, real_lock, others = tmp_path / "uav1_000000_20260101T000000Z.mcap", fcntl.flock, [finish_unfinished]

    def lock(descriptor: int, operation: int) -> None:
        if others:
            others.pop()(path)
        real_lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", lock)
    file = McapFile(path)
    file.write("uav1/target/t0/pose", topics.POSE.ros_type, b"pose", 1, 1)
    file.close()
    assert [data for *_, data, _ in read(path)] == [b"pose"]


def test_switching_off_ends_the_file_and_on_begins_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    recorder = Recorder(tmp_path, "uav1", ROOM, print)
    recorder.start()
    record_some(recorder, [b"first"])
    until(lambda: recorder.counters()["recorded"] == 1)
    recorder.switch(False)
    (path,) = tmp_path.iterdir()
    until(lambda: is_whole(path))
    record_some(recorder, [b"unheard"])
    recorder.switch(True)
    record_some(recorder, [b"second"])
    recorder.stop()
    assert [data for path in sorted(tmp_path.iterdir()) for *_, data, _ in read(path)] == [b"first", b"second"]
    assert recorder.counters() == {"recorded": 2}


def test_each_file_holds_what_is_told_on_change_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    recorder = Recorder(tmp_path, "uav1", ROOM, print, on=False)
    recorder.start()
    for intrinsics in (b"wide", b"narrow"):
        recorder.record(topics.CAMERA_INFO, "uav1", None, intrinsics, 1)
    for turn in (1, 2):
        recorder.switch(True)
        record_some(recorder, [b"pose"])
        until(lambda turn=turn: recorder.counters()["recorded"] == turn)  # type: ignore[misc]
        recorder.switch(False)
        until(lambda turn=turn: sum(map(is_whole, tmp_path.iterdir())) == turn)  # type: ignore[misc]
    recorder.stop()
    told = [("/uav1/camera_info", b"narrow"), ("/uav1/target/t0/pose", b"pose")]
    assert [[(topic, data) for topic, _, data, _ in read(path)] for path in sorted(tmp_path.iterdir())] == [told, told]


def test_each_file_holds_what_each_of_two_vehicles_of_one_name_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    recorder = Recorder(tmp_path, "ground", ROOM, print, on=False)
    recorder.start()
    for session, intrinsics in (("0a", b"wide"), ("0b", b"narrow")):
        recorder.record(topics.CAMERA_INFO, "uav1", None, intrinsics, 1, Publisher(session, 16 * session))
    recorder.switch(True)
    record_some(recorder, [b"pose"])
    until(lambda: recorder.counters()["recorded"] == 1)
    recorder.stop()
    (path,) = tmp_path.iterdir()
    assert {data for topic, _, data, _ in read(path) if topic == "/uav1/camera_info"} == {b"wide", b"narrow"}


def test_more_publishers_than_a_file_can_number_share_a_channel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "CHANNELS_MAX", 3)
    file = mcap_file.McapFile(tmp_path / "forged.mcap")
    for number in range(9):
        forged = Publisher("0a", f"{number:032x}")
        file.write("uav1/target/t0/pose", topics.POSE.ros_type, bytes([number]), number, number, forged)
    file.close()
    assert [data for _, _, data, _ in read(tmp_path / "forged.mcap")] == [bytes([number]) for number in range(9)]
    with (tmp_path / "forged.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.channels) == 4
