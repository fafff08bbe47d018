"""`uavpose-trainer`: train, evaluate and export the pose network."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from trainer.config import ConfigError, load_config


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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="uavpose-trainer", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    train = commands.add_parser(
        "train",
        help="train a network on rendered windows",
        description="Train a network on rendered windows. Stops with a checkpoint when the planned samples are done, "
        "the budget is used up, or on SIGTERM or Ctrl-C; --resume goes on at the next step. The run folder holds "
        "weights.pt, resume.pt, config.toml, run.json, log.jsonl and TensorBoard scalars.",
    )
    train.add_argument("--config", type=Path, required=True, help="TOML, such as trainer/configs/edge.toml")
    train.add_argument("--out", type=Path, required=True, help="run folder")
    train.add_argument("--budget-minutes", type=float, help="wall-clock limit of this start; fits the schedule into it")
    train.add_argument("--samples", type=int, help="planned samples in all, instead of the configuration's")
    train.add_argument("--start-from", type=Path, metavar="WEIGHTS", help="begin with another run's weights.pt")
    train.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    train.set_defaults(run=_train)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Entry point; 2 when something that a person gave must be corrected."""
    arguments = _parser().parse_args(argv)
    # OpenMP threads that spin while they wait cost a busy machine most of its speed. Read when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        arguments.run(arguments)
    except ConfigError as error:
        print(f"uavpose-trainer: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
