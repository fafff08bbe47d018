"""The subscriber before its daemon is there, and what it prints of a target whose range is not known."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import zenoh

from msgs import session, topics
from msgs.cdr import Vector3Stamped
from msgs.publish import Node
from sim_replay.ports import free_endpoint
from tests.waiting import until

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


def test_it_prints_the_directions_that_are_valid_and_counts_the_others() -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "sim_replay.subscriber", "--connect", endpoint, "--max-age-s", str(PATIENCE_S)]
    ray_cam = np.array([0.6, 0.0, 0.8])
    with zenoh.open(session.peer_config([endpoint], [])) as daemon, Node(daemon, "uav1") as node:
        publisher = node.publisher(topics.DIRECTION, "t2")
        reached = daemon.declare_publisher(publisher.key)
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert json.loads(process.stdout.readline()) == {"event": "ready"}
                until(lambda: reached.matching_status.matching, what="the subscription")
                sent_ns = time.time_ns()
                for length in (2.0, 1.0):
                    publisher.put(Vector3Stamped(sent_ns, topics.FRAME_CAMERA, length * ray_cam).encode())
                seen = json.loads(process.stdout.readline())
                process.terminate()
                said, _ = process.communicate(timeout=60)
            finally:
                process.kill()
    assert seen.pop("age_ms") >= 0.0
    assert seen == {"event": "direction", "target": "t2", "capture_utc_ns": sent_ns, "ray_cam": ray_cam.tolist()}
    summary = json.loads(said)
    assert summary["received"] == {"uav1/target/t2/direction": 2}
    assert summary["refused"] == {"DIRECTION": 1}
