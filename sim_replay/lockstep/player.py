"""Plays a sequence in lock-step through the real daemon process: no step before the last one's outputs are there.

Time is the sequence's: the daemon's clock (edge.clock) is stepped from message to message of the autopilot and from
frame to frame, over the daemon's own sockets, and nothing in the outputs depends on how long a step took.
"""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from edge.errors import InputError
from sim_replay.autopilot import BOOT_BEFORE_START_NS, Autopilot
from sim_replay.faults.processes import Process
from sim_replay.faults.relay import free_port
from sim_replay.ground_truth import PlayedSequence
from sim_replay.lockstep.control import Control
from sim_replay.lockstep.peers import MavlinkPeer, Record, Subscriber
from sim_replay.play import PlayError
from sim_replay.telemetry import read_telemetry

BASE_NS = 1_000_000_000_000  # the stepped clock where the telemetry's is 0: later than the autopilot's boot
LEAD_NS = 1_000_000_000  # of telemetry before the first frame
UAV = "uav1"
EXIT_BAD_INPUT = 2


@dataclass(frozen=True)
class LockstepSettings:
    """What is played, and where its files go. `frames` None: all."""

    sequence: PlayedSequence
    out: Path
    model: Path
    frames: Sequence[int] | None = None


@dataclass(frozen=True)
class Outputs:
    """What both peers got, in order; times count from the exposure of frame 0."""

    poses: list[Record]  # as the subscriber took them
    mavlink: list[Record]  # as the autopilot got them, by field

    def write(self, folder: Path) -> None:
        """poses.jsonl and mavlink.jsonl."""
        for name, records in (("poses", self.poses), ("mavlink", self.mavlink)):
            lines = "".join(json.dumps(record) + "\n" for record in records)
            (folder / f"{name}.jsonl").write_text(lines, encoding="utf-8")


def play_lockstep(settings: LockstepSettings, on_frame: Callable[[int], None]) -> Outputs:
    """Play the sequence; `on_frame` hears each frame's number when its outputs are there.

    Raises:
        InputError: the daemon refuses what it is given.
        PlayError: it ends or does not answer.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    said: list[str] = []
    log = settings.out / "daemon.log"
    with ExitStack() as cleanup:
        cleanup.callback(lambda: log.write_text("".join(f"{line}\n" for line in said), encoding="utf-8"))
        control = cleanup.enter_context(closing(Control()))
        mavlink_port, endpoint = free_port(socket.SOCK_DGRAM), f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        config = settings.out / "config.toml"
        config.write_text(_config_toml(settings, control.address, mavlink_port, endpoint), encoding="utf-8")
        daemon = Process(
            [Path(sys.executable).parent / "uavpose-edge", "run", "--config", config], lambda line, _: said.append(line)
        )
        cleanup.callback(daemon.end)
        try:
            control.wait_until_ready(lambda: daemon.exit_code is None)
            outputs = _fly(settings, control, mavlink_port, endpoint, cleanup, on_frame)
            control.close()
            code = daemon.reap()
        except PlayError as error:
            raise _because(daemon, said, error) from error
    if code != 0:
        raise PlayError(f"the daemon ended with exit code {code}: {said[-1] if said else 'it said nothing'}")
    return outputs


def _because(daemon: Process, said: Sequence[str], error: PlayError) -> InputError | PlayError:
    """What the player met, with the daemon's last words if it has ended."""
    if daemon.exit_code is None:
        return error
    code = daemon.reap()
    last = said[-1] if said else "it said nothing"
    return InputError(last) if code == EXIT_BAD_INPUT else PlayError(f"{error}: {last}")


def _fly(
    settings: LockstepSettings,
    control: Control,
    mavlink_port: int,
    endpoint: str,
    cleanup: ExitStack,
    on_frame: Callable[[int], None],
) -> Outputs:
    sequence = settings.sequence
    frame0_ns = BASE_NS + sequence.frame0_ns
    autopilot = Autopilot(read_telemetry(sequence.telemetry_csv), BASE_NS, BASE_NS - BOOT_BEFORE_START_NS)
    mavlink = cleanup.enter_context(closing(MavlinkPeer(autopilot, mavlink_port, frame0_ns)))
    subscriber = cleanup.enter_context(closing(Subscriber(endpoint, UAV, frame0_ns)))
    frames = range(len(sequence.scene.images)) if settings.frames is None else settings.frames
    exposed_ns = [frame0_ns + round(frame * 1e9 / sequence.fps) for frame in frames]
    stepper = Stepper(control, mavlink, exposed_ns[0] - LEAD_NS)
    for frame, time_ns in zip(frames, exposed_ns, strict=True):
        stepper.advance(time_ns)
        stepper.expose(frame)
        subscriber.collect(frame, time_ns)
        on_frame(frame)
    return Outputs(subscriber.records, mavlink.records)


class Stepper:
    """Moves the daemon's clock, and the autopilot's with it."""

    def __init__(self, control: Control, mavlink: MavlinkPeer, start_ns: int) -> None:
        self._control = control
        self._mavlink = mavlink
        self._now_ns = start_ns

    def advance(self, until_ns: int) -> None:
        """Let time pass to `until_ns`, with a stop wherever the autopilot has something to say."""
        while (due_ns := self._mavlink.next_due_ns()) is not None and due_ns < until_ns:
            self._now_ns = max(due_ns, self._now_ns)
            self._let_it_be_now()
        self._now_ns = until_ns
        self._let_it_be_now()

    def expose(self, frame: int) -> None:
        """Give the daemon picture `frame` now; returns when it has come round."""
        self._control.step("frame", frame)
        self._exchange()

    def _let_it_be_now(self) -> None:
        self._mavlink.speak(self._now_ns)
        self._control.step("time", self._now_ns)
        self._exchange()

    def _exchange(self) -> None:
        # What the autopilot answers is heard in the same instant: the link of a replay has no delay.
        while self._mavlink.listen(self._now_ns):
            self._control.step("time", self._now_ns)


def _config_toml(settings: LockstepSettings, control: str, mavlink_port: int, endpoint: str) -> str:
    """The daemon's configuration: loopback only. JSON's strings and nested lists are TOML's too."""
    sequence = settings.sequence
    lines = [
        "[vehicle]",
        f"name = {json.dumps(UAV)}",
        "[camera]",
        'type = "sequence"',
        f"path = {json.dumps(str(sequence.scene.folder.resolve()))}",
        f"fps = {sequence.fps}",
        f"lockstep = {json.dumps(control)}",
        "[mount]",
        f"R_body_cam = {json.dumps(sequence.mount.R_body_cam.tolist())}",
        f"t_body_cam_m = {json.dumps(sequence.mount.t_body_cam_m.tolist())}",
        "[model]",
        f"path = {json.dumps(str(settings.model.resolve()))}",
        "[zenoh]",
        f"listen = {json.dumps([endpoint])}",
        "[mavlink]",
        f'endpoints = ["udpin:127.0.0.1:{mavlink_port}"]',
    ]
    return "\n".join(lines) + "\n"
