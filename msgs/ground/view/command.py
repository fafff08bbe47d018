"""`uavpose-ground view`: a viewer's window, a page for a browser, or a file; from vehicles or from recordings."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming, listening, session
from msgs.ground.fleet import TAKEN, Fleet
from msgs.ground.view.layout import blueprint
from msgs.ground.view.recorded import samples
from msgs.ground.view.scene import Scene
from msgs.session import TlsFiles

APPLICATION = "uavpose"
DRAWN = (*TAKEN, topics.CAMERA_INFO, topics.IMAGE)
TICK_S = 0.2
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
    rec = rr.RecordingStream(APPLICATION)
    rec.set_log_tick_enabled(False)
    rec.set_log_time_enabled(False)
    fleet = Fleet(domain=0 if options.recordings else options.domain, max_age_s=options.max_age_s)

    def arrange(uavs: Sequence[str]) -> None:
        rec.send_blueprint(blueprint(uavs, live=not options.recordings))

    scene = Scene(rec, fleet, options.size_m, arrange)
    _open(rec, options, say)
    if options.recordings:
        _play(options, scene, say)
        scene.finish()
        rec.flush()
        if options.web_port is not None:
            stop.wait()
    else:
        _listen(options, scene, stop, say)
        scene.finish()
    rec.flush()
    rec.disconnect()
    say(f"{scene.drawn} poses drawn" + (f" into {options.save}" if options.save is not None else ""))
    return 0


def _open(rec: rr.RecordingStream, options: ViewOptions, say: Callable[[str], None]) -> None:
    if options.save is not None:
        try:
            options.save.touch()
        except OSError as error:
            raise InputError(f"--save {options.save}: cannot be written: {error.strerror}") from error
        rec.save(options.save)
    elif options.web_port is not None:
        try:
            address = rec.serve_grpc(grpc_port=options.web_port + 1, server_memory_limit=_SERVER_MEMORY)
            rr.serve_web_viewer(web_port=options.web_port, open_browser=False, connect_to=address)
        except (RuntimeError, OSError) as error:
            raise InputError(f"--web {options.web_port}: cannot be served there: {error}") from error
        say(f"open http://127.0.0.1:{options.web_port}/?url={address.replace('+', '%2B')}")
    else:
        rec.spawn()


def _play(options: ViewOptions, scene: Scene, say: Callable[[str], None]) -> None:
    for path in options.recordings:
        log_ns = 0
        for incoming, log_ns in samples(path):
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
