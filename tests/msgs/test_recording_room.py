"""How much of the disk recordings take."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from msgs.mcap_file import McapFile
from msgs.recording_store import RecordingLimits, Store

FILE_BYTES = 25_000

# No file may grow beyond what a recording begins with, until four tries have failed.
NO_ROOM_FOR_MORE = """
import json, resource, sys, time
from pathlib import Path
from msgs import recording, topics
from msgs.recording_store import RecordingLimits

recording.FLUSH_S, recording.RETRY_S = 0.02, 0.05
told = []
recorder = recording.Recorder(
    Path(sys.argv[1]), "uav1", RecordingLimits(free_bytes_min=0), lambda _, text: told.append(text)
)
recorder.start()

def feed_until(done):
    deadline_s = time.monotonic() + 60
    while not done() and time.monotonic() < deadline_s:
        recorder.record(topics.CAMERA_INFO, "uav1", None, b"standing", time.time_ns())
        recorder.record(topics.POSE, "uav1", "t0", bytes(5000), time.time_ns())
        time.sleep(0.01)

_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, most))
feed_until(lambda: recorder.counters().get("failures", 0) >= 4)
while_full = list(told)
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
feed_until(lambda: "recording again" in told[len(while_full):])
recorder.stop()
print(json.dumps([while_full, told]))
"""


def test_the_newest_recording_counts_towards_what_all_may_take(tmp_path: Path) -> None:
    files = [tmp_path / f"uav1_{n:06d}_20260101T000000Z.mcap" for n in range(3)]
    for path in files:
        path.write_bytes((MCAP0_MAGIC + bytes(FILE_BYTES))[: FILE_BYTES - len(MCAP0_MAGIC)] + MCAP0_MAGIC)
    told: list[str] = []
    limits = RecordingLimits(total_bytes_max=60_000, free_bytes_min=0)
    Store(tmp_path, "uav1", limits, lambda _, text: told.append(text)).make_room()
    assert sorted(tmp_path.iterdir()) == files[1:]
    assert told == [f"old recordings removed to make room: 1, up to {files[0].name}"]


def test_recordings_of_a_vehicle_whose_name_goes_on_like_ours_are_not_ours_to_remove(tmp_path: Path) -> None:
    theirs = tmp_path / "uav1_000001_000000_20260101T000000Z.mcap"
    theirs.write_bytes(bytes(FILE_BYTES))
    Store(tmp_path, "uav1", RecordingLimits(total_bytes_max=1000, free_bytes_min=0), lambda *_: None).make_room()
    assert theirs.exists()


def test_recorders_that_begin_at_the_same_time_write_a_file_each(tmp_path: Path) -> None:
    """The number of a file is the next one for each of them."""
    together = threading.Barrier(16)

    def begin(_: int) -> McapFile:
        store = Store(tmp_path, "ground", RecordingLimits(free_bytes_min=0), lambda *_: None)
        together.wait()
        return store.new_file()

    with ThreadPoolExecutor(16) as recorders:
        files = list(recorders.map(begin, range(16)))
    for file in files:
        file.close()
    assert len({file.path for file in files}) == 16


def test_a_disk_with_room_for_the_first_bytes_alone_is_told_once_and_leaves_no_empty_files(tmp_path: Path) -> None:
    command = [sys.executable, "-c", NO_ROOM_FOR_MORE, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    while_full, told = json.loads(done.stdout)
    assert while_full == ["recording stopped: File too large"]
    assert told == [*while_full, "recording again"]
    (path,) = tmp_path.iterdir()
    with path.open("rb") as file:
        kept = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert "/uav1/target/t0/pose" in kept
    assert "/uav1/camera_info" in kept, "a file can be read without those before it"
