"""The `bench-pipeline` and `soak` sub-commands of `uavpose-replay`."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.model import load_model
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.ground_truth import read_sequence
from sim_replay.pipeline.flight import SAMPLE_S, Flight, FlightSettings, fly
from sim_replay.pipeline.report import report, table
from sim_replay.pipeline.soak import SAMPLES_MIN, silences, trends
from sim_replay.pipeline.soak import table as trend_table

EXIT_DRIFTS = 1
FPS_MAX = 240.0


def register(commands: Any) -> None:
    """Add them to what argparse's add_subparsers() returned."""
    bench = commands.add_parser(
        "bench-pipeline",
        help="play a sequence in a loop through the daemon and compare latency, CPU and memory with the budgets",
        description="Start the daemon on a looped sequence with a simulated autopilot (MAVLink over UDP) and a zenoh "
        "subscriber, in real time, and print latency by stage, dropped frames, CPU and memory beside the budgets. "
        "Writes pipeline.json.",
    )
    _add_arguments(bench, 10.0, "pipeline")
    bench.set_defaults(run=run)
    soak = commands.add_parser(
        "soak",
        help="play a sequence in a loop for a long time, and fail if resource usage or age grows or the poses stop",
        description="Like bench-pipeline, but compare the beginning of the run, after a warm-up, with its end: memory, "
        "open descriptors, threads, log volume, dropped frames, age of the poses at the autopilot, and whether each "
        "peer receives poses. Writes soak.json. Exit code 0 if nothing has grown by more than allowed and poses "
        "arrived to the end, 1 if not.",
    )
    _add_arguments(soak, 60.0, "soak")
    soak.set_defaults(run=run_soak)


def _add_arguments(parser: argparse.ArgumentParser, minutes: float, out: str) -> None:
    parser.add_argument(
        "--sequence",
        type=Path,
        default=BUNDLED_SEQUENCE,
        metavar="DIR",
        help="scene folder (default: the bundled sequence)",
    )
    parser.add_argument("--minutes", type=float, default=minutes, help="duration (default %(default)g)")
    parser.add_argument("--fps", type=float, help="frames per second (default: the sequence's own rate)")
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")
    parser.add_argument("--out", type=Path, default=Path("out") / out, metavar="DIR", help="output folder")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def run(args: argparse.Namespace) -> int:
    """0 if it was measured, whatever the result. Raises InputError, PlayError."""
    path = args.out / "pipeline.json"
    result, _ = _measure(args, path)
    _write(path, result)
    print(json.dumps(result) if args.json else table(result))
    return 0


def run_soak(args: argparse.Namespace) -> int:
    """0 if nothing grows and poses arrived to the end, else EXIT_DRIFTS. Raises InputError, PlayError."""
    minutes_min = SAMPLES_MIN * SAMPLE_S / 60.0
    if args.minutes < minutes_min:
        raise InputError(f"--minutes {args.minutes:g}: must be at least {minutes_min:g} to show a trend")
    path = args.out / "soak.json"
    result, flight = _measure(args, path)
    found = trends(flight, result["fps"])
    silent = silences(flight)
    result = {**result, "trends": [asdict(trend) for trend in found], "silences": silent}
    _write(path, result)
    print(json.dumps(result) if args.json else "\n".join([trend_table(found, args.minutes), *silent]))
    return EXIT_DRIFTS if silent or any(trend.grows for trend in found) else 0


def _measure(args: argparse.Namespace, path: Path) -> tuple[dict[str, Any], Flight]:
    """Fly; returns the report, which is for `path`, and the flight."""
    if not 0.0 < args.minutes <= 24 * 60:
        raise InputError(f"--minutes {args.minutes:g}: must be above 0 and at most 1440, a day")
    model = load_model(args.model, threads=1)
    sequence = read_sequence(args.sequence)
    fps = sequence.fps if args.fps is None else args.fps
    if not 1.0 <= fps <= FPS_MAX:
        raise InputError(f"--fps {fps:g}: must be from 1 to {FPS_MAX:g}")
    if sequence.gimbal is not None and fps != sequence.fps:
        raise InputError(
            f"--fps {fps:g}: {args.sequence} was filmed from a gimbal, whose motion has the sequence's own rate"
        )
    settings = FlightSettings(sequence, args.out, args.minutes, args.model, fps)
    path.unlink(missing_ok=True)  # of an earlier run: this one may end without
    load_before = os.getloadavg()[0]
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("playing", total=1.0)
        flight = fly(settings, lambda done: progress.update(task, completed=done))
    result = {
        "sequence": settings.sequence.scene.name,
        "model": {"file": str(model.path), "sha256": model.sha256, "precision": model.contract.precision},
        "cores": os.cpu_count(),
        "load_average": [load_before, os.getloadavg()[0]],
        **report(flight, settings.fps, settings.period_s, args.minutes),
    }
    return result, flight


def _write(path: Path, result: dict[str, Any]) -> None:
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
