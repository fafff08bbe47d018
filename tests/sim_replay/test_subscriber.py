"""The subscriber before its daemon is there."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

from tests.waiting import runs, until

PATIENCE_S = 3600.0


def heeds(pid: int, number: signal.Signals) -> bool:
    """Whether the process has a handler for the signal (Linux: SigCgt of /proc/PID/status)."""
    caught = Path(f"/proc/{pid}/status").read_text().partition("SigCgt:")[2].split()[0]
    return bool(int(caught, 16) >> (number - 1) & 1)


def test_a_signal_ends_the_wait_for_a_daemon() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        endpoint = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        command = [sys.executable, "-m", "sim_replay.subscriber", "--connect", endpoint, "--wait-s", str(PATIENCE_S)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                until(lambda: heeds(process.pid, signal.SIGTERM), what="its handler")
                process.terminate()
                said, complaint = process.communicate(timeout=60)
            finally:
                process.kill()
    assert (process.returncode, said) == (1, "")
    assert complaint.startswith(f"no zenoh session with {endpoint}")


def test_it_ends_with_a_player_that_is_killed_while_it_waits_for_a_daemon() -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        endpoint = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        command = [sys.executable, "-m", "sim_replay.subscriber", "--connect", endpoint, "--wait-s", str(PATIENCE_S)]
        player = f"import subprocess\nchild = subprocess.Popen({command})\nprint(child.pid, flush=True)\nchild.wait()"
        with subprocess.Popen([sys.executable, "-c", player], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            pid = int(process.stdout.readline())
            try:
                until(lambda: heeds(pid, signal.SIGTERM), what="its handler")
                process.kill()
                until(lambda: not runs(pid), what="the end of the subscriber")
            finally:
                process.kill()
                if runs(pid):
                    os.kill(pid, signal.SIGKILL)
