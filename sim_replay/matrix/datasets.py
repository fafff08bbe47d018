"""Selects the sequences of a generated dataset that the matrix flies."""

from __future__ import annotations

import tomllib
from pathlib import Path

from edge.errors import InputError
from sim_replay.bop import find_scenes

SPLIT = "test"
FIXED = "fixed"


def flyable(dataset: Path, count: int) -> list[Path]:
    """Folders of the first `count` test sequences that can be flown.

    Those with a fixed camera come first: the result of a cell then depends on the daemon alone.
    Raises InputError if there are too few.
    """
    scenes = [scene for scene in find_scenes(dataset) if scene.split is None or scene.split.startswith(SPLIT)]
    folders = [
        scene.folder
        for scene in scenes
        if (scene.folder / "sequence.toml").is_file() and (scene.folder / "telemetry.csv").is_file()
    ]
    if len(folders) < count:
        raise InputError(f"{dataset}: holds {len(folders)} test sequences that can be flown, not {count}")
    return sorted(folders, key=lambda folder: (_mount(folder / "sequence.toml") != FIXED, folder))[:count]


def _mount(path: Path) -> str:
    try:
        return str(tomllib.loads(path.read_text(encoding="utf-8")).get("mount", FIXED))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not as expected: {error}") from error
