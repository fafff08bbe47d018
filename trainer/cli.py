"""Train, evaluate and export the pose network."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path

from msgs.command_line import EXIT_BAD_INPUT, EXIT_INTERRUPTED, exit_code
from msgs.settings import read_text
from trainer import evaluate_command, results, score_command
from trainer.arguments import count, positive, share, whole
from trainer.config import REFINED_BY_DEFAULT, REFINED_HEADS, ConfigError, RenderingError, load_config, parse_config

EDGE_CONFIG = Path(__file__).parent / "configs" / "edge.toml"


def _train(arguments: argparse.Namespace) -> None:
    from trainer.train import run_training

    text = read_text(arguments.config, ConfigError)
    run_training(
        parse_config(text, str(arguments.config)),
        text,
        arguments.out,
        budget_s=None if arguments.budget_minutes is None else 60.0 * arguments.budget_minutes,
        resume=arguments.resume,
        samples=arguments.samples,
        start_from=arguments.start_from,
    )


def _export(arguments: argparse.Namespace) -> None:
    from trainer.comparison import Tolerance
    from trainer.export import export_models, export_unmeasured

    contract = load_config(arguments.config).contract if arguments.config else None
    if arguments.untrained is not None or arguments.unmeasured:
        source, untrained = arguments.untrained or arguments.checkpoint, arguments.untrained is not None
        path = export_unmeasured(source, arguments.out, untrained=untrained, contract=contract)
        print(f"wrote {path}, for timing only")
        return
    export_models(
        arguments.checkpoint,
        arguments.out,
        float_out=arguments.float_out,
        contract=contract,
        tolerance=Tolerance(
            arguments.tolerance,
            arguments.tolerance_depth,
            arguments.tolerance_pose,
            arguments.tolerance_sigma,
            arguments.tolerance_recall,
        ),
        samples=arguments.samples,
        say=lambda text: print(text, flush=True),
    )


def _ablate(arguments: argparse.Namespace) -> None:
    from trainer.ablate import Scale, ablate, chosen, table

    config = load_config(arguments.config)
    variants = chosen(arguments.variants.split(",") if arguments.variants else None)
    scale = Scale(arguments.samples, arguments.size, arguments.windows)
    # With --json, standard output is for the JSON alone, so the log of training goes to standard error.
    with contextlib.redirect_stdout(sys.stderr if arguments.json else sys.stdout):
        result = ablate(config, variants, scale, arguments.out, lambda text: print(text, flush=True))
    print(json.dumps(result, indent=2) if arguments.json else table(result))
    if any(variant.name not in result["rows"] for variant in variants):
        raise KeyboardInterrupt  # the exit code tells a script that rows are missing


def _average(arguments: argparse.Namespace) -> None:
    from trainer.average import average

    print(f"wrote {average(arguments.checkpoints, arguments.out)}")


def _refine(arguments: argparse.Namespace) -> None:
    from trainer.refine import refine
    from trainer.refine_plan import RefinePlan

    plan = RefinePlan(
        seed=arguments.seed,
        windows=arguments.windows,
        epochs=arguments.epochs,
        strangers=arguments.strangers,
        datasets=tuple(arguments.dataset),
        split=arguments.split,
        dataset_share=arguments.dataset_share,
        flown=tuple(arguments.flown),
        flown_share=arguments.flown_share,
        heads=tuple(arguments.heads),
        beside=arguments.beside,
    )
    path = refine(arguments.checkpoint, arguments.out, plan, say=lambda text: print(text, flush=True))
    print(f"wrote {path}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="uavpose-trainer", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser(
        "train",
        help="train a network on rendered windows, on datasets, or on both",
        description="Train a network on the windows that the configuration asks for, rendered or cropped from datasets."
        " Stops with a checkpoint when the planned number of samples or the time budget is reached, or on SIGTERM or "
        "Ctrl-C; --resume continues at the next step. It also stops when the gradient of the loss is not finite; the "
        "last checkpoint is then kept. The run folder contains weights.pt, resume.pt, config.toml, run.json (the "
        "settings of each start), log.jsonl, and TensorBoard scalars and images.",
    )
    train.add_argument("--config", type=Path, required=True, help="TOML, such as trainer/configs/edge.toml")
    train.add_argument("--out", type=Path, required=True, help="run folder")
    train.add_argument(
        "--budget-minutes",
        type=positive,
        help="wall-clock time for the run, or with --resume so much more time; the schedule is fitted into it "
        "(default: none, or what is left of the resumed run's)",
    )
    train.add_argument(
        "--samples",
        type=count,
        help="total number of training samples (default: the resumed run's, or the configuration's); with --resume, "
        "what is left of the time budget still applies, unless nothing is",
    )
    train.add_argument("--start-from", type=Path, metavar="WEIGHTS", help="initialise from another run's weights.pt")
    train.add_argument("--resume", action="store_true", help="continue from the run folder's checkpoint")
    train.set_defaults(run=_train)
    evaluate_command.register(commands)
    results.register(commands)
    _add_refine(commands)
    _add_ablate(commands)
    _add_export(commands)
    score_command.register(commands)
    _add_average(commands)
    return parser


def _add_refine(commands: argparse._SubParsersAction) -> None:
    refine = commands.add_parser(
        "refine",
        help="train the uncertainty, range correction, score and choice of rotation of a trained network",
        description="Run a trained network on windows and train only some heads on the outputs: the refinement head "
        "predicts a correction of the range, and sigma; the presence head whether a peak is a target, hence the score; "
        "the choice head which of the rotation hypotheses is likeliest. All other weights are unchanged. Writes "
        "weights.pt to --out.",
    )
    refine.add_argument("--checkpoint", type=Path, required=True, help="run folder or its weights.pt")
    refine.add_argument("--out", type=Path, required=True, help="output folder for the weights")
    refine.add_argument(
        "--seed", type=whole, required=True, help="seed of the windows; it must not have been used by any earlier run"
    )
    refine.add_argument(
        "--windows", type=count, default=100_000, help="number of windows, 14 KB of memory each (default %(default)s)"
    )
    refine.add_argument("--epochs", type=count, default=8, help="passes over the windows (default %(default)s)")
    refine.add_argument(
        "--strangers",
        type=share,
        default=0.35,
        help="share of rendered targets that are randomly generated aircraft not used in training (default "
        "%(default)s)",
    )
    refine.add_argument(
        "--dataset",
        type=Path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="BOP datasets with images on which no run was trained, to take windows from (default: all are rendered)",
    )
    refine.add_argument(
        "--split",
        help="split of each --dataset, such as val (default: all splits in the folder; if one of them is a test split, "
        "--split is required)",
    )
    refine.add_argument(
        "--dataset-share", type=share, default=0.5, help="share of windows from --dataset (default %(default)s)"
    )
    refine.add_argument(
        "--flown",
        type=Path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="datasets whose poses and cameras are rendered anew, as in [data] flown (default: as the network was "
        "trained)",
    )
    refine.add_argument(
        "--flown-share", type=share, default=0.5, help="share of such targets if --flown is given (default %(default)s)"
    )
    refine.add_argument(
        "--heads",
        nargs="+",
        choices=REFINED_HEADS,
        default=list(REFINED_BY_DEFAULT),
        metavar="HEAD",
        help="which to train, of %(choices)s (default: refinement presence); the others stay as they are",
    )
    refine.add_argument(
        "--beside",
        action="store_true",
        help="with --heads presence: keep the presence heads that there are, and train another one; the score is the "
        "mean of their log-odds",
    )
    refine.set_defaults(run=_refine)


def _add_average(commands: argparse._SubParsersAction) -> None:
    mean = commands.add_parser(
        "average",
        help="write the mean of several runs' weights",
        description="Write weights.pt with the mean of the weights of runs with a common origin, such as a run and its "
        "continuation with another [data] seed. The mean is often better than each of them; evaluate it to be sure. "
        "Refused are runs that began with different random weights, and runs that were refined separately: average "
        "first, then refine.",
    )
    mean.add_argument("checkpoints", type=Path, nargs="+", metavar="RUN", help="run folders or their weights.pt")
    mean.add_argument("--out", type=Path, required=True, help="output folder for the mean")
    mean.set_defaults(run=_average)


def _add_ablate(commands: argparse._SubParsersAction) -> None:
    ablate = commands.add_parser(
        "ablate",
        help="train variants of a network with one change at a time, and print a table",
        description="Train every variant for the same number of windows, evaluate all on the same held-out ones, and "
        "write table.md and ablation.json. Existing runs are kept, and an interrupted one is continued. Rows of other "
        "variants in --out stay in the table if they were measured on as many windows; another scale, seed or "
        "configuration is refused. Exception: a variant trained on whole reduced frames alone is evaluated on such "
        "frames.",
    )
    ablate.add_argument(
        "--config", type=Path, default=EDGE_CONFIG, help="base configuration (default: configs/edge.toml)"
    )
    ablate.add_argument("--out", type=Path, required=True, help="output folder for the runs and the table")
    ablate.add_argument("--variants", metavar="A,B", help="only these variants (default: all)")
    ablate.add_argument(
        "--samples", type=count, default=20000, help="training windows per variant (default %(default)s)"
    )
    ablate.add_argument(
        "--size", type=count, default=128, metavar="PX", help="side of the windows (default %(default)s)"
    )
    ablate.add_argument("--windows", type=count, default=512, help="held-out windows (default %(default)s)")
    ablate.add_argument("--json", action="store_true", help="print JSON instead of the table")
    ablate.set_defaults(run=_ablate)


def _add_export(commands: argparse._SubParsersAction) -> None:
    export = commands.add_parser(
        "export",
        help="export a checkpoint as FP32 and INT8 model files",
        description="Write NAME-fp32.onnx and NAME-int8.onnx, each with its contract and metrics evaluated on windows "
        "of a separate seed, and print the differences between INT8 and FP32 and between FP32 and PyTorch. With "
        "--unmeasured or --untrained: write only NAME-unmeasured-fp32.onnx, in seconds, for timing, not for flight.",
    )
    source = export.add_mutually_exclusive_group(required=True)
    source.add_argument("--checkpoint", type=Path, help="run folder or its weights.pt")
    source.add_argument(
        "--untrained", type=Path, metavar="CONFIG", help="the network of this TOML file, with random weights"
    )
    export.add_argument("--unmeasured", action="store_true", help="without rendering, evaluation and quantisation")
    export.add_argument("--out", type=Path, required=True, help="output folder for the INT8 file")
    export.add_argument("--float-out", type=Path, help="output folder for the FP32 file (default: --out)")
    export.add_argument(
        "--config", type=Path, help="take [contract] from this TOML file instead of from the checkpoint"
    )
    export.add_argument(
        "--samples",
        type=count,
        default=300,
        help="number of track windows for calibration and for comparison, with half as many acquire windows "
        "(default %(default)s)",
    )
    for option, unit, default, what in (
        ("--tolerance", "DEG", 2.0, "the median rotation difference from FP32 is larger, degrees"),
        ("--tolerance-depth", "PERCENT", 2.0, "the median depth difference from FP32 is larger, %%"),
        ("--tolerance-pose", "POINTS", 5.0, "Pose@10°/5 %% is lower than FP32's by more, percentage points"),
        ("--tolerance-sigma", "PERCENT", 10.0, "the median sigma is smaller than FP32's by more, %%"),
        ("--tolerance-recall", "POINTS", 5.0, "the recall is lower than FP32's by more, percentage points"),
    ):
        export.add_argument(
            option,
            type=positive,
            default=default,
            metavar=unit,
            help=f"write no INT8 file if {what} (default %(default)s)",
        )
    export.set_defaults(run=_export)


def main(argv: list[str] | None = None) -> int:
    """Exit codes: 0 done, 1 rendering or disk error, 2 bad input, 130 interrupted, 141 output pipe closed."""
    arguments = _parser().parse_args(argv)
    # OpenMP threads that spin while waiting slow down a busy machine severely. Read when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    return exit_code(lambda: _acted(arguments), ConfigError, ["trainer", "render"])


def _acted(arguments: argparse.Namespace) -> int:
    """Run the command; returns its exit code. Lets BrokenPipeError through."""
    try:
        arguments.run(arguments)
    except ConfigError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except RenderingError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise  # the output pipe was closed
    except OSError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("uavpose-trainer: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
