"""What the ground's commands do when nobody reads what they say, or the disk that takes it is full."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from msgs import cdr, topics
from msgs.publish import Node
from tests.waiting import until

from ..conftest import Network
from .test_watch import Vehicle

GROUND = [sys.executable, "-m", "msgs.ground.cli"]
FULL = "standard output: cannot be written: No space left on device\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", [("topics",), ("watch",), ("watch", "--json"), ("keys", "init")], ids=" ".join)
def test_output_that_a_full_disk_does_not_take_is_a_sentence(
    words: tuple[str, ...], unbuffered: str, network: Network, tmp_path: Path
) -> None:
    where = {"watch": ["-e", network.endpoint, "--seconds", "0.1"], "keys": ["--dir", tmp_path / "keys"]}
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        command = [*GROUND, *words, *where.get(words[0], [])]
        told = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert (told.returncode, told.stderr) == (2, FULL)


@pytest.mark.parametrize("words", [("watch",), ("watch", "--json")], ids=" ".join)
def test_a_watch_ends_as_a_shell_expects_when_its_reader_has_gone(words: tuple[str, ...], network: Network) -> None:
    """As with `| head -1`."""
    with ExitStack() as stack:
        command = [*GROUND, *words, "-e", network.endpoint]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = stack.enter_context(subprocess.Popen(command, **pipes))  # type: ignore[call-overload]
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline()
        process.stdout.close()
        uav1 = Vehicle(network.daemon, "uav1", stack)
        until(lambda: process.poll() is not None, uav1.tell, what="the end of watch")
        assert (process.returncode, process.stderr.read()) == (141, b"")


def test_a_recording_goes_on_when_nobody_reads_its_messages(network: Network, tmp_path: Path) -> None:
    """Each vehicle that comes or goes is such a message."""
    heard, said = os.pipe()
    command = [*GROUND, "record", "-e", network.endpoint, "--dir", str(tmp_path), "--free-mb", "0"]
    with subprocess.Popen(command, stderr=said) as process, Node(network.daemon, "uav1") as node:
        try:
            os.close(said)
            os.close(heard)
            events = node.publisher(topics.EVENTS)

            def tell() -> None:
                with network.daemon.liveliness().declare_token(topics.alive_token("uav1")):
                    events.put(cdr.Log(time.time_ns(), 20, "uavpose_edge", "flying").encode())

            until(lambda: any(path.stat().st_size > 20_000 for path in tmp_path.iterdir()), tell, what="a recording")
            assert process.poll() is None
        finally:
            process.kill()


def test_a_recording_that_the_disk_did_not_take_ends_with_1(network: Network, tmp_path: Path) -> None:
    folder, said = tmp_path / "recordings", tmp_path / "said"
    no_disk_has = "1e9"
    command = [*GROUND, "record", "-e", network.endpoint, "--dir", str(folder), "--free-mb", no_disk_has]
    with ExitStack() as stack, said.open("w") as out, subprocess.Popen(command, stderr=out) as process:
        try:
            uav1 = Vehicle(network.daemon, "uav1", stack)
            until(lambda: "recording stopped: " in said.read_text(), uav1.tell)
            process.terminate()
            assert process.wait(60.0) == 1
        finally:
            process.kill()
    assert list(folder.iterdir()) == []
