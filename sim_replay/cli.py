"""Generate datasets, play sequences through the real daemon, and score its output."""

from __future__ import annotations

import argparse
import errno
import json
import signal
import sys
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.model import load_model
from sim_replay import bad_link
from sim_replay.autopilot import FIRMWARES
from sim_replay.benchmark import commands as benchmark
from sim_replay.datasets import open_dataset
from sim_replay.demo import BUNDLED_SEQUENCE, report_flight, show
from sim_replay.evaluation.judge import judge_frames, score_of
from sim_replay.evaluation.table import score_table, table_console
from sim_replay.faults import run as faults
from sim_replay.golden import run as golden
from sim_replay.ground_truth import read_sequence
from sim_replay.lock import alone_in
from sim_replay.lockstep import command as lockstep
from sim_replay.matrix import command as matrix
from sim_replay.matrix.verdict import wrong_poses
from sim_replay.offline import DEFAULT_THREADS, estimator_answers, method_of
from sim_replay.pipeline import command as pipeline
from sim_replay.play import PlayError, PlaySettings, target_size
from sim_replay.radio import run as radio
from sim_replay.recorded.opened import WHAT, open_sequence
from sim_replay.report.flight_files import read_flight
from sim_replay.result import judge

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_ALONE = ("demo", "play", "golden", "faults", "matrix", "bench-pipeline", "soak")  # what writes a folder of its own
_OF_A_FLIGHT, _OF_A_DATASET = ("sequence", "out"), ("model", "split", "every")  # options of `score`


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="uavpose-replay", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo",
        help="play the bundled sequence through the daemon and score its output",
        description="Start the daemon, a simulated autopilot (MAVLink over UDP) and a zenoh subscriber on this host, "
        "play the bundled sequence in real time, and write report.html, score.json and overlay.mp4. "
        "Needs no GPU, no display and no network. Exit code 0 only if both peers received poses.",
    )
    play = commands.add_parser(
        "play",
        help="like demo, with a sequence of your own, or in lock-step",
        description="Like demo, with a BOP scene folder that also holds sequence.toml and telemetry.csv, with an MCAP "
        "recording made by the daemon ([recorder] image_max_hz), or with a video and its telemetry. The last two have "
        "no ground truth and are not scored. Exit code 1 if a target is visible and a peer received no pose, or if the "
        "labels show no target and a peer received one.",
    )
    taken = f"{WHAT} (default: the bundled sequence)"
    play.add_argument("--sequence", type=Path, default=BUNDLED_SEQUENCE, metavar="PATH", help=taken)
    play.add_argument(
        "--record",
        action="store_true",
        help="have the daemon record images and outputs into OUT/recordings, for `uavpose-ground view` and `play`",
    )
    play.add_argument(
        "--target-size",
        type=float,
        nargs=2,
        metavar=("WINGSPAN", "LENGTH"),
        help="of the aircraft to be seen, metres, given to the daemon as [target] (default: not given)",
    )
    link = play.add_argument_group("the simulated autopilot and its link, in real time")
    link.add_argument(
        "--autopilot", choices=FIRMWARES, default="ardupilot", help="firmware to imitate (default: ardupilot)"
    )
    bad_link.add_options(link)
    lockstep.add_options(play)
    for name, command in (("demo", demo), ("play", play)):
        command.add_argument("--out", type=Path, default=Path("out") / name, metavar="DIR", help="output folder")
        command.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")

    benchmark.register(commands)
    pipeline.register(commands)
    faults.register(commands)
    matrix.register(commands)
    golden.register(commands)
    radio.register(commands)

    score = commands.add_parser(
        "score",
        help="score a recorded flight against ground truth, or a model on a dataset frame by frame",
        description="With FLIGHT, a folder that demo or play wrote: compare what the subscriber and the autopilot "
        "received with ground truth and write report.html, score.json, frames.jsonl and overlay.mp4. With --dataset: "
        "run acquire and track on every single frame, without tracker, clock and daemon.",
    )
    score.add_argument("flight", type=Path, nargs="?", metavar="FLIGHT", help="folder that demo or play wrote")
    score.add_argument("--sequence", type=Path, metavar="DIR", help="scene folder (default: the one that was played)")
    score.add_argument("--out", type=Path, metavar="DIR", help="output folder (default: FLIGHT)")
    score.add_argument("--dataset", type=Path, metavar="DIR", help="BOP scene, split or dataset folder")
    score.add_argument("--model", type=Path, help="ONNX file (default: the shipped one)")
    score.add_argument("--split", metavar="NAME", help="split of the dataset (default: all)")
    score.add_argument("--every", type=int, metavar="N", help="use every N-th image (default: all)")
    score.add_argument("--json", action="store_true", help="print the score as JSON")
    return parser


def _run(args: argparse.Namespace) -> int:
    if args.command not in _ALONE:
        return _act(args)
    with alone_in(args.out, "replay"):
        return _act(args)


def _act(args: argparse.Namespace) -> int:
    if hasattr(args, "run"):
        return int(args.run(args))
    console = Console(markup=False, emoji=False)  # folders are shown by the names that they have
    if args.command == "score":
        if (args.flight is None) == (args.dataset is None):
            raise InputError("score: give either FLIGHT, a folder that demo or play wrote, or --dataset DIR")
        _check_score_options(args)
        return _score_dataset(args, console) if args.flight is None else _score_flight(args, console)
    if args.command == "play" and lockstep.asked_for(args):
        if args.record or args.autopilot != "ardupilot" or bad_link.link_faults(args) != bad_link.LinkFaults():
            raise InputError("--record, --autopilot, --link-…: only in real time, not in lock-step")
        return lockstep.run(args, console)
    size = target_size(args.target_size) if args.command == "play" else None
    folder = BUNDLED_SEQUENCE if args.command == "demo" else args.sequence
    settings = PlaySettings(open_sequence(folder, args.out, console), args.out, args.model)
    if args.command == "play":
        chosen = {"record": args.record, "firmware": args.autopilot, "link": bad_link.link_faults(args)}
        settings = replace(settings, target_size=size, **chosen)
    recording = show(settings, args.model, console)
    wrong = wrong_poses(settings.sequence, judge(settings.sequence, recording))
    for told in wrong:
        print(told, file=sys.stderr)
    return 1 if wrong else 0


def _check_score_options(args: argparse.Namespace) -> None:
    """Raise InputError for options of the other kind of scoring."""
    others = _OF_A_DATASET if args.dataset is None else _OF_A_FLIGHT
    given = ", ".join(f"--{name}" for name in others if getattr(args, name) is not None)
    if given:
        one, other = ("--dataset", "FLIGHT") if args.dataset is None else ("FLIGHT", "--dataset")
        raise InputError(f"{given}: only with {one}, not with {other}")


def _score_flight(args: argparse.Namespace, console: Console) -> int:
    flight = read_flight(args.flight)
    sequence = read_sequence(args.sequence or flight.sequence)
    if not sequence.scene.can_be_scored:
        raise InputError(f"{sequence.scene.folder}: there is no ground truth to score against")
    sequence = replace(sequence, fps=sequence.fps * flight.speed)
    told = Console(stderr=True, quiet=True) if args.json else console
    score = report_flight(sequence, flight, args.out or args.flight, told)
    if args.json:
        print(json.dumps(score, indent=2, allow_nan=False))
    return 0


def _score_dataset(args: argparse.Namespace, console: Console) -> int:
    every = 1 if args.every is None else args.every
    if every < 1:
        raise InputError(f"--every {every}: must be at least 1")
    model = load_model(args.model or SHIPPED_MODEL, DEFAULT_THREADS)
    dataset = open_dataset(args.dataset, args.split)
    pictures = dataset.labelled_frames()[::every]
    with Progress(console=console, disable=args.json or not console.is_terminal) as progress:
        task = progress.add_task("scoring", total=len(pictures))
        judged = judge_frames(pictures, dataset.models, estimator_answers(model), lambda _: progress.advance(task))
    score = score_of(dataset, method_of(model), judged)
    if args.json:
        print(json.dumps(score, indent=2, allow_nan=False))
    else:
        table_console().print(score_table(score))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point. Exit codes: 0 done, 1 the replay failed, 2 bad input, 130 interrupted."""
    args = _parser().parse_args(argv)
    # Like Ctrl-C, so that the processes of a replay are stopped.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # ignored under nohup
        signal.signal(signal.SIGHUP, signal.default_int_handler)
    try:
        return _run(args)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise  # the reader of the output has closed it: not a failure, and `launch` exits as usual for that
    except PlayError as error:
        print(error, file=sys.stderr)
        return 1
    except OSError as error:
        # A write to a file that was opened before, as onto a full disk, does not tell its name.
        folder = (getattr(args, "out", None) or getattr(args, "flight", None)) if error.errno in _NO_ROOM else None
        place = error.filename2 or error.filename  # of a copy the second is the one that is written
        place = place or (folder and f"{folder}, or standard output")
        print(f"{place}: {error.strerror}" if place else error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
