"""Runs Rerun's viewer as a separate process, as a window or a server for browsers, and stops drawing when it ends."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from urllib.parse import quote

import rerun as rr

from msgs.ground.errors import InputError

WINDOW_PORT = 9876  # Rerun's default, so that a window that is already open is reused
_LOOPBACK = "127.0.0.1"
_START_S = 60.0
_LOOK_EVERY_S = 0.05
_LOOK_AGAIN_S = 0.5
_SETTLE_S = 1.0  # a viewer without a display accepts connections for a moment before it exits
_SERVER_MEMORY = "1GiB"  # kept for browsers that join later; the oldest data is dropped first
# Told to stop (SIGTERM) when we have ended, also if we are killed: the page would go on showing what was drawn last,
# and its ports would stay taken.
_TIED = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()
# Rerun's own command, which would start the server as a child that is not tied.
_AS_SERVER = (
    "import os, pathlib, sys, rerun_cli\n"
    "server = str(pathlib.Path(rerun_cli.__file__).with_name('rerun'))\n"
    "os.execv(server, [server, *sys.argv[1:]])"
)
_NO_WINDOW = "Rerun's viewer cannot open a window here: use --web for a browser, or --save for another machine"


@contextmanager
def window(rec: rr.RecordingStream, stop: threading.Event, say: Callable[[str], None]) -> Iterator[None]:
    """A window, which stays open afterwards; sets `stop` when it is closed. Raises InputError if it fails to open or
    crashes."""
    viewer: subprocess.Popen[bytes] | None = None
    if not answers(WINDOW_PORT):
        viewer = subprocess.Popen(
            _command(WINDOW_PORT, "--expect-data-soon"), stdout=subprocess.DEVNULL, start_new_session=True
        )
        if not _started(viewer, [WINDOW_PORT]) or _ended(viewer, _SETTLE_S):
            raise InputError(_NO_WINDOW)

    def here() -> bool:
        return answers(WINDOW_PORT) if viewer is None else viewer.poll() is None

    with _fed(rec, WINDOW_PORT, here, stop, _NO_WINDOW) as gone:
        yield
    if gone.is_set():
        if viewer is not None and viewer.poll():
            raise InputError(_NO_WINDOW)
        say("the viewer was closed")


@contextmanager
def page(
    rec: rr.RecordingStream, web_port: int, stays: bool, stop: threading.Event, say: Callable[[str], None]
) -> Iterator[None]:
    """A page for browsers on this machine; `stays`: even after all is drawn, until `stop` is set. Raises InputError if
    the ports are not available, or the server exits."""
    ended = f"--web {web_port}: Rerun's server exited unexpectedly"
    with (
        server(web_port) as process,
        _fed(rec, web_port + 1, lambda: process.poll() is None, stop, ended, stays=stays) as gone,
    ):
        say(f"open http://{_LOOPBACK}:{web_port}/?url={quote(_address(web_port + 1), safe=':/')}")
        yield
    if gone.is_set():
        raise InputError(ended)


@contextmanager
def server(web_port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's server; it receives data at port `web_port` + 1. Raises InputError if the ports are not available."""
    ports = (web_port, web_port + 1)
    for port in ports:
        if answers(port):
            raise InputError(f"--web {web_port}: port {port} is already in use")
    asked = ("--serve-web", "--web-viewer-port", str(web_port), "--server-memory-limit", _SERVER_MEMORY)
    process = subprocess.Popen(
        [*_TIED, sys.executable, "-c", _AS_SERVER, *_options(ports[1], *asked)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a terminal's Ctrl-C is for us
    )
    try:
        if not _started(process, ports):
            raise InputError(f"--web {web_port}: Rerun's server does not start at this port")
        yield process
    finally:
        process.terminate()
        process.wait()


def answers(port: int) -> bool:
    """Whether something on this machine accepts connections at this port."""
    with socket.socket() as probe:
        return probe.connect_ex((_LOOPBACK, port)) == 0


@contextmanager
def _fed(
    rec: rr.RecordingStream,
    port: int,
    here: Callable[[], bool],
    stop: threading.Event,
    refused: str,
    *,
    stays: bool = False,
) -> Iterator[threading.Event]:
    """Send what is logged inside to the viewer at `port`. Once it is not `here` any more, sets `stop` and the yielded
    event. Raises InputError, `refused`, if it cannot be reached at the start."""
    gone, over = threading.Event(), threading.Event()

    def watch() -> None:
        while not over.wait(_LOOK_AGAIN_S):
            if not here():
                gone.set()
                stop.set()
                return

    rec.connect_grpc(_address(port))
    watcher = threading.Thread(target=watch, name="viewer", daemon=True)
    try:
        # Logging to a viewer that was never reached blocks for ever.
        if not _reached(rec, here):
            raise InputError(refused)
        watcher.start()
        yield gone
        try:
            rec.flush()
        except RuntimeError:  # the viewer is gone
            gone.set()
        if stays:
            stop.wait()
    finally:
        over.set()
        rec.disconnect()


def _reached(rec: rr.RecordingStream, here: Callable[[], bool]) -> bool:
    deadline_s = time.monotonic() + _START_S
    while here() and time.monotonic() < deadline_s:
        with suppress(RuntimeError):
            rec.flush(timeout_sec=_LOOK_AGAIN_S)
            return True
    return False


def _started(process: subprocess.Popen[bytes], ports: Sequence[int]) -> bool:
    """Wait until all ports answer; False if the process exits before, or takes too long."""
    deadline_s = time.monotonic() + _START_S
    while not all(map(answers, ports)):
        if _ended(process, _LOOK_EVERY_S) or time.monotonic() > deadline_s:
            return False
    return True


def _ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        return False
    return True


def _command(port: int, *options: str) -> list[str]:
    return [sys.executable, "-m", "rerun", *_options(port, *options)]


def _options(port: int, *options: str) -> list[str]:
    """Bound to loopback: anyone who can connect to a viewer can see its data and draw into it."""
    return ["--bind", _LOOPBACK, "--port", str(port), *options]


def _address(port: int) -> str:
    return f"rerun+http://{_LOOPBACK}:{port}/proxy"
