"""`uavpose-ground view`: shows vehicles or recordings in a viewer's window, a browser page, or saves them to a file."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming, listening, session
from msgs.ground.fleet import TAKEN, Fleet
from msgs.ground.view.layout import blueprint
from msgs.ground.view.recorded import check_opens, is_unfinished, samples
from msgs.ground.view.saving import saved
from msgs.ground.view.scene import Scene
from msgs.ground.view.viewer import page, window
from msgs.session import TlsFiles
from msgs.wire import Refusal

APPLICATION = "uavpose"
DRAWN = (*TAKEN, topics.CAMERA_INFO, topics.IMAGE)
TICK_S = 0.2


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
    """Show vehicles until `stop` is set, or recordings to their end; returns 0. Raises InputError for bad input."""
    _check_recordings(options)
    rec = rr.RecordingStream(APPLICATION)
    rec.set_log_tick_enabled(False)
    rec.set_log_time_enabled(False)
    fleet = Fleet(domain=0 if options.recordings else options.domain, max_age_s=options.max_age_s)

    def arrange(uavs: Sequence[str]) -> None:
        rec.send_blueprint(blueprint(uavs, live=not options.recordings))

    scene = Scene(rec, fleet, options.size_m, arrange)

    def complete() -> bool:
        # A live view is complete whenever it is stopped.
        return not scene.empty() and not (options.recordings and stop.is_set())

    with _opened(rec, options, complete, stop, say):
        if options.recordings:
            _play(options, scene, stop, say)
        else:
            _listen(options, scene, stop, say)
        scene.finish()
    into = f" into {options.save}" if options.save is not None else ""
    refused = sum((one.refused for one in fleet.rows(time.time_ns())), Counter[Refusal]())
    why = "; ".join(f"{number}: {reason.value}" for reason, number in refused.most_common())
    what = f"{scene.drawn} poses" + (f" and {scene.directions_drawn} directions" if scene.directions_drawn else "")
    say(f"{what} drawn{into}" + (f", {refused.total()} samples refused ({why})" if refused else ""))
    return 0


def _check_recordings(options: ViewOptions) -> None:
    """Raise InputError for a recording that does not open, or that --save would overwrite."""
    for path in options.recordings:
        check_opens(path)
        if options.save is not None and os.path.exists(options.save) and options.save.samefile(path):
            raise InputError(f"--save {options.save}: is the same file as the recording {path}")


@contextmanager
def _opened(
    rec: rr.RecordingStream,
    options: ViewOptions,
    complete: Callable[[], bool],
    stop: threading.Event,
    say: Callable[[str], None],
) -> Iterator[None]:
    """Open the output: a file, a server for browsers on this machine, or a window that stays open."""
    if options.save is not None:
        with saved(rec, options.save, stop, complete):
            yield
    elif options.web_port is not None:
        with page(rec, options.web_port, bool(options.recordings), stop, say):
            yield
    else:
        with window(rec, stop, say):
            yield


def _play(options: ViewOptions, scene: Scene, stop: threading.Event, say: Callable[[str], None]) -> None:
    for path in options.recordings:
        for incoming, log_ns in samples(path):
            if stop.is_set():
                return
            scene.tick(log_ns)  # first: after a gap, the sample may be of the very target that was lost in it
            if not options.uavs or incoming.uav in options.uavs:
                scene.take(incoming, log_ns)
        how_far = ", as far as it is complete: a crash ended it, or it is being recorded" if is_unfinished(path) else ""
        say(f"{path}: read{how_far}")


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
