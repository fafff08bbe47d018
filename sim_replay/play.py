"""Plays a sequence through the real daemon with both of its peers, and records what they received.

Four processes share the host's CLOCK_MONOTONIC: the daemon exposes frame 0 at `start_at_ns`, the simulated autopilot
sends the telemetry from that time on, and the subscriber receives poses. This process only starts them, waits and
reads their output.
"""

from __future__ import annotations

import json
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from edge.config_estimator import TargetSettings
from edge.errors import InputError
from edge.estimator.given_size import TargetSize
from msgs.command_line import EXIT_BAD_INPUT
from msgs.settings import dotted, faults_of
from sim_replay.bad_link import LinkFaults
from sim_replay.daemon_config import UAV, sequence_config
from sim_replay.faults.processes import ENDS_WITH_US
from sim_replay.gimbal import write_gimbal
from sim_replay.ground_truth import PlayedSequence
from sim_replay.ports import LOOPBACK, free_endpoint, free_port

LEADS_S = (5.0, 15.0, 45.0)  # until frame 0, for the daemon to become ready; too slow: the next value is tried
READY_MARGIN_NS = 100_000_000
RECORDINGS = "recordings"  # folder in `out`
MESSAGES_JSONL = "mavlink.jsonl"
_OVERTIME_S = 20.0
_STOP_TIMEOUT_S = 5.0
_SETTLE_S = 0.3

Record = dict[str, Any]


class PlayError(RuntimeError):
    """The daemon or a peer failed; the text is a whole sentence."""


@dataclass
class Recording:
    """The output of one replay. Times ending in `_ns` are monotonic unless they say UTC."""

    start_at_ns: int
    utc_minus_monotonic_ns: int
    mavlink_port: int
    zenoh_endpoint: str  # empty in lock-step
    daemon_exit: int | None = None
    daemon_counters: dict[str, int] = field(default_factory=dict)  # the daemon's own, as logged when it stopped
    poses: list[Record] = field(default_factory=list)  # sim_replay.subscriber's `pose`
    targets: list[Record] = field(default_factory=list)  # sim_replay.autopilot's `target_relative`
    directions: list[Record] = field(default_factory=list)  # its `direction`
    diagnostics: list[Record] = field(default_factory=list)
    mavlink: Record = field(default_factory=dict)  # the autopilot's `summary`
    zenoh: Record = field(default_factory=dict)  # the subscriber's `summary`

    def take(self, name: str, record: Record) -> None:
        """Store one record printed by a peer."""
        lists = {
            "pose": self.poses,
            "direction": self.directions,
            "target_relative": self.targets,
            "diagnostics": self.diagnostics,
        }
        if record["event"] in lists:
            lists[record["event"]].append(record)
        elif record["event"] == "summary":
            (self.mavlink if name == "autopilot" else self.zenoh).update(record)

    @property
    def in_lockstep(self) -> bool:
        """Whether the daemon's clock stood still while it worked; ages and latencies are then meaningless."""
        return not self.zenoh_endpoint

    def capture_ns(self, record: Record) -> int:
        """Exposure time, monotonic, of a pose, direction or target record."""
        utc_ns = record["capture_utc_ns"] if "capture_utc_ns" in record else record["capture_utc_us"] * 1000
        return int(utc_ns) - self.utc_minus_monotonic_ns


@dataclass(frozen=True)
class PlaySettings:
    """What is played and where its files go."""

    sequence: PlayedSequence
    out: Path
    model: Path | None = None  # None: the model shipped with the daemon
    record: bool = False  # into out/recordings, by the daemon
    firmware: str = "ardupilot"  # one of sim_replay.autopilot.FIRMWARES
    link: LinkFaults = field(default_factory=LinkFaults)  # between daemon and autopilot
    target_size: TargetSize | None = None  # given to the daemon


def target_size(wingspan_length_m: Sequence[float] | None) -> TargetSize | None:
    """Of two numbers as the commands take them. Raises InputError for what the daemon does not take."""
    if wingspan_length_m is None:
        return None
    wingspan_m, length_m = wingspan_length_m
    try:
        return TargetSettings(wingspan_m=wingspan_m, length_m=length_m).size()
    except ValidationError as error:
        told = ", ".join(f"{dotted(fault.location)} {fault.reason}" for fault in faults_of(error))
        raise InputError(f"--target-size {wingspan_m:g} {length_m:g}: {told}") from error


def play(settings: PlaySettings, on_record: Callable[[Recording, Record], None]) -> Recording:
    """Run the sequence once in real time; `on_record` is called with each record of a peer as it arrives.

    Raises InputError if the daemon rejects its input, PlayError if it is late, fails, terminates before the last frame
    or not at all, or if a peer terminates before it or gives no summary.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    for lead_s in LEADS_S:
        recording = _attempt(settings, lead_s, on_record)
        if recording is not None:
            return recording
    raise PlayError(f"the daemon was not ready within {LEADS_S[-1]:.0f} s; see {settings.out / 'daemon.log'}")


def _attempt(settings: PlaySettings, lead_s: float, on_record: Callable[[Recording, Record], None]) -> Recording | None:
    """One run with frame 0 `lead_s` from now; None if the daemon became ready too late."""
    start_at_ns = time.monotonic_ns() + round(lead_s * 1e9)
    utc_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
    recording = Recording(start_at_ns, utc_minus_monotonic_ns, free_port(socket.SOCK_DGRAM), free_endpoint())
    config = settings.out / "config.toml"
    text = sequence_config(
        settings.sequence,
        settings.model,
        recording.zenoh_endpoint,
        recording.mavlink_port,
        {"start_at_ns": recording.start_at_ns},
        settings.out / RECORDINGS if settings.record else None,
        to_px4=settings.firmware == "px4",
        target_size=settings.target_size,
    )
    config.write_text(text, encoding="utf-8")
    records: queue.SimpleQueue[tuple[str, Record]] = queue.SimpleQueue()
    with ExitStack() as stack:
        daemon = stack.enter_context(_daemon(config, settings.out / "daemon.log"))
        peers = {
            name: stack.enter_context(_peer(name, arguments, records))
            for name, arguments in _peers(settings, recording, lead_s).items()
        }
        if not _wait_until_ready(daemon, peers, recording, records, on_record):
            return None
        last_ns = start_at_ns + round((len(settings.sequence.scene.images) - 1) * 1e9 / settings.sequence.fps)
        deadline_ns = last_ns + round(_OVERTIME_S * 1e9)
        while daemon.poll() is None and time.monotonic_ns() < deadline_ns:
            _pass_on(records, recording, on_record, timeout_s=0.05)
            _check_peers_run(peers)
        left_ns = last_ns - time.monotonic_ns()
        recording.daemon_exit = daemon.poll()
        settled_ns = time.monotonic_ns() + round((_SETTLE_S + settings.link.late_ms_max * 1e-3) * 1e9)
        while time.monotonic_ns() < settled_ns:
            _pass_on(records, recording, on_record, timeout_s=0.05)
        _check_exit(recording.daemon_exit, left_ns, settings.out / "daemon.log")
        _check_peers_run(peers)
    while not records.empty():
        _pass_on(records, recording, on_record, timeout_s=0.0)
    _check_summaries(recording)
    recording.daemon_counters = last_counters((settings.out / "daemon.log").read_text(encoding="utf-8"))
    return recording


def last_counters(log: str) -> dict[str, int]:
    """The counters of the daemon's `stopped:` line, which leaves out those that are zero. Raises PlayError."""
    stopped = [line for line in log.splitlines() if "stopped: " in line]
    if not stopped:
        raise PlayError("the daemon ended without its `stopped:` line")
    return {name: int(count) for name, count in re.findall(r"(\w+)=(\d+)", stopped[-1].rpartition("|")[2])}


def _check_exit(code: int | None, left_ns: int, log: Path) -> None:
    """Raise what the daemon's end means, `left_ns` before the last frame: InputError for bad input, else PlayError."""
    if code == 0 and left_ns > 0:
        raise PlayError(f"the daemon ended {left_ns * 1e-9:.1f} s before the last frame, with exit code 0; see {log}")
    if code == 0:
        return
    if code is None:
        raise PlayError(f"the daemon did not end {_OVERTIME_S:.0f} s after the last frame; see {log}")
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = words[-1] if words else "it said nothing"
    if code == EXIT_BAD_INPUT:
        raise InputError(last)
    raise PlayError(f"the daemon ended with exit code {code}: {last}")


def _check_peers_run(peers: Mapping[str, subprocess.Popen[str]]) -> None:
    for name, peer in peers.items():
        if peer.poll() is not None:
            raise PlayError(f"the {name} ended before the daemon, with exit code {peer.returncode}")


def _check_summaries(recording: Recording) -> None:
    for name, summary in (("autopilot", recording.mavlink), ("subscriber", recording.zenoh)):
        if not summary:
            raise PlayError(f"the {name} gave no summary of what it received when it was told to stop")


def _pass_on(
    records: queue.SimpleQueue[tuple[str, Record]],
    recording: Recording,
    on_record: Callable[[Recording, Record], None],
    timeout_s: float,
) -> None:
    try:
        name, record = records.get(timeout=timeout_s)
    except queue.Empty:
        return
    recording.take(name, record)
    on_record(recording, record)


def _wait_until_ready(
    daemon: subprocess.Popen[bytes],
    peers: Mapping[str, subprocess.Popen[str]],
    recording: Recording,
    records: queue.SimpleQueue[tuple[str, Record]],
    on_record: Callable[[Recording, Record], None],
) -> bool:
    """Whether the daemon was up (its first diagnostics arrived) in time for frame 0, or terminated."""
    while time.monotonic_ns() < recording.start_at_ns - READY_MARGIN_NS:
        _pass_on(records, recording, on_record, timeout_s=0.05)
        if recording.diagnostics or daemon.poll() is not None:
            return True
        _check_peers_run(peers)
    return False


def _peers(settings: PlaySettings, recording: Recording, lead_s: float) -> dict[str, list[str]]:
    """Arguments of each peer; the subscriber waits up to `lead_s` for the daemon to appear."""
    telemetry = str(settings.sequence.telemetry_csv)
    address = f"{LOOPBACK}:{recording.mavlink_port}"
    start = str(recording.start_at_ns - settings.sequence.frame0_ns)
    autopilot = ["--telemetry", telemetry, "--endpoint", address, "--start-at-ns", start]
    autopilot += ["--firmware", settings.firmware, *settings.link.arguments()]
    autopilot += ["--messages", str(settings.out / MESSAGES_JSONL)]
    if settings.sequence.gimbal is not None:
        gimbal_csv = settings.out / "gimbal.csv"
        write_gimbal(gimbal_csv, settings.sequence.gimbal)
        autopilot += ["--gimbal", str(gimbal_csv)]
    return {
        "autopilot": autopilot,
        "subscriber": ["--connect", recording.zenoh_endpoint, "--uav", UAV, "--wait-s", str(lead_s)],
    }


@contextmanager
def _daemon(config: Path, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`uavpose-edge run` with its output in `log`; told to stop at the end if it is still running."""
    command = Path(sys.executable).parent / "uavpose-edge"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*ENDS_WITH_US, str(command), "run", "--config", str(config)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # the terminal's Ctrl-C is for this process, which then stops the others
        )
        try:
            yield process
        finally:
            _stop(process)


@contextmanager
def _peer(
    name: str, arguments: list[str], records: queue.SimpleQueue[tuple[str, Record]]
) -> Iterator[subprocess.Popen[str]]:
    """`python -m sim_replay.<name>`, whose records go to `records`; at the end it is stopped and its output drained."""
    process = subprocess.Popen(
        [*ENDS_WITH_US, sys.executable, "-m", f"sim_replay.{name}", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    lines = process.stdout

    def read() -> None:
        with lines:
            for line in lines:
                records.put((name, json.loads(line)))

    reader = threading.Thread(target=read, name=f"read {name}", daemon=True)
    reader.start()
    try:
        yield process
    finally:
        _stop(process)
        reader.join(timeout=_STOP_TIMEOUT_S)


def _stop(process: subprocess.Popen[Any]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
    try:
        process.wait(timeout=_STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
