"""`uavpose-trainer evaluate`: the command line of evaluation on a BOP dataset and on rendered windows."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from trainer.arguments import whole

DEFAULT_OUT = Path("out") / "evaluate"
WINDOWS_SEED = 930001


def register(commands: argparse._SubParsersAction) -> None:
    """Add the sub-command."""
    evaluate = commands.add_parser(
        "evaluate",
        help="score a model, a checkpoint or another method's results with the paper's metrics",
        description="Score a model on every picture of a BOP dataset through the daemon's own estimator, or another "
        "method's results file, and write metrics.json, frames.jsonl, a model's BOP results file and figures. A target "
        "that was not found counts as a failure in every rate; mean and median errors are over found targets. With "
        "--windows, measure the network alone on rendered windows that training never saw.",
    )
    source = evaluate.add_mutually_exclusive_group()
    source.add_argument(
        "--model",
        "--onnx",
        "--checkpoint",
        dest="model",
        type=Path,
        metavar="PATH",
        help="ONNX file, or a checkpoint (run folder or weights.pt), which is exported to FP32 first; "
        "default: the shipped INT8 file",
    )
    source.add_argument(
        "--results", type=Path, metavar="CSV", help="METHOD_DATASET-SPLIT.csv in BOP's results format, any method's"
    )
    evaluate.add_argument(
        "--dataset", type=Path, metavar="DIR", help="BOP dataset, split or scene; default: the bundled scene 'crossing'"
    )
    evaluate.add_argument("--split", metavar="NAME", help="folder of the dataset to take (default: all there are)")
    evaluate.add_argument("--every", type=int, default=1, metavar="N", help="score every N-th picture (default: all)")
    evaluate.add_argument(
        "--mode",
        choices=("frames", "track"),
        default="frames",
        help="frames: each picture by itself; track: whole sequences through the daemon's tracker, which is told the "
        "camera's attitude where the scene has it (default %(default)s)",
    )
    evaluate.add_argument(
        "--own-ship",
        choices=("exact", "usual"),
        help="track: tell it the camera's attitude and place as they are, or off by what an autopilot usually is, "
        "drawn by the scene's name (default usual)",
    )
    evaluate.add_argument(
        "--score-min",
        type=float,
        metavar="P",
        help="what whole frame and windows together make a target of less probably is none (default: what the ONNX "
        "file says; a checkpoint: 0.3)",
    )
    evaluate.add_argument(
        "--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="folder to write to (default %(default)s)"
    )
    windows = evaluate.add_argument_group("rendered windows instead of a dataset")
    windows.add_argument("--windows", type=int, metavar="N", help="measure on N windows; a seed gives the same ones")
    windows.add_argument("--seed", type=whole, default=WINDOWS_SEED, help="seed of the windows (default %(default)s)")
    windows.add_argument("--stage", choices=("track", "acquire"), default="track", help="windows as it sees them")
    windows.add_argument("--size", type=int, metavar="PX", help="side of the windows; default: the model's")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")
    evaluate.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluate as asked. Raises ConfigError, RenderingError."""
    if arguments.windows is not None:
        _on_windows(arguments)
    else:
        _on_dataset(arguments)


def _on_dataset(arguments: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from sim_replay.evaluation.table import score_table, table_console
    from trainer.config import ConfigError, refuse_no_folder
    from trainer.evaluate_dataset import DatasetRequest, OwnShipTold, evaluate_dataset

    asked = arguments
    for name, unasked in {"seed": WINDOWS_SEED, "stage": "track", "size": None}.items():
        if getattr(asked, name) != unasked:
            raise ConfigError(f"--{name}: is of rendered windows; say how many with --windows")
    if asked.own_ship is not None and asked.mode != "track":
        raise ConfigError("--own-ship: is of --mode track; single frames are told none")
    refuse_no_folder(asked.out)
    own_ship: OwnShipTold = asked.own_ship or "usual"
    request = DatasetRequest(
        asked.model, asked.results, asked.dataset, asked.split, asked.every, asked.mode, own_ship, asked.score_min
    )
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("evaluating", total=None)
        evaluation = evaluate_dataset(
            request,
            on_start=lambda total: progress.update(task, total=total),
            on_frame=lambda _: progress.advance(task),
        )
        progress.update(task, description="drawing figures", total=None)
        files = evaluation.write(arguments.out)
    if arguments.json:
        print(json.dumps(evaluation.score, indent=2, allow_nan=False))
    else:
        table_console().print(score_table(evaluation.score))
    names = [path.name for path in files if not path.name.startswith("sequence_")]
    drawn = f"{len(files) - len(names)} sequence_*.png"
    errors.print(f"written to {arguments.out}: {', '.join([*names, drawn])}", highlight=False, soft_wrap=True)


def _on_windows(arguments: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from sim_replay.offline import SHIPPED_MODEL
    from trainer.config import ConfigError, made_folder
    from trainer.evaluate import null_where_unknown
    from trainer.held_out import Request, evaluate_file

    alone = {"results": None, "dataset": None, "split": None, "every": 1, "mode": "frames", "own_ship": None}
    for name, unasked in alone.items():
        if getattr(arguments, name) != unasked:
            raise ConfigError(
                f"--{name.replace('_', '-')}: is of a dataset, --windows of rendered pictures; give one of them"
            )
    if arguments.score_min is not None:
        raise ConfigError("--score-min: --windows measures at what the file says")
    model = arguments.model or SHIPPED_MODEL
    request = Request(model, arguments.windows, arguments.seed, arguments.stage, arguments.size)
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("rendering", total=arguments.windows)
        measured = evaluate_file(request, rendered=lambda count: progress.update(task, completed=count))
    score = null_where_unknown(measured)
    made_folder(arguments.out)
    (arguments.out / "windows.json").write_text(json.dumps(score, indent=2) + "\n", encoding="utf-8")
    if arguments.json:
        print(json.dumps(score, indent=2))
        return
    for name, value in measured.items():
        print(f"{name:22} {value:.4g}")
