"""`uavpose-replay play` in lock-step: at any speed, from any frame, repeatedly, or frame by frame."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from shlex import quote

from rich.console import Console
from rich.progress import Progress

from edge.errors import InputError
from edge.estimator.model import load_model
from sim_replay.ground_truth import PlayedSequence
from sim_replay.lockstep.peers import Record
from sim_replay.lockstep.player import POSES_JSONL, LockstepSettings, play_lockstep
from sim_replay.offline import method_of
from sim_replay.play import MESSAGES_JSONL, target_size
from sim_replay.recorded.opened import open_sequence
from sim_replay.report.flight_files import RecordedFlight, remove_flight, write_flight

SLOWEST = 0.25
ROUNDS_MAX = 10_000
GO_ON = "g"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `play` besides sequence, model and output folder."""
    group = parser.add_argument_group(
        "lock-step",
        "The daemon's clock is the sequence's, and the next frame is given when the outputs of the last one have "
        "reached both peers. Writes poses.jsonl and mavlink.jsonl, identical each time. Each of these options "
        "implies lock-step.",
    )
    group.add_argument("--lockstep", action="store_true", help="play in lock-step, as fast as the machine can")
    group.add_argument(
        "--speed",
        type=_speed,
        metavar="X",
        help=f"speed relative to real time, at least {SLOWEST}, or max (default: max)",
    )
    group.add_argument("--start", type=float, metavar="S", help="begin S seconds into the sequence")
    group.add_argument("--loop", type=int, metavar="N", help="play the sequence N times in one flight")
    group.add_argument(
        "--pause", type=int, metavar="FRAME", help=f"stop before FRAME; Enter plays it, {GO_ON} continues"
    )
    group.add_argument(
        "--step", action="store_true", help=f"stop before every frame; Enter plays it, {GO_ON} continues"
    )


def asked_for(args: argparse.Namespace) -> bool:
    """Whether the parsed options imply lock-step."""
    given = (args.speed, args.start, args.loop, args.pause)
    return bool(args.lockstep or args.step or any(value is not None for value in given))


def run(args: argparse.Namespace, console: Console) -> int:
    """Play, and write the outputs. Raises InputError, PlayError."""
    rounds, size, method = _rounds(args.loop), target_size(args.target_size), method_of(load_model(args.model, 1))
    sequence = open_sequence(args.sequence, args.out, console)
    settings = LockstepSettings(sequence, args.model, _start(args.start, sequence), rounds=rounds, target_size=size)
    if args.pause is not None and args.pause not in settings.frames:
        raise InputError(
            f"--pause {args.pause}: is not one of the frames {settings.frames[0]} to {settings.frames[-1]}"
        )
    gate = Gate(sequence.fps, args.speed, args.pause, args.step, console.input)
    told = args.step or args.pause is not None
    remove_flight(args.out)

    with Progress(console=console, disable=told or not console.is_terminal) as progress:
        task = progress.add_task("playing", total=len(settings.frames))

        def after_frame(frame: int, found: list[Record]) -> None:
            progress.advance(task)
            if told:
                text = f"frame {frame}: not recorded" if frame in sequence.scene.unrecorded else line_of(frame, found)
                console.print(text, highlight=False, soft_wrap=True)

        outputs = play_lockstep(settings, gate.before, after_frame)
    outputs.write(args.out)
    files = f"{POSES_JSONL}, {MESSAGES_JSONL}"
    if settings.frames == list(range(len(sequence.scene.images))):  # after a part only, the rest would count as missed
        write_flight(args.out, RecordedFlight(sequence.scene.folder, method, outputs.recording))
        files += f"; to score it: uavpose-replay score {quote(str(args.out))}" if sequence.scene.can_be_scored else ""
    text = f"{len(settings.frames)} frames: {len(outputs.poses)} poses, {len(outputs.recording.directions)} directions"
    text += f", {len(outputs.mavlink)} MAVLink messages"
    console.print(f"{text}; written to {args.out}: {files}", highlight=False, soft_wrap=True)
    return 0


class Gate:
    """Holds a frame back until it is due, or until the user releases it."""

    def __init__(
        self, fps: float, speed: float | None, pause: int | None, step: bool, ask: Callable[[str], str]
    ) -> None:
        """`speed` None: as fast as possible; `ask` prompts the user and returns the line, or raises EOFError."""
        self._period_s = 0.0 if speed is None else 1.0 / (fps * speed)
        self._pause = pause
        self._step = step
        self._ask = ask
        self._due_s: float | None = None

    def before(self, frame: int) -> None:
        """Returns when `frame` may be played."""
        if self._step or frame == self._pause:
            self._step = self._person_steps(frame)
            self._pause = None
            self._due_s = None
        now_s = time.monotonic()
        if self._due_s is not None:
            time.sleep(max(self._due_s - now_s, 0.0))
        self._due_s = max(now_s, self._due_s or now_s) + self._period_s

    def _person_steps(self, frame: int) -> bool:
        try:
            return self._ask(f"before frame {frame}> ").strip() != GO_ON
        except EOFError:
            return False


def line_of(frame: int, found: list[Record]) -> str:
    """The poses and directions of a frame, for the console."""
    told = [
        f"{one['target']} at {' '.join(f'{x:.2f}' for x in one['t_cam_target_m'])} m"
        if "t_cam_target_m" in one
        else f"{one['target']} towards {' '.join(f'{x:.3f}' for x in one['ray_cam'])}, range not known"
        for one in found
    ]
    return f"frame {frame}: {', '.join(told) or 'no target'}"


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not SLOWEST <= value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is neither a number of at least {SLOWEST} nor max")
    return value


def _start(seconds: float | None, sequence: PlayedSequence) -> int:
    if seconds is None:
        return 0
    last_s = (len(sequence.scene.images) - 1) / sequence.fps
    if not 0.0 <= seconds <= last_s:
        raise InputError(f"--start {seconds}: must be from 0 to {last_s:.3f} s, the times of the sequence's frames")
    return round(seconds * sequence.fps)


def _rounds(times: int | None) -> int:
    if times is not None and not 1 <= times <= ROUNDS_MAX:
        raise InputError(f"--loop {times}: must be from 1 to {ROUNDS_MAX}")
    return times or 1
