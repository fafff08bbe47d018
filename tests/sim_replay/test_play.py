"""`play` in real time with real processes: what is under way is waited for, a peer that is lost fails the flight."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import pytest
import zenoh

from edge.config import SHIPPED_MODEL
from msgs.session import peer_config
from sim_replay.bad_link import LinkFaults
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.ground_truth import read_sequence
from sim_replay.play import PlayError, PlaySettings, Record, Recording, play
from sim_replay.ports import free_endpoint
from tests.edge.toy_model import write_toy_model
from tests.sim_replay.toy_flight import write_toy_flight
from tests.waiting import WITHIN_S, runs, until


def peer_pid(name: str) -> int:
    return child_pid(f"sim_replay.{name}")


def child_pid(word: str) -> int:
    """Of the child process that has this word on its command line."""
    children = " ".join(path.read_text() for path in Path("/proc/self/task").glob("*/children")).split()
    (pid,) = [int(pid) for pid in children if word.encode() in Path("/proc", pid, "cmdline").read_bytes().split(b"\0")]
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


@pytest.mark.parametrize("awaited", ["diagnostics", "pose"])  # before frame 0, and in the flight
def test_a_daemon_that_is_told_to_stop_before_the_last_frame_fails_the_flight(awaited: str, tmp_path: Path) -> None:
    stopped: list[int] = []

    def stop(_recording: Recording, record: Record) -> None:
        if record["event"] == awaited and not stopped:
            stopped.append(child_pid(str(tmp_path / "out/config.toml")))
            os.kill(stopped[0], signal.SIGTERM)

    sequence, model = read_sequence(write_toy_flight(tmp_path / "scene")), write_toy_model(tmp_path / "toy.onnx")
    with pytest.raises(PlayError, match=r"the daemon ended \d+\.\d s before the last frame, with exit code 0"):
        play(PlaySettings(sequence, tmp_path / "out", model), stop)


STARTS_BOTH_KINDS = """
import queue, time
from sim_replay.faults.processes import Process
from sim_replay.play import _peer
daemon = Process(["sleep", "3600"], lambda *_: None)
with _peer("subscriber", ["--connect", "tcp/127.0.0.1:9", "--wait-s", "3600"], queue.SimpleQueue()) as subscriber:
    print(daemon.pid, subscriber.pid, flush=True)
    time.sleep(3600.0)
"""


def is_tied(pid: int) -> bool:
    """Whether it runs its command, and no longer what ties it to the process that started it."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    return b"3600" in words and words[0] != b"setpriv"


def test_what_a_command_has_started_ends_with_it_also_when_it_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", STARTS_BOTH_KINDS], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pids = [int(pid) for pid in process.stdout.readline().split()]
        try:
            assert len(pids) == 2
            until(lambda: all(is_tied(pid) for pid in pids), what="the commands themselves")
            process.kill()  # while the subscriber still imports
            until(lambda: not any(runs(pid) for pid in pids), what="the end of what it started")
        finally:
            process.kill()
            for pid in filter(runs, pids):
                os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("name", ["autopilot", "subscriber"])
def test_a_peer_whose_reader_was_killed_ends_without_a_traceback(name: str, tmp_path: Path) -> None:
    endpoint, scene = free_endpoint(), write_toy_flight(tmp_path / "scene")
    arguments = {
        "autopilot": ["--telemetry", str(scene / "telemetry.csv"), "--endpoint", "127.0.0.1:9", "--start-at-ns", "0"],
        "subscriber": ["--connect", endpoint],
    }
    command = [sys.executable, "-m", f"sim_replay.{name}", *arguments[name]]
    with (
        zenoh.open(peer_config([endpoint], [])),
        subprocess.Popen(command, stdout=PIPE, stderr=PIPE, text=True) as peer,
    ):
        assert peer.stdout is not None
        assert peer.stderr is not None
        assert '"ready"' in peer.stdout.readline()
        peer.stdout.close()
        peer.terminate()
        assert (peer.stderr.read(), peer.wait(WITHIN_S)) == ("", 141)


def test_what_a_slow_link_still_carries_when_the_daemon_has_ended_is_received(tmp_path: Path) -> None:
    sequence = read_sequence(write_toy_flight(tmp_path / "scene"))
    model, link = write_toy_model(tmp_path / "toy.onnx"), LinkFaults(delay_ms=1200.0, jitter_ms=600.0)
    settings = PlaySettings(sequence, tmp_path / "out", model, link=link)
    recording = play(settings, lambda _recording, _record: None)
    sent = recording.daemon_counters["mavlink_sent_TARGET_RELATIVE"]
    assert len(recording.targets) == sent > 0
