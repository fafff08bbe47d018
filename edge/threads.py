"""The table of threads: what each does, what it never waits for, and which have a lower priority than the loop."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass

YIELDS = 10  # niceness of the threads that search the frame, relative to the loop's


@dataclass(frozen=True)
class ThreadRow:
    name: str  # of the threading.Thread, or its beginning
    does: str
    never_waits_for: str
    watched: bool = False  # once started it runs until the end: its absence is a fault


THREADS = (
    ThreadRow("main", "the loop of `edge/daemon.py`", "links, camera"),
    ThreadRow("capture", "reads the camera, keeps the newest frame", "the loop"),
    ThreadRow("decode", "reads a sequence's pictures ahead", "the loop"),
    ThreadRow(
        "search",
        "looks for more targets, in the whole frame or a tile of it, at a lower priority",
        "the loop",
        watched=True,
    ),
    ThreadRow("windows", "runs its share of a frame's windows through the network", "anybody"),
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
    ThreadRow("memory", "returns freed memory to the system every ten minutes", "anybody"),
    ThreadRow("prometheus", "answers scrapes on loopback, if `[health] prometheus_port` is set", "the loop"),
)

# These run library code that must not return to Python during interpreter shutdown.
FOREIGN = frozenset({"capture", "search", "zenoh", "closing", "pictures", "lookup", "reload"})


def yield_to_the_loop() -> None:
    """Lower the priority of the calling thread and of those that it starts later."""
    with suppress(OSError):  # if a sandbox forbids it, they only compete with the loop
        os.nice(YIELDS)


def running() -> frozenset[str]:
    """Names of the watched threads that are running."""
    alive = {thread.name for thread in threading.enumerate()}
    return frozenset(row.name for row in THREADS if row.watched and row.name in alive)


def left_behind() -> bool:
    """Whether a thread that must not outlive the interpreter has not ended in the time allowed."""
    return any(thread.name in FOREIGN for thread in threading.enumerate())


def table_markdown() -> str:
    """The table as shown in the documentation."""
    lines = ["| thread | does | never waits for |", "|---|---|---|"]
    lines += [f"| {row.name} | {row.does} | {row.never_waits_for} |" for row in THREADS]
    return "\n".join(lines) + "\n"
