"""`uavpose-replay golden`: play a few sequences in lock-step and compare the output with the accepted one."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.estimator.model import load_model
from msgs.command_line import say_out
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.golden.compare import Difference, Record, counts, differences, reduced
from sim_replay.ground_truth import read_sequence
from sim_replay.lockstep.player import LockstepSettings, Outputs, play_lockstep
from sim_replay.report.flight_files import remove_flight

FOLDER = Path(__file__).parent.parent / "data" / "golden"
SHOWN = 20  # differences of one sequence
EXIT_DIFFERS = 1


@dataclass(frozen=True)
class Case:
    """A sequence, and the number of its frames that are played."""

    folder: Path
    frames: int


CASES = {
    "crossing": Case(BUNDLED_SEQUENCE, 60),  # one target, tracked
    "away_and_back": Case(FOLDER / "away_and_back", 50),  # lost for longer than a track lasts, then re-acquired
    "two_targets": Case(FOLDER / "two_targets", 30),
    "unknown_range": Case(FOLDER / "unknown_range", 12),  # directions instead of poses
}


def golden_file(name: str) -> Path:
    """Path of a case's accepted output."""
    return FOLDER / f"{name}.jsonl"


def play_case(name: str, out: Path, model: Path) -> Outputs:
    """Play a case in lock-step; its outputs are also written to `out`, from which those of an earlier play are removed
    first. Raises InputError, PlayError."""
    case = CASES[name]
    settings = LockstepSettings(read_sequence(case.folder), model, stop=case.frames)
    remove_flight(out)
    outputs = play_lockstep(settings, lambda _: None, lambda *_: None)
    outputs.write(out)
    return outputs


def accept(name: str, outputs: Outputs, model: Path) -> None:
    """Make these outputs the new reference: a first line on their origin, then one per record."""
    head = {"case": name, "model_sha256": load_model(model, threads=1).sha256}
    lines = [json.dumps(line, ensure_ascii=False) for line in (head, *reduced(outputs))]
    golden_file(name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_golden(name: str) -> tuple[str, list[Record]]:
    """The model's hash and the accepted records. Raises InputError."""
    path = golden_file(name)
    try:
        head, *records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return str(head["model_sha256"]), records
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is not a golden file: {error!r}") from error


def compare(name: str, outputs: Outputs) -> list[Difference]:
    """Deviations from the accepted output. Raises InputError."""
    return differences(read_golden(name)[1], reduced(outputs))


def report(name: str, found: list[Difference]) -> str:
    """Readable: one line per difference, the first of them in time."""
    if not found:
        return f"{name}: no differences"
    lines = [f"{name}: {len(found)} differences", *(f"  {difference}" for difference in found[:SHOWN])]
    if len(found) > SHOWN:
        lines.append(f"  and {len(found) - SHOWN} more")
    return "\n".join(lines)


def register(commands: Any) -> None:
    """Add the command to what add_subparsers() returned; it sets `run`, a function of the parsed arguments."""
    parser = commands.add_parser(
        "golden",
        help="regression test: compare the daemon's outputs on a few sequences with the accepted ones, field by field",
        description="Play each case in lock-step through the real daemon and compare poses and MAVLink messages with "
        f"the golden files, within tolerances. Cases: {', '.join(CASES)}. Exit code 0 if there is no difference, "
        "1 if there is. --accept makes the output the new golden files.",
    )
    parser.add_argument("case", nargs="*", metavar="CASE", help="case to play (default: all)")
    parser.add_argument("--accept", action="store_true", help="write the output as the new golden files")
    parser.add_argument("--out", type=Path, default=Path("out") / "golden", metavar="DIR", help="output folder")
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare, or accept, the requested cases."""
    unknown = [name for name in args.case if name not in CASES]
    if unknown:
        raise InputError(f"golden {unknown[0]}: no such case; the cases are {', '.join(CASES)}")
    sha256 = load_model(args.model, threads=1).sha256
    differs = False
    for name in args.case or CASES:
        if not args.accept and read_golden(name)[0] != sha256:
            say_out(f"{name}: accepted with a different model ({read_golden(name)[0][:8]}…, now {sha256[:8]}…)")
        outputs = play_case(name, args.out / name, args.model)
        try:
            found = compare(name, outputs)
            say_out(report(name, found))
        except InputError as error:
            if not args.accept:
                raise
            found = []
            say_out(f"{error}; writing a new one")
        differs |= bool(found)
        if args.accept:
            accept(name, outputs, args.model)
            kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(counts(reduced(outputs)).items()))
            say_out(f"  accepted: {kinds}")
    return EXIT_DIFFERS if differs and not args.accept else 0
