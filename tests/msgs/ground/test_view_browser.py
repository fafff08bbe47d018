"""The view in a browser: a recorded flight, served, opened in headless Chromium, and looked at."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from playwright.sync_api import sync_playwright

from msgs.ground.errors import InputError
from msgs.ground.view.entities import TARGET_RGB
from msgs.ground.view.viewer import server
from tests.waiting import until

from .flight import record

BROWSER = next((path for name in ("chromium", "google-chrome") if (path := shutil.which(name))), None)
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WITHIN_S = 400.0  # the viewer is compiled and drawn without a GPU, on a machine that may be busy


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def two_free_ports() -> int:
    """The first of two that follow each other."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            try:
                second.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port


@contextmanager
def served(flight: Path) -> Iterator[tuple[int, str, subprocess.Popen[str]]]:
    """The view of a recording on a port of its own: port, address and process, which is ended."""
    port = two_free_ports()
    command = [sys.executable, "-m", "msgs.ground.cli", "view", str(flight), "--web", str(port)]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert server.stderr is not None
    try:
        yield port, server.stderr.readline().strip().removeprefix("open "), server
    finally:
        server.terminate()
        server.communicate(timeout=60)


def test_the_page_is_served_until_told_to_stop_and_nothing_stays_behind(tmp_path: Path) -> None:
    record(tmp_path / "flight.mcap", 5)
    with served(tmp_path / "flight.mcap") as (port, address, server):
        assert address.startswith(f"http://127.0.0.1:{port}/")
        with urlopen(f"http://127.0.0.1:{port}/", timeout=60) as page:
            assert b"rerun" in page.read().lower()
        assert server.stderr is not None
        assert server.stderr.readline().endswith("flight.mcap: read\n")
        server.terminate()
        assert "5 poses drawn" in server.stderr.read()
    assert server.returncode == 0
    assert not answers(port)
    assert not answers(port + 1)


def test_nothing_is_served_any_more_when_the_view_was_killed(tmp_path: Path) -> None:
    """As one that runs out of memory is."""
    record(tmp_path / "flight.mcap", 5)
    with served(tmp_path / "flight.mcap") as (port, _, view):
        view.kill()
        until(lambda: not answers(port) and not answers(port + 1), what="the end of the server")


def test_a_server_that_ends_at_once_is_told_and_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    unwilling = shutil.which("false")
    assert unwilling is not None
    monkeypatch.setattr(sys, "executable", unwilling)
    with pytest.raises(InputError, match="Rerun's server does not start at this port"), server(two_free_ports()):
        pass


def test_a_server_that_ends_in_the_middle_is_told_and_no_traceback(tmp_path: Path) -> None:
    record(tmp_path / "flight.mcap", 5)
    with served(tmp_path / "flight.mcap") as (_, _, server):
        assert server.stderr is not None
        assert server.stderr.readline().endswith("flight.mcap: read\n")
        (child,) = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
        os.killpg(int(child), signal.SIGKILL)
        said = server.stderr.read()
    assert said.endswith("Rerun's server exited unexpectedly\n")
    assert "Traceback" not in said
    assert server.returncode == 2


@pytest.mark.timeout(500)
def test_a_recorded_flight_is_drawn_in_a_browser(tmp_path: Path) -> None:
    assert BROWSER is not None, "no chromium: sh deploy/bootstrap.sh dev installs it"
    record(tmp_path / "flight.mcap", 100)
    shot = tmp_path / "view.png"
    with served(tmp_path / "flight.mcap") as (_, address, server), sync_playwright() as play:
        browser = play.chromium.launch(executable_path=BROWSER, args=SOFTWARE)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(f"{address}&renderer=webgl", timeout=WITHIN_S * 1e3)

        def look() -> None:
            page.screenshot(path=shot, timeout=WITHIN_S * 1e3)

        until(lambda: drawn_parts(shot) >= 3, look, what="the target in three views", within_s=WITHIN_S)
        browser.close()
    assert server.returncode == 0


def drawn_parts(shot: Path) -> int:
    """In how many quarters of the picture there is the first target's colour."""
    if not shot.exists():
        return 0
    picture = cv2.cvtColor(cv2.imread(str(shot)), cv2.COLOR_BGR2RGB).astype(int)
    close = (np.abs(picture - np.array(TARGET_RGB[0])) < 12).all(axis=2)
    height, width = close.shape
    quarters = [close[y : y + height // 2, x : x + width // 2] for y in (0, height // 2) for x in (0, width // 2)]
    return sum(bool(quarter.any()) for quarter in quarters)
