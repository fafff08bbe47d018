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
        help="compute the paper's metrics for a model, a checkpoint or another method's results",
        description="Evaluate a model on every image of a BOP dataset through the daemon's own estimator, or another "
        "method's results file, and write metrics.json, frames.jsonl, a BOP results file (of a model) and figures. A "
        "missed target counts as a failure in every rate; mean and median errors are over detected targets. With "
        "--windows, evaluate the network alone on rendered windows that were not used in training.",
    )
    source = evaluate.add_mutually_exclusive_group()
    source.add_argument(
        "--model",
        "--onnx",
        "--checkpoint",
        dest="model",
        type=Path,
        metavar="PATH",
        help="ONNX file, or a checkpoint (run folder or weights.pt), which is first exported to FP32; "
        "default: the shipped INT8 file",
    )
    source.add_argument(
        "--results", type=Path, metavar="CSV", help="METHOD_DATASET-SPLIT.csv in BOP's results format, from any method"
    )
    evaluate.add_argument(
        "--dataset", type=Path, metavar="DIR", help="BOP dataset, split or scene; default: the bundled scene 'crossing'"
    )
    evaluate.add_argument("--split", metavar="NAME", help="split of the dataset (default: all)")
    evaluate.add_argument("--every", type=int, default=1, metavar="N", help="evaluate every N-th image (default: all)")
    evaluate.add_argument(
        "--mode",
        choices=("frames", "track"),
        default="frames",
        help="frames: every image on its own; track: whole sequences through the daemon's tracker, with the camera's "
        "attitude and position if the scene contains them (default %(default)s)",
    )
    evaluate.add_argument(
        "--own-ship",
        choices=("exact", "usual"),
        help="with --mode track: the own-ship pose given to the tracker, exact or with errors typical of autopilots, "
        "seeded by the scene's name (default usual)",
    )
    evaluate.add_argument(
        "--score-min",
        type=float,
        metavar="P",
        help="score threshold of both stages, 0 to 1; at acquisition it applies to the combined score of whole frame "
        "and windows (default: those of the ONNX file; 0.3 for a checkpoint)",
    )
    evaluate.add_argument(
        "--size-given",
        action="store_true",
        help="give the estimator the wingspan and length of each scene's aircraft from the dataset's models, as "
        "[target] does in flight; scenes with several types are evaluated without",
    )
    evaluate.add_argument(
        "--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="output folder (default %(default)s)"
    )
    windows = evaluate.add_argument_group("rendered windows instead of a dataset")
    windows.add_argument("--windows", type=int, metavar="N", help="evaluate on N windows, which the seed determines")
    windows.add_argument("--seed", type=whole, default=WINDOWS_SEED, help="seed of the windows (default %(default)s)")
    windows.add_argument(
        "--stage",
        choices=("track", "acquire"),
        default="track",
        help="stage whose kind of windows is used (default %(default)s)",
    )
    windows.add_argument("--size", type=int, metavar="PX", help="side of the windows (default: the model's)")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")
    evaluate.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluate as requested. Raises ConfigError, RenderingError."""
    if arguments.windows is not None:
        _on_windows(arguments)
    else:
        _on_dataset(arguments)


def _on_dataset(arguments: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from sim_replay.evaluation.axes import told_of_axes
    from sim_replay.evaluation.table import score_table, table_console
    from trainer.config import ConfigError, refuse_no_folder
    from trainer.evaluate_dataset import DatasetRequest, OwnShipTold, evaluate_dataset

    asked = arguments
    for name, unasked in {"seed": WINDOWS_SEED, "stage": "track", "size": None}.items():
        if getattr(asked, name) != unasked:
            raise ConfigError(f"--{name}: applies to rendered windows only; give their number with --windows")
    if asked.own_ship is not None and asked.mode != "track":
        raise ConfigError("--own-ship: applies to --mode track only")
    refuse_no_folder(asked.out)
    own_ship: OwnShipTold = asked.own_ship or "usual"
    request = DatasetRequest(
        asked.model,
        asked.results,
        asked.dataset,
        asked.split,
        asked.every,
        asked.mode,
        own_ship,
        asked.score_min,
        asked.size_given,
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
    for told in told_of_axes(evaluation.judged):
        errors.print(told, markup=False, highlight=False, soft_wrap=True)
    names = [path.name for path in files if not path.name.startswith("sequence_")]
    drawn = f"{len(files) - len(names)} sequence_*.png"
    written = f"written to {arguments.out}: {', '.join([*names, drawn])}"
    errors.print(written, markup=False, highlight=False, soft_wrap=True)


def _on_windows(arguments: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from sim_replay.offline import SHIPPED_MODEL
    from trainer.config import ConfigError, made_folder, refuse_no_folder
    from trainer.evaluate import null_where_unknown
    from trainer.held_out import Request, evaluate_file

    alone = {"results": None, "dataset": None, "split": None, "every": 1, "mode": "frames", "own_ship": None}
    alone |= {"size_given": False}
    for name, unasked in alone.items():
        if getattr(arguments, name) != unasked:
            raise ConfigError(
                f"--{name.replace('_', '-')}: applies to datasets, --windows to rendered images; give only one of them"
            )
    if arguments.score_min is not None:
        raise ConfigError("--score-min: cannot be combined with --windows, which uses the thresholds of the file")
    refuse_no_folder(arguments.out)
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
