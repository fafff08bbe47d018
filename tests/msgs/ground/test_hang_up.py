"""A terminal that is closed ends the ground's commands as Ctrl-C does: what they have received so far is kept."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.reader import make_reader

from msgs import cdr, topics
from msgs.publish import Node
from tests.waiting import until

from ..conftest import Network

END_S = 60.0


@contextmanager
def in_a_terminal(*arguments: object, ignoring_hang_up: bool = False) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """`uavpose-ground` as the leader of a terminal's session, and the terminal's other end, which the caller closes."""
    master, terminal = os.openpty()
    command = [sys.executable, "-m", "msgs.ground.cli", *map(str, arguments)]
    # Set either way: the tests may themselves run under nohup.
    prefix = ["setsid", "--ctty", "env", "--ignore-signal=HUP" if ignoring_hang_up else "--default-signal=HUP"]
    with subprocess.Popen([*prefix, *command], stdin=terminal, stdout=terminal, stderr=terminal) as process:
        os.close(terminal)
        try:
            yield process, master
        finally:
            process.kill()


def read_line(terminal: int) -> bytes:
    """To its end: a command whose terminal goes while it still writes fails."""
    line = b""
    while not line.endswith(b"\n"):
        line += os.read(terminal, 1)
    return line


def test_a_recording_is_complete_when_its_terminal_was_closed(network: Network, tmp_path: Path) -> None:
    record = ("record", "-e", network.endpoint, "--dir", tmp_path, "--free-mb", 0)
    with in_a_terminal(*record) as (process, master), Node(network.daemon, "uav1") as node:
        events = node.publisher(topics.EVENTS)
        told: list[str] = []

        def tell() -> None:
            told.append(str(len(told)))
            events.put(cdr.Log(time.time_ns(), 20, "uavpose_edge", told[-1]).encode())

        until(lambda: any(path.stat().st_size > 0 for path in tmp_path.iterdir()), tell)
        os.close(master)
        assert process.wait(END_S) == 0
    (path,) = tmp_path.iterdir()
    with open(path, "rb") as file:
        reader = make_reader(file)
        heard = [cdr.Log.decode(message.data).msg for _, _, message in reader.iter_messages()]
        summary = reader.get_summary()
    first = told.index(heard[0])
    assert heard == told[first : first + len(heard)]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(heard)


def test_a_view_is_saved_when_its_terminal_was_closed(network: Network, tmp_path: Path) -> None:
    saved = tmp_path / "flight.rrd"
    with in_a_terminal("view", "-e", network.endpoint, "--save", saved) as (process, master):
        assert read_line(master).startswith(b"showing")
        os.close(master)
        assert process.wait(END_S) == 0
    assert saved.stat().st_size > 0


@pytest.mark.parametrize("arguments", [("watch",), ("watch", "--json")], ids=" ".join)
def test_a_watch_ends_without_an_error(arguments: tuple[str, ...], network: Network) -> None:
    with in_a_terminal(*arguments, "-e", network.endpoint) as (process, master):
        token = network.daemon.liveliness().declare_token(topics.alive_token("uav1"))
        until(lambda: b"uav1" in os.read(master, 65536))
        os.close(master)
        assert process.wait(END_S) == 0
        token.undeclare()


def test_under_nohup_a_recording_goes_on(network: Network, tmp_path: Path) -> None:
    record = ("record", "-e", network.endpoint, "--dir", tmp_path, "--free-mb", 0)
    with in_a_terminal(*record, ignoring_hang_up=True) as (process, master), Node(network.daemon, "uav1") as node:
        events = node.publisher(topics.EVENTS)

        def tell() -> None:
            events.put(cdr.Log(time.time_ns(), 20, "uavpose_edge", "flying").encode())

        until(lambda: any(path.stat().st_size > 0 for path in tmp_path.iterdir()), tell)
        (path,) = tmp_path.iterdir()
        os.close(master)
        until(lambda: path.stat().st_size > 20_000, tell)
        assert process.poll() is None
