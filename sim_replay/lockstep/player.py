"""Plays a sequence in lock-step through the real daemon process: a step begins when the last one's outputs arrived.

Time is the sequence's: the daemon's clock (edge.clock) is stepped to each message of the autopilot and each frame,
over the daemon's own sockets, and nothing in the outputs depends on how long a step took.
"""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from edge.errors import InputError
from edge.estimator.given_size import TargetSize
from msgs.command_line import EXIT_BAD_INPUT
from sim_replay.autopilot import BOOT_BEFORE_START_NS, Autopilot
from sim_replay.daemon_config import UAV, sequence_config
from sim_replay.faults.processes import Process
from sim_replay.gimbal import looped as looped_gimbal
from sim_replay.ground_truth import PlayedSequence
from sim_replay.lockstep.control import Control
from sim_replay.lockstep.peers import MavlinkPeer, Record, Subscriber
from sim_replay.pipeline.flight import looped
from sim_replay.play import MESSAGES_JSONL, PlayError, Recording
from sim_replay.ports import free_endpoint, free_port
from sim_replay.telemetry import read_telemetry

BASE_NS = 1_000_000_000_000  # the stepped clock where the telemetry's is 0: later than the autopilot's boot
LEAD_NS = 1_000_000_000  # of telemetry before the first frame
ENDING_S = 3.0  # from disconnecting to the daemon's end
POSES_JSONL = "poses.jsonl"

BeforeFrame = Callable[[int], None]
AfterFrame = Callable[[int, list[Record]], None]


@dataclass(frozen=True)
class LockstepSettings:
    """What is played: the frames from `start` up to before `stop` (None: to the last), `rounds` times."""

    sequence: PlayedSequence
    model: Path
    start: int = 0
    stop: int | None = None
    rounds: int = 1
    target_size: TargetSize | None = None  # given to the daemon

    @property
    def frames(self) -> list[int]:
        """Their numbers, in the order of playing."""
        return list(range(self.start, len(self.sequence.scene.images))[: self._count]) * self.rounds

    @property
    def _count(self) -> int | None:
        return None if self.stop is None else max(self.stop - self.start, 0)


@dataclass(frozen=True)
class Outputs:
    """What both peers received, in order; times count from the exposure of frame 0."""

    poses: list[Record]  # as the subscriber received them
    mavlink: list[Record]  # as the autopilot received them, by field
    recording: Recording  # for `sim_replay.score`; its monotonic clock and UTC are the stepped clock

    def write(self, folder: Path) -> None:
        """Write poses.jsonl and mavlink.jsonl."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, records in ((POSES_JSONL, self.poses), (MESSAGES_JSONL, self.mavlink)):
            lines = "".join(json.dumps(record) + "\n" for record in records)
            (folder / name).write_text(lines, encoding="utf-8")


def play_lockstep(settings: LockstepSettings, before_frame: BeforeFrame, after_frame: AfterFrame) -> Outputs:
    """Play the sequence. `before_frame` is called with each frame's number and may block; `after_frame` is called
    afterwards with the number and the resulting poses and directions, none for a frame that was not recorded.

    Raises:
        InputError: the daemon rejects its input.
        PlayError: it terminates or does not answer; the text has its last output.
    """
    said: list[str] = []
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(TemporaryDirectory(prefix="uavpose-lockstep-")))
        control = cleanup.enter_context(closing(Control()))
        mavlink_port, endpoint = free_port(socket.SOCK_DGRAM), free_endpoint()
        config = folder / "config.toml"
        camera = {"lockstep": control.address}
        text = sequence_config(
            settings.sequence, settings.model, endpoint, mavlink_port, camera, target_size=settings.target_size
        )
        config.write_text(text, encoding="utf-8")
        command: list[str | Path] = [Path(sys.executable).parent / "uavpose-edge", "run", "--config", config]
        daemon = Process(command, lambda line, _: said.append(line))
        cleanup.callback(daemon.end)
        try:
            control.wait_until_ready(lambda: daemon.exit_code is None)
            flight = Flight(settings, control, mavlink_port, endpoint)
            cleanup.callback(flight.close)
            flight.fly(before_frame, after_frame)
        except PlayError as error:
            raise _because(daemon, said, error) from error
        control.close()
        if (code := daemon.reap()) != 0:
            raise PlayError(f"the daemon ended with exit code {code}: {said[-1] if said else 'no output'}")
        return flight.outputs


def _because(daemon: Process, said: Sequence[str], error: PlayError) -> InputError | PlayError:
    """The player's error, with the daemon's last output if it has terminated."""
    if daemon.wait(ENDING_S) is None:
        return error
    code = daemon.reap()
    last = said[-1] if said else "no output"
    return InputError(last) if code == EXIT_BAD_INPUT else PlayError(f"{error}: {last}")


class Flight:
    """Both peers and the clock of one replay, once the daemon has warmed up."""

    def __init__(self, settings: LockstepSettings, control: Control, mavlink_port: int, endpoint: str) -> None:
        sequence, frames = settings.sequence, settings.frames
        offset_ns = round(settings.start * 1e9 / sequence.fps)
        telemetry, first_ns = read_telemetry(sequence.telemetry_csv), sequence.frame0_ns + offset_ns
        gimbal = sequence.gimbal
        if settings.rounds > 1:
            round_s = len(frames) / settings.rounds / sequence.fps
            if gimbal is not None:
                gimbal = looped_gimbal(gimbal, first_ns, round_s, settings.rounds)
            telemetry, first_ns = looped(telemetry, first_ns, round_s, settings.rounds), 0
        self._fps = sequence.fps
        self._frames, self._unrecorded = frames, sequence.scene.unrecorded
        self._first_ns = BASE_NS + first_ns
        self._frame0_ns = frame0_ns = self._first_ns - offset_ns
        autopilot = Autopilot(telemetry, BASE_NS, BASE_NS - BOOT_BEFORE_START_NS, gimbal=gimbal)
        self._subscriber = Subscriber(endpoint, UAV, frame0_ns)
        self._mavlink = MavlinkPeer(autopilot, mavlink_port, frame0_ns)
        self._stepper = Stepper(control, self._mavlink, self._first_ns - LEAD_NS)

    @property
    def outputs(self) -> Outputs:
        recording = Recording(self._frame0_ns, 0, 0, "", 0)
        recording.poses, recording.targets = self._subscriber.received, self._mavlink.targets
        recording.directions = self._subscriber.directions
        return Outputs(self._subscriber.records, self._mavlink.records, recording)

    def fly(self, before_frame: BeforeFrame, after_frame: AfterFrame) -> None:
        """All frames, one after the other. Raises PlayError."""
        for count, frame in enumerate(self._frames):
            before_frame(frame)
            exposed_ns = self._first_ns + round(count * 1e9 / self._fps)
            self._stepper.advance(exposed_ns)
            if frame in self._unrecorded:
                after_frame(frame, [])
                continue
            self._stepper.expose(frame)
            after_frame(frame, self._subscriber.collect(frame, exposed_ns))

    def close(self) -> None:
        self._subscriber.close()
        self._mavlink.close()


class Stepper:
    """Steps the daemon's clock, and the autopilot's with it."""

    def __init__(self, control: Control, mavlink: MavlinkPeer, start_ns: int) -> None:
        self._control = control
        self._mavlink = mavlink
        self._now_ns = start_ns

    def advance(self, until_ns: int) -> None:
        """Advance to `until_ns`, stopping at each time at which the autopilot has a message to send."""
        while (due_ns := self._mavlink.next_due_ns()) is not None and due_ns < until_ns:
            self._now_ns = max(due_ns, self._now_ns)
            self._let_it_be_now()
        self._now_ns = until_ns
        self._let_it_be_now()

    def expose(self, frame: int) -> None:
        """Give image `frame` to the daemon now; returns when the daemon has processed it."""
        self._control.step("frame", frame)
        self._exchange()

    def _let_it_be_now(self) -> None:
        self._mavlink.speak(self._now_ns)
        self._control.step("time", self._now_ns)
        self._exchange()

    def _exchange(self) -> None:
        # The autopilot's answers arrive at the same instant: the link of a replay has no delay.
        while self._mavlink.listen(self._now_ns):
            self._control.step("time", self._now_ns)
