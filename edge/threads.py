"""The table of threads: who does what, whom nobody waits for, and which yield to the loop."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass

YIELDS = 10  # how much nicer than the loop's threads are those that look over whole frames


@dataclass(frozen=True)
class ThreadRow:
    name: str  # of the threading.Thread
    does: str
    never_waits_for: str
    watched: bool = False  # once it runs it runs to the end: its absence is a fault


THREADS = (
    ThreadRow("main", "the loop of `edge/daemon.py`", "links, camera"),
    ThreadRow("capture", "reads the camera, keeps the newest frame", "the loop"),
    ThreadRow("decode", "reads a sequence's pictures ahead", "the loop"),
    ThreadRow("search", "looks over the whole frame for more targets, at a lower priority", "the loop", watched=True),
    ThreadRow("zenoh", "sends the newest report, events, diagnostics, pictures", "the loop", watched=True),
    ThreadRow("closing", "when the daemon stops: closes the zenoh session, or is left with it", "anybody"),
    ThreadRow("recorder", "writes what goes out to disk", "the loop, the links", watched=True),
    ThreadRow("pictures", "makes JPEG of frames for who looks and for recordings", "the loop, the links"),
    ThreadRow("mavlink", "owns the sockets: sends, answers, hears the autopilot", "the loop", watched=True),
    ThreadRow("lookup", "asks where the host of a MAVLink endpoint is, and ends", "anybody"),
    ThreadRow("log", "writes the log, however long its reader takes", "anybody but its reader"),
    ThreadRow("watchdog", "ends the process when the loop stands still", "anybody"),
    ThreadRow("signals", "hears SIGTERM, SIGINT and SIGHUP for the loop", "anybody"),
    ThreadRow("reload", "while SIGHUP is obeyed: reads the configuration, loads and warms the model", "the loop"),
    ThreadRow("prometheus", "answers scrapes on loopback, if `[health] prometheus_port` is set", "the loop"),
)

# These run libraries' code that must not come back while the interpreter is taken down.
FOREIGN = frozenset({"capture", "search", "zenoh", "closing", "pictures", "lookup", "reload"})


def yield_to_the_loop() -> None:
    """Lower the priority of the calling thread and of those that it will start."""
    with suppress(OSError):  # where a sandbox forbids it, they compete with the loop and no more
        os.nice(YIELDS)


def running() -> frozenset[str]:
    """Names of the watched threads that run now."""
    alive = {thread.name for thread in threading.enumerate()}
    return frozenset(row.name for row in THREADS if row.watched and row.name in alive)


def left_behind() -> bool:
    """Whether a thread that must not outlive the interpreter has not ended in the time that stopping gives it."""
    return any(thread.name in FOREIGN for thread in threading.enumerate())


def table_markdown() -> str:
    """The table as the documents show it."""
    lines = ["| thread | does | never waits for |", "|---|---|---|"]
    lines += [f"| {row.name} | {row.does} | {row.never_waits_for} |" for row in THREADS]
    return "\n".join(lines) + "\n"
