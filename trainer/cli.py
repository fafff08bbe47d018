"""`uavpose-trainer`: train, evaluate and export the pose network."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path

from msgs.command_line import EXIT_BAD_INPUT, EXIT_INTERRUPTED, exit_code
from trainer import evaluate_command, results, score_command
from trainer.arguments import count, positive, share, whole
from trainer.config import ConfigError, RenderingError, load_config

EDGE_CONFIG = Path(__file__).parent / "configs" / "edge.toml"


def _train(arguments: argparse.Namespace) -> None:
    from trainer.train import run_training

    config = load_config(arguments.config)
    run_training(
        config,
        arguments.config.read_text(encoding="utf-8"),
        arguments.out,
        budget_s=None if arguments.budget_minutes is None else 60.0 * arguments.budget_minutes,
        resume=arguments.resume,
        samples=arguments.samples,
        start_from=arguments.start_from,
    )


def _export(arguments: argparse.Namespace) -> None:
    from trainer.export import Tolerance, export_models, export_unmeasured

    contract = load_config(arguments.config).contract if arguments.config else None
    if arguments.untrained is not None or arguments.unmeasured:
        source, untrained = arguments.untrained or arguments.checkpoint, arguments.untrained is not None
        path = export_unmeasured(source, arguments.out, untrained=untrained, contract=contract)
        print(f"wrote {path}, for timing alone")
        return
    export_models(
        arguments.checkpoint,
        arguments.out,
        float_out=arguments.float_out,
        contract=contract,
        tolerance=Tolerance(
            arguments.tolerance, arguments.tolerance_depth, arguments.tolerance_pose, arguments.tolerance_sigma
        ),
        samples=arguments.samples,
        say=lambda text: print(text, flush=True),
    )


def _ablate(arguments: argparse.Namespace) -> None:
    from trainer.ablate import Scale, ablate, chosen, table

    config = load_config(arguments.config)
    variants = chosen(arguments.variants.split(",") if arguments.variants else None)
    scale = Scale(arguments.samples, arguments.size, arguments.windows)
    # What training tells on its way is for a person, and standard output for whoever reads JSON.
    with contextlib.redirect_stdout(sys.stderr if arguments.json else sys.stdout):
        result = ablate(config, variants, scale, arguments.out, lambda text: print(text, flush=True))
    print(json.dumps(result, indent=2) if arguments.json else table(result))


def _average(arguments: argparse.Namespace) -> None:
    from trainer.average import average

    print(f"wrote {average(arguments.checkpoints, arguments.out)}")


def _refine(arguments: argparse.Namespace) -> None:
    from trainer.refine import RefinePlan, refine

    plan = RefinePlan(arguments.seed, arguments.windows, arguments.epochs, arguments.strangers)
    path = refine(arguments.checkpoint, arguments.out, plan, say=lambda text: print(text, flush=True))
    print(f"wrote {path}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="uavpose-trainer", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    train = commands.add_parser(
        "train",
        help="train a network on rendered windows",
        description="Train a network on rendered windows. Stops with a checkpoint when the planned samples are done, "
        "the budget is used up, or on SIGTERM or Ctrl-C; --resume goes on at the next step. Where the loss has no "
        "finite gradient it stops too, and the last checkpoint stays. The run folder holds weights.pt, "
        "resume.pt, config.toml, run.json (how each start was asked for), log.jsonl and TensorBoard "
        "scalars and pictures.",
    )
    train.add_argument("--config", type=Path, required=True, help="TOML, such as trainer/configs/edge.toml")
    train.add_argument("--out", type=Path, required=True, help="run folder")
    train.add_argument(
        "--budget-minutes", type=positive, help="wall-clock limit of this start; fits the schedule into it"
    )
    train.add_argument(
        "--samples", type=count, help="planned samples in all; default: the resumed run's, or the configuration's"
    )
    train.add_argument("--start-from", type=Path, metavar="WEIGHTS", help="begin with another run's weights.pt")
    train.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
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
        help="teach a trained network how sure it is, and what to correct",
        description="Show a trained network rendered windows, and teach its refinement head alone by its answers: "
        "a correction of the range, and sigma. All else stays as it is. Writes weights.pt into --out.",
    )
    refine.add_argument("--checkpoint", type=Path, required=True, help="run folder or its weights.pt")
    refine.add_argument("--out", type=Path, required=True, help="folder for the weights")
    refine.add_argument("--seed", type=whole, required=True, help="of the windows: one that no run before had")
    refine.add_argument(
        "--windows", type=count, default=100_000, help="how many to look at, 14 KB of memory each (default %(default)s)"
    )
    refine.add_argument("--epochs", type=count, default=8, help="how often to learn from each (default %(default)s)")
    refine.add_argument(
        "--strangers",
        type=share,
        default=0.35,
        help="share of targets that are invented aircraft, of some that no training draws (default %(default)s)",
    )
    refine.set_defaults(run=_refine)


def _add_average(commands: argparse._SubParsersAction) -> None:
    mean = commands.add_parser(
        "average",
        help="write the mean of several runs' weights",
        description="Write weights.pt with the mean of the weights of runs that began alike, such as a run and the one "
        "that went on from it. Often it is better than each; evaluate it to know.",
    )
    mean.add_argument("checkpoints", type=Path, nargs="+", metavar="RUN", help="run folders or their weights.pt")
    mean.add_argument("--out", type=Path, required=True, help="folder for the mean")
    mean.set_defaults(run=_average)


def _add_ablate(commands: argparse._SubParsersAction) -> None:
    ablate = commands.add_parser(
        "ablate",
        help="train the same network with one thing left out at a time, and print the table",
        description="Train every variant for the same number of windows, measure all on the same held-out ones, and "
        "write table.md and ablation.json. Runs that are there already are kept, and an interrupted one goes on.",
    )
    ablate.add_argument("--config", type=Path, default=EDGE_CONFIG, help="what is varied (default: configs/edge.toml)")
    ablate.add_argument("--out", type=Path, required=True, help="folder of the runs and the table")
    ablate.add_argument("--variants", metavar="A,B", help="only these (default: all)")
    ablate.add_argument("--samples", type=count, default=20000, help="training windows a variant (default %(default)s)")
    ablate.add_argument("--size", type=count, default=128, metavar="PX", help="side of a window (default %(default)s)")
    ablate.add_argument("--windows", type=count, default=512, help="held-out windows (default %(default)s)")
    ablate.add_argument("--json", action="store_true", help="print JSON instead of the table")
    ablate.set_defaults(run=_ablate)


def _add_export(commands: argparse._SubParsersAction) -> None:
    export = commands.add_parser(
        "export",
        help="write a checkpoint as FP32 and INT8 model files",
        description="Write NAME-fp32.onnx and NAME-int8.onnx, each with its contract and metrics measured on windows "
        "of a seed of their own, and print how far INT8 is from FP32 and FP32 from PyTorch. With --unmeasured or "
        "--untrained: write NAME-unmeasured-fp32.onnx alone, in seconds, to be timed and not flown.",
    )
    source = export.add_mutually_exclusive_group(required=True)
    source.add_argument("--checkpoint", type=Path, help="run folder or its weights.pt")
    source.add_argument("--untrained", type=Path, metavar="CONFIG", help="the network of this TOML, random weights")
    export.add_argument("--unmeasured", action="store_true", help="render, measure and quantise nothing")
    export.add_argument("--out", type=Path, required=True, help="folder for the INT8 file")
    export.add_argument("--float-out", type=Path, help="folder for the FP32 file; default: --out")
    export.add_argument("--config", type=Path, help="take [contract] from this TOML, not from the checkpoint")
    export.add_argument(
        "--samples",
        type=count,
        default=300,
        help="track windows to calibrate and to compare on, and half as many acquire windows (default %(default)s)",
    )
    for option, unit, default, what in (
        ("--tolerance", "DEG", 2.0, "median rotation differs from FP32's by more degrees"),
        ("--tolerance-depth", "PERCENT", 2.0, "median depth differs from FP32's by more"),
        ("--tolerance-pose", "POINTS", 5.0, "Pose@10°/5 %% is worse than FP32's by more"),
        ("--tolerance-sigma", "PERCENT", 10.0, "median sigma is smaller than FP32's by more"),
    ):
        export.add_argument(
            option, type=positive, default=default, metavar=unit, help=f"no INT8 file if {what} (default %(default)s)"
        )
    export.set_defaults(run=_export)


def main(argv: list[str] | None = None) -> int:
    """Exit codes: 0 done, 1 rendering or a disk failed, 2 bad input, told so, 130 interrupted, 141 unread."""
    arguments = _parser().parse_args(argv)
    # OpenMP threads that spin while they wait cost a busy machine most of its speed. Read when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    return exit_code(lambda: _acted(arguments), ConfigError, ["trainer", "render"])


def _acted(arguments: argparse.Namespace) -> int:
    """The exit code, where standard output is read."""
    try:
        arguments.run(arguments)
    except ConfigError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except RenderingError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise  # who read the output has had enough
    except OSError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("uavpose-trainer: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
