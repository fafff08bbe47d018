"""`play` in real time with real processes: what is under way is waited for, a peer that is lost fails the flight."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from edge.config import SHIPPED_MODEL
from sim_replay.bad_link import LinkFaults
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.ground_truth import read_sequence
from sim_replay.play import PlayError, PlaySettings, Record, Recording, play
from tests.edge.toy_model import write_toy_model
from tests.sim_replay.toy_flight import write_toy_flight


def peer_pid(name: str) -> int:
    children = " ".join(path.read_text() for path in Path("/proc/self/task").glob("*/children")).split()
    module = f"sim_replay.{name}".encode()
    (pid,) = [int(pid) for pid in children if module in Path("/proc", pid, "cmdline").read_bytes().split(b"\0")]
    return pid


@pytest.mark.parametrize(
    ("name", "number", "words"),
    [
        ("subscriber", signal.SIGKILL, "the subscriber ended before the daemon, with exit code -9"),
        ("autopilot", signal.SIGKILL, "the autopilot ended before the daemon, with exit code -9"),
        ("autopilot", signal.SIGSTOP, "the autopilot gave no summary"),
    ],
)
def test_a_peer_that_is_lost_in_the_flight_fails_it(
    name: str, number: signal.Signals, words: str, tmp_path: Path
) -> None:
    lost: list[int] = []

    def lose(_recording: Recording, record: Record) -> None:
        if record["event"] == "diagnostics" and not lost:
            lost.append(peer_pid(name))
            os.kill(lost[0], number)

    with pytest.raises(PlayError, match=words):
        play(PlaySettings(read_sequence(BUNDLED_SEQUENCE), tmp_path, SHIPPED_MODEL), lose)
    assert not Path("/proc", str(lost[0])).exists()


def test_what_a_slow_link_still_carries_when_the_daemon_has_ended_is_received(tmp_path: Path) -> None:
    sequence = read_sequence(write_toy_flight(tmp_path / "scene"))
    model, link = write_toy_model(tmp_path / "toy.onnx"), LinkFaults(delay_ms=1200.0, jitter_ms=600.0)
    settings = PlaySettings(sequence, tmp_path / "out", model, link=link)
    recording = play(settings, lambda _recording, _record: None)
    sent = recording.daemon_counters["mavlink_sent_TARGET_RELATIVE"]
    assert len(recording.targets) == sent > 0
