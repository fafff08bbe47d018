"""What a recording makes of a computer whose time is set while it records."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from mcap.reader import make_reader

from msgs import recording, topics
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from tests.waiting import until

DAY_NS = 86_400_000_000_000


@pytest.mark.parametrize("flush_s", [0.02, 30.0])
def test_each_side_of_a_step_of_the_clock_is_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flush_s: float
) -> None:
    """Three days behind until the network tells the time, and then 2 s too far: by turns written, or all at once."""
    behind_ns = 3 * DAY_NS
    clock = SimpleNamespace(time_ns=lambda: time.time_ns() - behind_ns, monotonic_ns=time.monotonic_ns)
    monkeypatch.setattr(recording, "time", SimpleNamespace(monotonic=time.monotonic, **vars(clock)))
    monkeypatch.setattr(recording, "FLUSH_S", flush_s)
    recorder = Recorder(tmp_path, "uav1", RecordingLimits(free_bytes_min=0), lambda *_: None)
    recorder.start()
    recorder.record(topics.CAMERA_INFO, "uav1", None, b"lens", 1)
    written = 1
    for behind_ns in (3 * DAY_NS, 0, 2_000_000_000):
        for k in range(5):
            recorder.record(topics.POSE, "uav1", "t0", b"%d %d" % (behind_ns, k), 1)
            written += 1
        if behind_ns == 0:
            recorder.record(topics.CAMERA_INFO, "uav1", None, b"other lens", 1)
            written += 1
        if flush_s < 1:
            until(lambda count=written: recorder.counters()["recorded"] == count)  # type: ignore[misc]
    recorder.stop()
    told = []
    for path in sorted(tmp_path.iterdir()):
        with path.open("rb") as file:
            messages = [(message.log_time, message.data) for _, _, message in make_reader(file).iter_messages()]
        assert all(one[0] <= other[0] for one, other in pairwise(messages))
        assert messages[-1][0] - messages[0][0] < 60 * 10**9
        told.append([data for _, data in messages])
    poses = [[b"%d %d" % (ns, k) for k in range(5)] for ns in (3 * DAY_NS, 0, 2_000_000_000)]
    assert told[0] == [b"lens", *poses[0]]
    assert [one for one in told[1] if one != b"lens"] == [*poses[1], b"other lens"]
    assert told[2] == [b"other lens", *poses[2]], "what is told on change alone is told again"
    assert recorder.counters() == {"recorded": written}
