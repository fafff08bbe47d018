"""What the steps of a timeline do to the rig's processes, links and files."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import singledispatch
from pathlib import Path

from msgs.mavlink import dialect
from sim_replay.faults import hostile
from sim_replay.faults.processes import ENDS_WITH_US, Process
from sim_replay.faults.relay import LinkState, udp_queue
from sim_replay.faults.rig import START_S, UAV, Rig
from sim_replay.faults.timeline import (
    Camera,
    Disk,
    Flood,
    Hold,
    Link,
    Load,
    ModelFile,
    Signal,
    SlowSubscriber,
    Start,
)
from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK

FILLER = "filler"
_BUSY = "while True: pass"
LOOK_EVERY_N = 32  # datagrams of a flood between two checks of the unread bytes
QUEUED_MAX_BYTES = 50_000  # of the socket's 200 kB, as the kernel counts them
QUEUE_LOOK_S = 0.001
PACED_S = 30.0  # on a busy machine; the rest is then sent as fast as possible


@singledispatch
def act(step: object, rig: Rig) -> str | None:
    """Carry out a step that is an act; returns a text about it, if any.

    Raises PlayError, with the reason, if the host does not allow it, InputError if its process is not running.
    """
    raise TypeError(f"{type(step).__name__} is no act")


@act.register
def _hold(step: Hold, rig: Rig) -> None:
    threading.Event().wait(step.for_s)


@act.register
def _start(step: Start, rig: Rig) -> None:
    rig.start(step)


@act.register
def _signal(step: Signal, rig: Rig) -> None:
    process = rig.running(step.who)
    if step.name == "KILL" or (step.name == "TERM" and step.who != "daemon"):
        process.end(signal.Signals[f"SIG{step.name}"])
    else:
        process.send_signal(signal.Signals[f"SIG{step.name}"])


@act.register
def _camera(step: Camera, rig: Rig) -> None:
    rig.running("camera").tell(json.dumps(step.model_dump(exclude={"do"})))


@act.register
def _link(step: Link, rig: Rig) -> None:
    drop_ids = frozenset(getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in step.drop)
    relay = rig.mavlink if step.which == "mavlink" else rig.zenoh
    if step.which == "zenoh":
        rig.witness.zenoh_cut(step.cut or step.delay_ms > 0, time.time_ns())
    relay.state = LinkState(step.cut, step.delay_ms / 1e3, step.corrupt, drop_ids)


@act.register
def _flood(step: Flood, rig: Rig) -> str:
    _, lost_before = udp_queue(rig.mavlink_port)
    paced_until_s = time.monotonic() + PACED_S
    sent = 0
    with _sender(step.sender, rig) as send:
        for datagram in hostile.take_bytes(_datagrams(step, rig), step.total_bytes):
            send(datagram)
            sent += 1
            # The kernel would drop most of a faster flood before the daemon reads it.
            while sent % LOOK_EVERY_N == 0 and udp_queue(rig.mavlink_port)[0] > QUEUED_MAX_BYTES:
                if time.monotonic() > paced_until_s:
                    break
                time.sleep(QUEUE_LOOK_S)
    lost = udp_queue(rig.mavlink_port)[1] - lost_before
    return f"{sent} datagrams, of which {sent - max(lost, 0)} reached the daemon"


@act.register
def _slow_subscriber(step: SlowSubscriber, rig: Rig) -> None:
    if not step.there:
        while rig.extras:
            rig.extras.pop().end(signal.SIGKILL)
        return
    rig.witness.forget_ready("slow")
    command = [sys.executable, "-m", "sim_replay.subscriber", "--connect", rig.own_endpoint, "--uav", UAV]

    def heard(line: str, _: int) -> None:
        if '"ready"' in line:
            rig.witness.hear("slow", line)

    process = Process(command, heard)
    rig.extras.append(process)
    if not rig.witness.wait_for(lambda: "slow" in rig.witness.ready, START_S):
        raise PlayError("the second subscriber did not start")
    process.send_signal(signal.SIGSTOP)


@act.register
def _disk(step: Disk, rig: Rig) -> None:
    pid = rig.running("daemon").pid
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard if step.file_max_bytes is None else step.file_max_bytes, hard))
    if not rig.settings.volume:
        if step.full or step.read_only:
            raise PlayError("a disk can be filled only with `volume = true`")
        return
    _remount(rig, pid, "rw")
    # Only the daemon sees the volume; /proc gives access to it.
    filler = Path(f"/proc/{pid}/root{rig.recordings}") / FILLER
    filler.unlink(missing_ok=True)
    if step.full:
        with filler.open("wb") as file, contextlib.suppress(OSError):
            while True:
                os.write(file.fileno(), bytes(4096))
    if step.read_only:
        _remount(rig, pid, "ro")


@act.register
def _model_file(step: ModelFile, rig: Rig) -> None:
    good = rig.settings.model.read_bytes()
    new = rig.model_file.with_suffix(".new")
    new.write_bytes(good if step.content == "good" else good[: len(good) // 2])
    new.replace(rig.model_file)


@act.register
def _load(step: Load, rig: Rig) -> None:
    count = step.times * (os.cpu_count() or 1)
    # Linux shares the CPU between sessions first: in the rig's own, the load would slow the relays and not the daemon.
    busy = [
        subprocess.Popen([*ENDS_WITH_US, sys.executable, "-c", _BUSY], start_new_session=True) for _ in range(count)
    ]
    try:
        threading.Event().wait(step.for_s)
    finally:
        for process in busy:
            process.kill()
        for process in busy:
            process.wait()


def _datagrams(step: Flood, rig: Rig) -> Iterator[bytes]:
    if step.what == "random":
        return hostile.random_datagrams(random.Random(0))
    if step.what == "hostile":
        return hostile.hostile_datagrams()
    tape = list(rig.mavlink.tape)
    if not tape:
        raise PlayError("nothing to replay: the autopilot has said nothing yet")
    return itertools.cycle(tape)


@contextlib.contextmanager
def _sender(sender: str, rig: Rig) -> Iterator[Callable[[bytes], None]]:
    if sender == "autopilot":
        yield rig.mavlink.inject
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        yield lambda datagram: _ignore(stranger.sendto(datagram, (LOOPBACK, rig.mavlink_port)))


def _ignore(_: object) -> None:
    return None


def _remount(rig: Rig, pid: int, how: str) -> None:
    command = ["nsenter", "--target", str(pid), "--user", "--preserve-credentials", "--mount"]
    command += ["mount", "-o", f"remount,{how}", str(rig.recordings)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise PlayError(f"the volume cannot be remounted {how}: {done.stderr.strip()}")
