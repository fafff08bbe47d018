"""`uavpose-replay generate`: generates a BOP dataset from a preset and a seed."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
from rich.console import Console

from edge.errors import InputError
from sim_replay.airframes import airframe_id, airframe_of
from sim_replay.benchmark.crew import CrewError, available_cores, crew
from sim_replay.benchmark.lenses import lenses_of
from sim_replay.benchmark.manifest import Recipe, claim, digests, write_manifest
from sim_replay.benchmark.plan import SequencePlan, plan_dataset
from sim_replay.benchmark.preset import Preset, parse_preset, preset_text
from sim_replay.benchmark.progress import Report, flights_bar
from sim_replay.benchmark.sequence_files import FrameNews, Job, make_sequence
from sim_replay.bop import write_models
from sim_replay.lock import alone_in


def run(args: argparse.Namespace) -> int:
    """Generate the dataset. Exit codes: 0 done, 1 a worker failed. Raises InputError."""
    place, text = preset_text(args.preset)
    preset = parse_preset(place, text)
    plans = _plans(preset, args)
    chosen = _chosen(plans, args.split, args.sequences)
    backdrops = _backdrops(args.backdrops)
    recipe = Recipe(preset.name, args.seed, args.every, args.labels_only, args.undistorted, digests(backdrops))
    workers = available_cores() if args.workers is None else args.workers
    if workers < 1:
        raise InputError("--workers: must be at least 1")
    with alone_in(args.out, "generate"):
        claim(args.out, recipe, text, args.resume)
        job = Job(preset, args.out, _command(args), {}, args.every, args.labels_only, args.undistorted, backdrops)
        try:
            _generate(job, recipe, plans, chosen, workers)
        except CrewError as error:
            print(f"{args.out}: {error}; --resume goes on from here", file=sys.stderr)
            return 1
        except BrokenPipeError:
            raise
        except OSError as error:
            print(f"{args.out}: {error}; --resume goes on from here", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            print(f"stopped; --resume goes on with {args.out}", file=sys.stderr)
            raise
    return 0


def _generate(
    job: Job, recipe: Recipe, plans: Sequence[SequencePlan], chosen: Sequence[SequencePlan], workers: int
) -> None:
    write_manifest(job, recipe, plans)
    names = {airframe_id(name) + 1: name for name in job.preset.airframe_names()}
    write_models(job.out / "models", {number: airframe_of(number - 1).mesh() for number in names}, names)
    try:
        _make(job, plans, chosen, workers)
    finally:
        write_manifest(job, recipe, plans)


def _make(job: Job, plans: Sequence[SequencePlan], chosen: Sequence[SequencePlan], workers: int) -> None:
    console = Console(stderr=True)
    with flights_bar(console, len(plans)) as on_flown:
        job = replace(job, focal_px=lenses_of(job.out, job.preset, plans, workers, on_flown))
    with Report(console, job, chosen) as report:
        for said in crew(partial(make_sequence, job), chosen, workers):
            if isinstance(said.value, FrameNews):
                report.frames(said.value)
            elif said.kind == "done":
                report.finished(chosen[said.task])


def _plans(preset: Preset, args: argparse.Namespace) -> tuple[SequencePlan, ...]:
    if args.seed < 0:
        raise InputError("--seed: must be 0 or more")
    if args.every < 1:
        raise InputError("--every: must be at least 1")
    return plan_dataset(preset, args.seed)


def _chosen(plans: Sequence[SequencePlan], splits: list[str] | None, ranges: str | None) -> list[SequencePlan]:
    numbers = set(range(len(plans))) if ranges is None else sequence_numbers(ranges, len(plans))
    chosen = [plan for plan in plans if plan.index in numbers and (not splits or plan.split in splits)]
    if not chosen:
        raise InputError("--split and --sequences: no sequence is in both")
    return chosen


def sequence_numbers(text: str, count: int) -> set[int]:
    """The numbers in a list such as `0-9,12`, below `count`. Raises InputError."""
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if not match:
            raise InputError(f"--sequences: {part!r} is neither a number nor a range such as 0-9")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first or last >= count:
            raise InputError(f"--sequences: {part.strip()!r} is not within 0-{count - 1}")
        numbers.update(range(first, last + 1))
    return numbers


def _backdrops(folder: Path | None) -> tuple[Path, ...]:
    if folder is None:
        return ()
    if not folder.is_dir():
        raise InputError(f"--backdrops: {folder} is not a folder")
    shown = (p for p in folder.iterdir() if not p.name.startswith("."))  # macOS writes ._sky.jpg beside sky.jpg
    found = sorted(p for p in shown if p.suffix.lower() in (".jpg", ".jpeg", ".png", ".hdr"))
    if not found:
        raise InputError(f"--backdrops: {folder} holds no .jpg, .png or .hdr file")
    for path in found:  # now, and not hours later in the first sequence that uses it
        if not cv2.haveImageReader(str(path)):
            raise InputError(f"--backdrops: {path} is not a readable picture")
    return tuple(path.resolve() for path in found)


def _command(args: argparse.Namespace) -> str:
    """The command that generates the whole dataset, without its folder and the number of workers."""
    words = ["uavpose-replay", "generate", "--preset", str(args.preset), "--seed", str(args.seed)]
    words += ["--every", str(args.every)] if args.every != 1 else []
    words += [f"--{name.replace('_', '-')}" for name in ("labels_only", "undistorted") if getattr(args, name)]
    words += ["--backdrops", str(args.backdrops)] if args.backdrops else []
    return shlex.join(words)
