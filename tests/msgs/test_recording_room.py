"""How much of the disk recordings take."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import MCAP0_MAGIC

from msgs.recording import RecordingLimits, Store

FILE_BYTES = 25_000


def test_the_newest_recording_counts_towards_what_all_may_take(tmp_path: Path) -> None:
    files = [tmp_path / f"uav1_{n:06d}_20260101T000000Z.mcap" for n in range(3)]
    for path in files:
        path.write_bytes((MCAP0_MAGIC + bytes(FILE_BYTES))[: FILE_BYTES - len(MCAP0_MAGIC)] + MCAP0_MAGIC)
    told: list[str] = []
    limits = RecordingLimits(total_bytes_max=60_000, free_bytes_min=0)
    Store(tmp_path, "uav1", limits, lambda _, text: told.append(text)).make_room()
    assert sorted(tmp_path.iterdir()) == files[1:]
    assert told == [f"old recordings removed to make room: 1, up to {files[0].name}"]
