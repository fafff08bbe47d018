"""The `bench` sub-command of `uavpose-edge`: options and output."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import NoReturn

from edge.errors import InputError
from msgs.command_line import say_out

PIPELINE = "uavpose-replay"
THREADS, RUNS = "1,2", 50
THREADS_MAX = 64  # as in [model] threads


def register(commands: argparse._SubParsersAction) -> None:
    bench = commands.add_parser(
        "bench",
        help="measure inference speed on this machine, or with --pipeline the whole daemon",
        description="Time every given model by stage and number of threads, interleaved, and compare it with this "
        "machine's peak for matrix products. Ratios are of 10th percentiles: other load adds to a call's time and "
        "never subtracts. With --pipeline: run the daemon on a replayed sequence instead and check its budgets.",
    )
    bench.add_argument("models", type=Path, nargs="*", help="ONNX files (default: the shipped model)")
    bench.add_argument("--threads", metavar="N,N", help=f"CPU threads per inference (default {THREADS})")
    bench.add_argument("--runs", type=int, help=f"timed inferences per row (default {RUNS})")
    bench.add_argument("--spinning", action="store_true", help="let threads spin between inferences")
    bench.add_argument("--alone", action="store_true", help="only ONNX Runtime, without other installed engines")
    bench.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    bench.add_argument("--pipeline", action="store_true", help=f"run `{PIPELINE} bench-pipeline`")
    bench.add_argument("--sequence", type=Path, metavar="DIR", help="with --pipeline: scene folder to replay")
    bench.add_argument("--minutes", type=float, help="with --pipeline: duration")
    bench.add_argument("--fps", type=float, help="with --pipeline: frames per second (default: the sequence's rate)")
    bench.set_defaults(act=run)


def run(options: argparse.Namespace) -> int:
    """Returns 0; with --pipeline, the process becomes that command. Raises InputError."""
    if options.pipeline:
        _become_pipeline(options)
    for name in ("sequence", "minutes", "fps"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name} needs --pipeline")
    threads = _threads(THREADS if options.threads is None else options.threads)
    runs = RUNS if options.runs is None else options.runs
    if runs < 1:
        raise InputError(f"--runs {runs}: must be at least 1")
    from edge.bench.measure import measure
    from edge.bench.report import table, to_tree
    from edge.bench.timing import UNTIMED_ROUNDS
    from edge.config import SHIPPED_MODEL

    def on_round(done: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if done == runs + UNTIMED_ROUNDS else ""
            print(f"\rround {done} of {runs + UNTIMED_ROUNDS}", end=end, file=sys.stderr, flush=True)

    measured = measure(options.models or [SHIPPED_MODEL], threads, options.spinning, runs, not options.alone, on_round)
    say_out(json.dumps(to_tree(measured)) if options.json else table(measured))
    return 0


def _threads(text: str) -> list[int]:
    numbers = text.split(",")
    if not all(number.isdecimal() and 1 <= int(number) <= THREADS_MAX for number in numbers):
        raise InputError(f"--threads {text}: give integers from 1 to {THREADS_MAX}, such as 1,2")
    return sorted({int(number) for number in numbers})


def _become_pipeline(options: argparse.Namespace) -> NoReturn:
    """Replace this process by the replay harness, which the daemon's package does not import; signals then reach it,
    and it ends the programs that it started."""
    for name in ("threads", "runs", "spinning", "alone"):
        if getattr(options, name) not in (None, False):
            raise InputError(f"--{name} cannot be combined with --pipeline, which runs the daemon as configured")
    if len(options.models) > 1:
        raise InputError(f"--pipeline takes one model, not {len(options.models)}")
    command = Path(sys.executable).parent / PIPELINE
    if not command.exists():
        raise InputError(f"--pipeline needs {PIPELINE}, which is not installed beside {sys.executable}")
    arguments = ["bench-pipeline"]
    for name in ("sequence", "minutes", "fps"):
        if (value := getattr(options, name)) is not None:
            arguments += [f"--{name}", str(value)]
    if options.models:
        arguments += ["--model", str(options.models[0])]
    if options.json:
        arguments.append("--json")
    os.execv(command, [str(command), *arguments])
