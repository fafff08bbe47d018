"""`uavpose-ground view`: a viewer's window, a page for a browser, or a file; from vehicles or from recordings."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import rerun as rr

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming, listening, session
from msgs.ground.fleet import TAKEN, Fleet
from msgs.ground.view.layout import blueprint
from msgs.ground.view.recorded import check_opens, samples
from msgs.ground.view.saving import saved
from msgs.ground.view.scene import Scene
from msgs.session import TlsFiles

APPLICATION = "uavpose"
DRAWN = (*TAKEN, topics.CAMERA_INFO, topics.IMAGE)
TICK_S = 0.2
_LOOPBACK = "127.0.0.1"
_START_S = 60.0
_LOOK_EVERY_S = 0.05
_SERVER_MEMORY = "1GiB"  # older data goes first when a browser joins a long flight


@dataclass(frozen=True)
class ViewOptions:
    """What to show, and where. No `recordings`: the vehicles at `endpoint`; no `save` and no `web_port`: a window."""

    recordings: Sequence[Path]
    endpoint: str
    tls: TlsFiles | None
    uavs: Sequence[str]  # empty: all
    domain: int
    max_age_s: float
    size_m: tuple[float, float, float]
    save: Path | None
    web_port: int | None


def view(options: ViewOptions, stop: threading.Event, say: Callable[[str], None]) -> int:
    """Show until `stop` is set, or all of the recordings and end; 0. Raises InputError for bad input."""
    _check_recordings(options)
    rec = rr.RecordingStream(APPLICATION)
    rec.set_log_tick_enabled(False)
    rec.set_log_time_enabled(False)
    fleet = Fleet(domain=0 if options.recordings else options.domain, max_age_s=options.max_age_s)

    def arrange(uavs: Sequence[str]) -> None:
        rec.send_blueprint(blueprint(uavs, live=not options.recordings))

    scene = Scene(rec, fleet, options.size_m, arrange)
    with _opened(rec, options, stop, say):
        if options.recordings:
            _play(options, scene, stop, say)
        else:
            _listen(options, scene, stop, say)
        scene.finish()
    into = f" into {options.save}" if options.save is not None else ""
    refused = sum(one.refused for one in fleet.rows(time.time_ns()))
    say(f"{scene.drawn} poses drawn{into}" + (f", {refused} samples refused" if refused else ""))
    return 0


def _check_recordings(options: ViewOptions) -> None:
    """Raise InputError for a recording that does not open, or that --save would overwrite."""
    for path in options.recordings:
        check_opens(path)
        if options.save is not None and options.save.exists() and options.save.samefile(path):
            raise InputError(f"--save {options.save}: is the recording {path} itself")


@contextmanager
def _opened(
    rec: rr.RecordingStream, options: ViewOptions, stop: threading.Event, say: Callable[[str], None]
) -> Iterator[None]:
    """Where the recording goes: a file, a server for browsers on this machine, or a window that stays."""
    if options.save is not None:
        # A live view is whole whenever it is ended.
        with saved(rec, options.save, stop, lambda: not (options.recordings and stop.is_set())):
            yield
    elif options.web_port is not None:
        with _server(options.web_port) as address:
            rec.connect_grpc(address)
            say(f"open http://{_LOOPBACK}:{options.web_port}/?url={quote(address, safe=':/')}")
            yield
            rec.flush()
            if options.recordings:
                stop.wait()
            rec.disconnect()
    else:
        rec.spawn()
        yield
        rec.flush()
        rec.disconnect()


@contextmanager
def _server(web_port: int) -> Iterator[str]:
    """Rerun's server as a process, bound to this machine alone (the one in its library is open to every network); its
    address for data. Raises InputError if the ports are not to be had."""
    ports = (web_port, web_port + 1)
    command = [sys.executable, "-m", "rerun", "--serve-web", "--bind", _LOOPBACK, "--web-viewer-port", str(ports[0])]
    for port in ports:
        if _answers(port):
            raise InputError(f"--web {web_port}: port {port} is taken")
    server = subprocess.Popen(
        [*command, "--port", str(ports[1]), "--server-memory-limit", _SERVER_MEMORY],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # the command starts the server as a child of its own: both have to be ended
    )
    try:
        deadline_s = time.monotonic() + _START_S
        while not all(_answers(port) for port in ports):
            if _ended(server, _LOOK_EVERY_S) or time.monotonic() > deadline_s:
                raise InputError(f"--web {web_port}: Rerun's server does not start there")
        yield f"rerun+http://{_LOOPBACK}:{ports[1]}/proxy"
    finally:
        with suppress(ProcessLookupError):  # both have ended by themselves
            os.killpg(server.pid, signal.SIGTERM)
        server.wait()


def _ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        return False
    return True


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((_LOOPBACK, port)) == 0


def _play(options: ViewOptions, scene: Scene, stop: threading.Event, say: Callable[[str], None]) -> None:
    for path in options.recordings:
        for incoming, log_ns in samples(path):
            if stop.is_set():
                return
            if not options.uavs or incoming.uav in options.uavs:
                scene.take(incoming, log_ns)
            scene.tick(log_ns)
        say(f"{path}: read")


def _listen(options: ViewOptions, scene: Scene, stop: threading.Event, say: Callable[[str], None]) -> None:
    def take(incoming: Incoming) -> None:
        scene.take(incoming, time.time_ns())

    def alive(uav: str, here: bool) -> None:
        scene.alive(uav, here, time.time_ns())

    with session(options.endpoint, options.tls, stop, say) as opened:
        if opened is None:
            return
        with listening(opened, options.uavs, options.domain, take, alive, DRAWN):
            say(f"showing {options.endpoint}")
            while not stop.wait(TICK_S):
                scene.tick(time.time_ns())
