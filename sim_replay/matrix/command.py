"""The `matrix` sub-command of `uavpose-replay`."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.model import Model, load_model
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.evaluation.table import table_console
from sim_replay.faults.rig import can_mount
from sim_replay.faults.run import timeline_path
from sim_replay.faults.timeline import Timeline, load_timeline
from sim_replay.ground_truth import PlayedSequence, read_sequence
from sim_replay.matrix.cells import NO_FAULT, Cell, break_cell, fly_cell
from sim_replay.matrix.datasets import flyable

EXIT_WRONG = 1
SPEEDS = (0.25, 4.0)


def register(commands: Any) -> None:
    """Add it to what argparse's add_subparsers() returned."""
    parser = commands.add_parser(
        "matrix",
        help="play sequences at several speeds, with and without faults, and print one table",
        description="Play every combination of the given sequences, speeds and faults through the real daemon, one "
        "after the other. Without a fault a flight is scored against ground truth; with one it is judged by the "
        "criteria of `faults`. Writes matrix.json. Exit code 0 if every run passed, 1 if not.",
    )
    parser.add_argument(
        "--sequence", type=Path, action="append", default=[], metavar="DIR", help="scene folder; may be repeated"
    )
    parser.add_argument(
        "--dataset", type=Path, action="append", default=[], metavar="DIR",
        help="dataset written by `generate --preset`: its first test sequences are played; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--take", type=int, default=1, metavar="N", help="number of sequences of each dataset (default 1)"
    )
    parser.add_argument(
        "--fault", action="append", default=[], metavar="NAME",
        help=f"a timeline of `faults`, or {NO_FAULT}; may be repeated (default: {NO_FAULT})",
    )  # fmt: skip
    parser.add_argument(
        "--speed",
        type=float,
        action="append",
        default=[],
        metavar="X",
        help="speed relative to real time; may be repeated (default 1)",
    )
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")
    parser.add_argument("--out", type=Path, default=Path("out") / "matrix", metavar="DIR", help="output folder")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Raises InputError, PlayError."""
    speeds, faults = args.speed or [1.0], args.fault or [NO_FAULT]
    for speed in speeds:
        if not (math.isfinite(speed) and SPEEDS[0] <= speed <= SPEEDS[1]):
            raise InputError(f"--speed {speed:g}: must be {SPEEDS[0]:g} to {SPEEDS[1]:g}")
    timelines = {name: load_timeline(timeline_path(name)) for name in faults if name != NO_FAULT}
    model = load_model(args.model, threads=1)
    if args.take < 1:
        raise InputError(f"--take {args.take}: must be at least 1")
    given = args.sequence or ([] if args.dataset else [BUNDLED_SEQUENCE])
    named = [(folder, folder.name) for folder in given]
    named += [(f, f"{dataset.name}/{f.name}") for dataset in args.dataset for f in flyable(dataset, args.take)]
    sequences = [(read_sequence(folder), name) for folder, name in named]
    if NO_FAULT not in faults and all(sequence.scene.target_free for sequence, _ in sequences):
        raise InputError(
            f"--fault: no sequence shows a target, which is needed to judge faults; use --fault {NO_FAULT}"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    for name, timeline in timelines.items():
        if timeline.volume and not can_mount(args.out):
            raise InputError(f"--fault {name}: needs a host that lets a user mount (unshare --mount)")
    console = table_console(stderr=args.json)
    for sequence, name in sequences:
        if timelines and sequence.scene.target_free:
            console.print(
                f"{name}: shows no target, which is needed to judge faults: played without them",
                highlight=False,
                markup=False,
            )
    cells: list[Cell] = []
    _write(args.out, cells)  # discards those of an earlier run
    for cell in _cells(sequences, speeds, faults, timelines, model, args.out):
        cells.append(cell)
        _write(args.out, cells)  # after each cell, so that hours of flights are kept if the next one fails
        told = "; ".join(cell.wrong) or "passed"
        console.print(
            f"{cell.sequence}, speed {cell.speed:g}, fault {cell.fault}: {told}", highlight=False, markup=False
        )
    if args.json:
        print(json.dumps([asdict(cell) for cell in cells]))
    else:
        console.print(table(cells))
    return EXIT_WRONG if any(cell.wrong for cell in cells) else 0


def _write(out: Path, cells: Sequence[Cell]) -> None:
    text = json.dumps([asdict(cell) for cell in cells], indent=2)
    (out / "matrix.json").write_text(text + "\n", encoding="utf-8")


def _cells(
    sequences: Sequence[tuple[PlayedSequence, str]],
    speeds: Sequence[float],
    faults: Sequence[str],
    timelines: dict[str, Timeline],
    model: Model,
    out: Path,
) -> Iterator[Cell]:
    """Each combination of the sequences with their names, in its own folder; no faults without a target."""
    for number, (sequence, name) in enumerate(sequences):
        for speed in speeds:
            for fault in faults:
                if fault != NO_FAULT and sequence.scene.target_free:
                    continue
                folder = out / f"{number}-{sequence.scene.name}-x{speed:g}-{Path(fault).stem}"
                if fault == NO_FAULT:
                    cell = fly_cell(sequence, speed, model, folder)
                else:
                    cell = break_cell(sequence, speed, fault, timelines[fault], model.path, folder)
                yield replace(cell, sequence=name)


def table(cells: Sequence[Cell]) -> Table:
    """As a readable table."""
    shown = Table(title="matrix", title_justify="left")
    for name in ("sequence", "speed", "fault", ""):
        shown.add_column(name)
    for name in ("poses", "recall", "E_r median", "range bias", "age p50", "age max", "dropped"):
        shown.add_column(name, justify="right")
    for cell in cells:
        shown.add_row(
            escape(cell.sequence),
            f"{cell.speed:g}",
            escape(cell.fault),
            "[red]WRONG[/red]" if cell.wrong else "ok",
            str(cell.poses),
            _text(cell.found, "{:.1%}"),
            _text(cell.rotation_error_deg, "{:.1f}°"),
            _text(cell.range_error_rel, "{:+.1%}"),
            _text(cell.age_p50_ms, "{:.1f} ms"),
            _text(cell.age_max_ms, "{:.1f} ms"),
            _text(cell.dropped, "{:d}"),
        )
    return shown


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
