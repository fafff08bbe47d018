"""The `bench-pipeline` sub-command of `uavpose-replay`."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.model import load_model
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.ground_truth import read_sequence
from sim_replay.pipeline.flight import FlightSettings, fly
from sim_replay.pipeline.report import report, table


def register(commands: Any) -> None:
    """Add it to what argparse's add_subparsers() gave."""
    parser = commands.add_parser(
        "bench-pipeline",
        help="fly a sequence round and round through the daemon and hold it to its budgets",
        description="Start the daemon on a looped sequence with a simulated autopilot (MAVLink over UDP) and a zenoh "
        "subscriber, in real time, and print latency by stage, drops, CPU and memory beside the budgets.",
    )
    parser.add_argument("--sequence", type=Path, default=BUNDLED_SEQUENCE, metavar="DIR", help="scene folder")
    parser.add_argument("--minutes", type=float, default=2.0, help="how long (default %(default)s)")
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")
    parser.add_argument("--out", type=Path, default=Path("out/pipeline"), metavar="DIR", help="folder to write to")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """0 when it was measured, whatever came out. Raises InputError, PlayError."""
    if not 0.0 < args.minutes <= 24 * 60:
        raise InputError(f"--minutes {args.minutes:g}: must be above 0 and at most a day")
    model = load_model(args.model, threads=1)
    settings = FlightSettings(read_sequence(args.sequence), args.out, args.minutes, args.model)
    load_before = os.getloadavg()[0]
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("flying", total=1.0)
        flight = fly(settings, lambda done: progress.update(task, completed=done))
    result = {
        "sequence": settings.sequence.scene.name,
        "model": {"file": str(model.path), "sha256": model.sha256, "precision": model.contract.precision},
        "cores": os.cpu_count(),
        "load_average": [load_before, os.getloadavg()[0]],
        **report(flight, settings.sequence.fps, settings.period_s, args.minutes),
    }
    (args.out / "pipeline.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result) if args.json else table(result))
    return 0
