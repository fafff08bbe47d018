"""The `bench` sub-command of `uavpose-edge`: what a person gives, what is printed."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from edge.errors import InputError

PIPELINE = "uavpose-replay"
THREADS, RUNS = "1,2", 50
THREADS_MAX = 64  # as [model] threads has it


def register(commands: argparse._SubParsersAction) -> None:
    bench = commands.add_parser(
        "bench",
        help="time inference on this machine, or with --pipeline the whole daemon",
        description="Time every given model by stage and number of threads, in turns, beside what this machine "
        "multiplies at most. Ratios are of 10th percentiles: a busy machine adds to a call's time and never takes "
        "from it. With --pipeline: fly a replayed sequence through the daemon instead and hold it to its budgets.",
    )
    bench.add_argument("models", type=Path, nargs="*", help="ONNX files; default: the model that ships")
    bench.add_argument("--threads", metavar="N,N", help=f"CPU threads of one inference (default {THREADS})")
    bench.add_argument("--runs", type=int, help=f"timed inferences of each row (default {RUNS})")
    bench.add_argument("--spinning", action="store_true", help="let threads spin between inferences")
    bench.add_argument("--alone", action="store_true", help="ONNX Runtime alone, without the other engines installed")
    bench.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    bench.add_argument("--pipeline", action="store_true", help=f"run `{PIPELINE} bench-pipeline`")
    bench.add_argument("--sequence", type=Path, metavar="DIR", help="with --pipeline: scene folder that is replayed")
    bench.add_argument("--minutes", type=float, help="with --pipeline: how long")
    bench.add_argument("--fps", type=float, help="with --pipeline: pictures a second (default: the sequence's rate)")
    bench.set_defaults(act=run)


def run(options: argparse.Namespace) -> int:
    """0, or what the pipeline's command returns. Raises InputError."""
    if options.pipeline:
        return _pipeline(options)
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
    print(json.dumps(to_tree(measured)) if options.json else table(measured))
    return 0


def _threads(text: str) -> list[int]:
    numbers = text.split(",")
    if not all(number.isdecimal() and 1 <= int(number) <= THREADS_MAX for number in numbers):
        raise InputError(f"--threads {text}: give whole numbers from 1 to {THREADS_MAX}, such as 1,2")
    return sorted({int(number) for number in numbers})


def _pipeline(options: argparse.Namespace) -> int:
    """The replay harness is a program of its own, beside this one; the daemon's package does not import it."""
    for name in ("threads", "runs", "spinning", "alone"):
        if getattr(options, name) not in (None, False):
            raise InputError(f"--{name} does not go with --pipeline, which flies the daemon as it is")
    if len(options.models) > 1:
        raise InputError(f"--pipeline flies one model, not {len(options.models)}")
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
    return subprocess.run([str(command), *arguments], check=False).returncode
