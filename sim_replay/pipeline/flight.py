"""A sequence flown repeatedly through the real daemon, with a simulated autopilot and a zenoh subscriber."""

from __future__ import annotations

import json
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import InputError
from msgs.command_line import EXIT_BAD_INPUT
from sim_replay.daemon_config import UAV, sequence_config
from sim_replay.faults.processes import Process
from sim_replay.ground_truth import PlayedSequence
from sim_replay.pace import sped_up
from sim_replay.pipeline.usage import Usage, usage_of
from sim_replay.play import LEADS_S, READY_MARGIN_NS, PlayError
from sim_replay.ports import LOOPBACK, free_endpoint, free_port
from sim_replay.telemetry import FLOWN_CSV, Telemetry, read_telemetry, write_telemetry

SAMPLE_S = 1.0


@dataclass(frozen=True)
class FlightSettings:
    """What is flown, for how long, and the output folder."""

    sequence: PlayedSequence
    out: Path
    minutes: float
    model: Path
    fps: float  # images per second; all motion becomes faster or slower with it

    @property
    def period_s(self) -> float:
        """Duration of one pass through the sequence."""
        return len(self.sequence.scene.images) / self.fps


@dataclass
class Flight:
    """Observations of the flight. Times are monotonic unless they say UTC."""

    started_ns: int  # the daemon's process
    start_at_ns: int  # exposure of frame 0
    utc_minus_monotonic_ns: int
    ready_ns: int | None = None  # when the daemon reported that it had warmed up
    said: list[str] = field(default_factory=list)  # the daemon's output
    complaints: list[str] = field(default_factory=list)  # other output of its peers
    targets: list[dict[str, Any]] = field(default_factory=list)  # sim_replay.autopilot's `target_relative`
    diagnostics: list[dict[str, Any]] = field(default_factory=list)  # sim_replay.subscriber's
    poses_ns: list[int] = field(default_factory=list)  # arrival of each over zenoh
    poses_utc_ns: list[int] = field(default_factory=list)  # their exposure times
    usage: list[Usage] = field(default_factory=list)  # of the daemon, from frame 0 on
    logged: list[tuple[int, int]] = field(default_factory=list)  # arrival and bytes of each line of its log
    ended: threading.Event = field(default_factory=threading.Event)  # set when a process has ended
    ready_or_ended: threading.Event = field(default_factory=threading.Event)

    def hear_end(self) -> None:
        self.ended.set()
        self.ready_or_ended.set()

    def hear_daemon(self, line: str, heard_ns: int) -> None:
        self.said.append(line)
        self.logged.append((heard_ns, len(line.encode()) + 1))
        if self.ready_ns is None and "ready: " in line:
            self.ready_ns = heard_ns
            self.ready_or_ended.set()

    def hear_peer(self, line: str, heard_ns: int) -> None:
        try:
            record = json.loads(line)
        except ValueError:  # not a record: its last output
            self.complaints.append(line)
            return
        if record["event"] == "target_relative":
            self.targets.append(record)
        elif record["event"] == "diagnostics":
            self.diagnostics.append(record)
        elif record["event"] == "pose":
            self.poses_ns.append(heard_ns)
            self.poses_utc_ns.append(record["capture_utc_ns"])


def fly(settings: FlightSettings, on_second: Callable[[float], None]) -> Flight:
    """Fly for `minutes`; `on_second` is called with the finished share, 0..1.

    Raises InputError if the daemon rejects its input, PlayError if it is late or terminates.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    rounds = math.ceil(settings.minutes * 60 / settings.period_s) + 1
    sequence = settings.sequence
    telemetry = sped_up(read_telemetry(sequence.telemetry_csv), sequence.frame0_ns, settings.fps / sequence.fps)
    looped_csv = settings.out / FLOWN_CSV
    write_telemetry(looped_csv, looped(telemetry, sequence.frame0_ns, settings.period_s, rounds))
    for lead_s in LEADS_S:
        flight = _attempt(settings, looped_csv, lead_s, on_second)
        if flight is not None:
            return flight
    raise PlayError(f"the daemon was not ready within {LEADS_S[-1]:.0f} s; see {settings.out / 'daemon.log'}")


def looped(telemetry: Telemetry, frame0_ns: int, period_s: float, rounds: int) -> Telemetry:
    """What precedes the frames, then the part that belongs to them, repeated; t_ns is 0 at the first exposure."""
    t_ns = telemetry.t_ns - frame0_ns
    period_ns = round(period_s * 1e9)
    inside = (t_ns >= 0) & (t_ns < period_ns)
    times = [t_ns[inside] + turn * period_ns for turn in range(rounds)]
    before = t_ns < 0
    values = np.concatenate([telemetry.values[before], *[telemetry.values[inside]] * rounds])
    return Telemetry(np.concatenate([t_ns[before], *times]), values)


def _attempt(
    settings: FlightSettings, telemetry_csv: Path, lead_s: float, on_second: Callable[[float], None]
) -> Flight | None:
    """One flight with frame 0 `lead_s` from now; None if the daemon became ready too late."""
    now_ns = time.monotonic_ns()
    flight = Flight(now_ns, now_ns + round(lead_s * 1e9), time.time_ns() - now_ns)
    mavlink_port, endpoint = free_port(socket.SOCK_DGRAM), free_endpoint()
    config = settings.out / "config.toml"
    camera = {"start_at_ns": flight.start_at_ns, "loop": True}
    sequence = replace(settings.sequence, fps=settings.fps)
    config.write_text(sequence_config(sequence, settings.model, endpoint, mavlink_port, camera), encoding="utf-8")
    command = Path(sys.executable).parent / "uavpose-edge"
    log = settings.out / "daemon.log"
    with ExitStack() as cleanup:
        cleanup.callback(lambda: log.write_text("".join(f"{line}\n" for line in flight.said), encoding="utf-8"))
        peers = _peers(flight, telemetry_csv, mavlink_port, endpoint)
        for peer in peers:
            cleanup.callback(peer.end)
        daemon = Process([command, "run", "--config", config], flight.hear_daemon, flight.hear_end)
        cleanup.callback(daemon.end)  # ends first: the peers receive all that it sent
        if not _came(flight.ready_or_ended, flight.start_at_ns - READY_MARGIN_NS):
            return None
        _watch(settings, flight, daemon, peers, on_second)
    return flight


def _watch(
    settings: FlightSettings,
    flight: Flight,
    daemon: Process,
    peers: Sequence[Process],
    on_second: Callable[[float], None],
) -> None:
    """Record the daemon's usage until the time is over. Raises InputError, PlayError if a process ends early."""
    end_ns = flight.start_at_ns + round(settings.minutes * 60e9)
    next_ns = flight.start_at_ns
    while next_ns < end_ns:
        _came(flight.ended, next_ns)
        _check_all_run(flight, daemon, peers)
        flight.usage.append(usage_of(daemon.pid))
        next_ns += round(SAMPLE_S * 1e9)
        on_second(min((next_ns - flight.start_at_ns) / (end_ns - flight.start_at_ns), 1.0))
    _came(flight.ended, end_ns)
    _check_all_run(flight, daemon, peers)


def _came(event: threading.Event, until_ns: int) -> bool:
    """Wait for an event until a monotonic time; returns whether it was set.

    In steps: if the kernel delivered a signal to another thread, this one handles it between two of them.
    """
    while (left_s := (until_ns - time.monotonic_ns()) * 1e-9) > 0 and not event.is_set():
        event.wait(min(left_s, SAMPLE_S))
    return event.is_set()


def _check_all_run(flight: Flight, daemon: Process, peers: Sequence[Process]) -> None:
    for process, words in ((daemon, flight.said), *((peer, flight.complaints) for peer in peers)):
        if process.exit_code is not None:
            code = process.reap()
            last = words[-1] if words else "no output"
            if process is daemon and code == EXIT_BAD_INPUT:
                raise InputError(last)
            raise PlayError(f"{'the daemon' if process is daemon else 'a peer'} ended with exit code {code}: {last}")


def _peers(flight: Flight, telemetry_csv: Path, mavlink_port: int, endpoint: str) -> tuple[Process, ...]:
    python = [sys.executable, "-m"]
    autopilot = [*python, "sim_replay.autopilot", "--telemetry", str(telemetry_csv)]
    autopilot += ["--endpoint", f"{LOOPBACK}:{mavlink_port}", "--start-at-ns", str(flight.start_at_ns)]
    subscriber = [*python, "sim_replay.subscriber", "--connect", endpoint, "--uav", UAV]
    return tuple(Process(command, flight.hear_peer, flight.hear_end) for command in (autopilot, subscriber))
