"""dataset.toml: what a dataset is, sufficient to reproduce it, and how much of it is finished."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from edge.errors import InputError
from msgs.settings import read_text, read_toml, toml_value
from sim_replay.benchmark.plan import SequencePlan
from sim_replay.benchmark.preset import SPLITS
from sim_replay.benchmark.scene_store import is_finished, replace_text
from sim_replay.benchmark.sequence_files import Job
from sim_replay.lock import LOCK_FILE
from sim_replay.packages import packages

FILE = "dataset.toml"
PRESET_FILE = "preset.toml"


@dataclass(frozen=True)
class Recipe:
    """What determines every byte of a dataset, on one machine, besides the installed packages."""

    preset: str  # the name that it gives itself
    seed: int
    every: int
    labels_only: bool
    undistorted: bool
    backdrops: dict[str, str]  # available photographs: SHA-256 by file name

    def lines(self) -> list[str]:
        """Its keys, as TOML; without the backdrops, which are a table."""
        return [
            f'preset = "{self.preset}"  # its text is in {PRESET_FILE}',
            f"seed = {self.seed}",
            f"every = {self.every}",
            f"labels_only = {str(self.labels_only).lower()}",
            f"undistorted = {str(self.undistorted).lower()}",
        ]


def claim(out: Path, recipe: Recipe, preset_text: str, resume: bool) -> None:
    """Claim the dataset's folder, or continue one that was begun with the same recipe. Raises InputError."""
    if not (out / FILE).is_file():
        if out.is_dir() and any(path.name not in (LOCK_FILE, PRESET_FILE) for path in out.iterdir()):
            raise InputError(f"{out}: is not empty and holds no {FILE}; choose another --out")
        out.mkdir(parents=True, exist_ok=True)
        (out / PRESET_FILE).write_text(preset_text, encoding="utf-8")
        return
    if not resume:
        raise InputError(f"{out}: already holds a dataset; --resume goes on with it, or choose another --out")
    found = read_toml(out / FILE, InputError)
    text = read_text(out / PRESET_FILE, InputError)
    for key, value in (vars(recipe) | {"packages": packages()}).items():
        there = found.get(key)
        if isinstance(value, dict):
            _check_same(out / FILE, key, there if isinstance(there, dict) else {}, value)
        elif there != value:
            raise InputError(f"{out / FILE}: {key} is {there!r} there and {value!r} now; it must stay")
    if text != preset_text:
        raise InputError(f"{out / PRESET_FILE}: differs from the preset given; it must stay")


def _check_same(path: Path, table: str, there: Mapping[str, object], now: Mapping[str, object]) -> None:
    """Raise InputError that names the first entry in which they differ."""
    for name in sorted({*there, *now}):
        if there.get(name) != now.get(name):
            before, after = (str(of.get(name, "absent")) for of in (there, now))
            raise InputError(f"{path}: [{table}] {name} is {before} there and {after} now; it must stay")


def write_manifest(job: Job, recipe: Recipe, plans: Sequence[SequencePlan]) -> None:
    """Write dataset.toml: recipe, packages, and which of the planned sequences are finished."""
    there = [plan for plan in plans if is_finished(job.folder(plan))]
    lines = [
        f"command = {toml_value(job.command + _only(plans, there))}  # makes it again",
        *recipe.lines(),
        f"complete = {str(len(there) == len(plans)).lower()}  # every sequence of the preset is there",
        f"sequences = {len(there)}",
        f"frames = {sum(len(job.frames(plan)) for plan in there)}",
    ]
    for name in SPLITS:
        chosen = [plan for plan in there if plan.split == name]
        if chosen:
            frames = sum(len(job.frames(plan)) for plan in chosen)
            lines += ["", f"[splits.{name}]", f"sequences = {len(chosen)}", f"frames = {frames}"]
    if recipe.backdrops:
        offered = (f"{toml_value(name)} = {toml_value(digest)}" for name, digest in recipe.backdrops.items())
        lines += ["", "[backdrops]  # SHA-256 of the photographs offered", *offered]
    lines += ["", "[packages]", *(f"{name} = {toml_value(installed)}" for name, installed in packages().items()), ""]
    replace_text(job.out / FILE, "\n".join(lines))


def _only(plans: Sequence[SequencePlan], there: Sequence[SequencePlan]) -> str:
    """The options that limit `generate` to the sequences that are there; none if all are, or none yet."""
    splits = {plan.split for plan in there}
    if len(there) in (0, len(plans)):
        return ""
    if len(there) == sum(plan.split in splits for plan in plans):
        return "".join(f" --split {name}" for name in SPLITS if name in splits)
    numbers = sorted(plan.index for plan in there)
    first = [number for number in numbers if number - 1 not in numbers]
    last = [number for number in numbers if number + 1 not in numbers]
    ranges = (str(a) if a == b else f"{a}-{b}" for a, b in zip(first, last, strict=True))
    return f" --sequences {','.join(ranges)}"


def digests(paths: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of files of one folder, by name. Raises InputError."""
    found = {}
    for path in paths:
        try:
            with path.open("rb") as file:
                found[path.name] = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    return found
