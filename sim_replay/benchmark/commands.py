"""The benchmark's sub-commands of `uavpose-replay`. Extra dependencies (OpenGL, JSBSim) are imported on use."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from edge.errors import InputError

RENDER_PACKAGES = ("moderngl", "jsbsim", "av")


def register(commands: Any) -> None:
    """Add them to what argparse's add_subparsers() returned; each sets `run`, a function of the parsed arguments."""
    _generate(commands)
    _stats(commands)
    _bench(commands)
    _sheet(commands)


def _generate(commands: Any) -> None:
    parser = commands.add_parser(
        "generate",
        help="generate a BOP dataset from a preset and a seed",
        description="Fly (JSBSim), render and label every sequence of a preset. The same seed gives the same bytes on "
        "one machine; labels do not depend on the renderer. Ctrl-C stops after the frames in progress; --resume "
        "continues.",
    )
    parser.add_argument("--preset", required=True, metavar="NAME", help="fw-uav6d, unseen, stress, or a .toml file")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder of the dataset")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed, 0 or more (default %(default)s)")
    parser.add_argument(
        "--split", action="append", choices=("train", "val", "test"), help="only this split; may be repeated"
    )
    parser.add_argument("--sequences", metavar="LIST", help="only these sequences, for example 0-9,12")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth frame of a sequence")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--resume", action="store_true", help="continue the dataset in --out")
    parser.add_argument(
        "--labels-only", action="store_true", help="everything except images and masks: minutes, not hours"
    )
    parser.add_argument("--undistorted", action="store_true", help="the same dataset with distortion-free lenses")
    parser.add_argument(
        "--backdrops",
        type=Path,
        metavar="DIR",
        help="photographs that replace sky and ground in about half of the sequences",
    )
    parser.set_defaults(run=_run_generate)


def _run_generate(args: argparse.Namespace) -> int:
    with _extra_packages():
        from sim_replay.benchmark.generate import run

    return run(args)


@contextmanager
def _extra_packages() -> Iterator[None]:
    """Report a missing package of the render extra in a sentence. Raises InputError."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in RENDER_PACKAGES:
            raise
        raise InputError(
            f"the package {error.name} is missing; install the render extra: pip install '.[render]'"
        ) from error


def _stats(commands: Any) -> None:
    parser = commands.add_parser(
        "stats",
        help="print statistics of a BOP dataset, next to the paper's figures",
        description="Sequences, frames, ranges, box sizes, lenses, targets and airframes, measured from the files.",
    )
    parser.add_argument("--dataset", type=Path, required=True, metavar="DIR", help="BOP dataset, split or scene folder")
    parser.add_argument("--json", action="store_true", help="print the statistics as JSON")
    parser.set_defaults(run=_run_stats)


def _run_stats(args: argparse.Namespace) -> int:
    from sim_replay.benchmark.stats import run

    return run(args.dataset, args.json)


def _bench(commands: Any) -> None:
    parser = commands.add_parser(
        "bench",
        help="measure the rendering speed of this machine",
        description="Whole frames per second as generate writes them, and training windows per second, with all "
        "workers rendering at the same time.",
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, metavar="N", help="duration of each measurement (default 10)"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.set_defaults(run=_run_bench)


def _run_bench(args: argparse.Namespace) -> int:
    with _extra_packages():
        from sim_replay.benchmark.bench import run

    return run(args.seconds, args.workers, args.json)


def _sheet(commands: Any) -> None:
    parser = commands.add_parser(
        "sheet",
        help="draw a contact sheet of the airframes, or of a dataset's frames",
        description="Draw each airframe from the front, rear, side, top, below and two oblique sides; or, with "
        "--dataset, frames of a dataset with the target's box and an enlarged view around it.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JPEG to write")
    parser.add_argument("--airframe", nargs="+", metavar="NAME", help="airframes to draw (default: all)")
    parser.add_argument(
        "--livery-seed", type=int, default=0, metavar="N", help="seed of the livery (default %(default)s)"
    )
    parser.add_argument("--dataset", type=Path, metavar="DIR", help="show frames of this BOP dataset instead")
    parser.set_defaults(run=_run_sheet)


def _run_sheet(args: argparse.Namespace) -> int:
    if args.out.suffix.lower() not in (".jpg", ".jpeg"):
        raise InputError(f"--out {args.out}: a sheet is a JPEG; its name must end in .jpg")
    if args.dataset is not None and args.airframe:
        raise InputError("--airframe: not with --dataset, whose frames show what they show")
    if args.dataset is not None:
        from sim_replay.benchmark.contact_sheet import run as run_contact_sheet

        return run_contact_sheet(args.dataset, args.out)
    with _extra_packages():
        from sim_replay.sheet import run

    return run(args)
