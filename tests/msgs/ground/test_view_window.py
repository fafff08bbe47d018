"""The view in a window: where none opens, where it is closed, and who can reach it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from msgs.ground.cli import main
from msgs.ground.view import viewer
from msgs.ground.view.command import ViewOptions, view
from sim_replay.ports import free_port
from tests.waiting import until

from ..conftest import Network
from .flight import record


@contextmanager
def taking_data(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """What a window is to whoever draws into it, without a display."""
    process = subprocess.Popen(
        viewer._command(port, "--serve-grpc"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        until(lambda: viewer.answers(port), what="the viewer")
        yield process
    finally:
        close(process)


def close(process: subprocess.Popen[bytes]) -> None:
    """As a person does. It is a group: the command has the viewer for a child."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


@pytest.mark.timeout(200)
def test_where_no_window_opens_a_sentence_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(viewer, "WINDOW_PORT", free_port())
    record(tmp_path / "flight.mcap", 5)
    assert main(["view", str(tmp_path / "flight.mcap")]) == 2
    assert "use --web" in capsys.readouterr().err


@pytest.mark.timeout(200)
def test_a_window_that_is_closed_ends_the_view(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    port, stop, said, codes = free_port(), threading.Event(), list[str](), list[int]()
    monkeypatch.setattr(viewer, "WINDOW_PORT", port)
    options = ViewOptions(
        (),
        endpoint=network.endpoint,
        tls=None,
        uavs=(),
        domain=0,
        max_age_s=2.0,
        size_m=(8.0, 12.0, 2.5),
        save=None,
        web_port=None,
    )
    with taking_data(port) as process:
        showing = threading.Thread(target=lambda: codes.append(view(options, stop, said.append)))
        showing.start()
        until(lambda: f"showing {network.endpoint}" in said, what="the view")
        close(process)
        showing.join(60.0)
    ended = not showing.is_alive()
    stop.set()
    assert ended
    assert codes == [0]
    assert said[1:] == ["the viewer was closed", "0 poses drawn"]


def test_a_viewer_is_reached_from_this_machine_alone() -> None:
    port = free_port()
    with taking_data(port), socket.socket() as probe:
        # As all of 127.0.0.0/8 is this machine, another address of it stands for those that others call.
        assert probe.connect_ex(("127.0.0.2", port)) != 0
