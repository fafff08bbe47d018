"""Finds the scenes of a BOP dataset, and its models and lists, from any folder of it."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

from sim_replay.bop.model_frame import MODEL_FRAME_FILE, read_model_frames
from sim_replay.bop.models import models_folder
from sim_replay.bop.records import BopError
from sim_replay.bop.scene import BopScene, ImagewiseScene, imagewise_keys

_log = logging.getLogger(__name__)
_SCENE_FILES = ("scene_camera.json", "scene_gt.json")
_DEEPEST = 4  # levels between the given folder and a scene, and from a scene up to its dataset
TARGETS_FILE = "test_targets_bop19.json"


def find_scenes(path: Path) -> tuple[BopScene, ...]:
    """The scenes in `path`, a scene, split or dataset folder, by split and number; their files are not read yet.

    Raises BopError if there is none, or two of one split have the same number.
    """
    if not path.is_dir():
        raise BopError(f"{path} is not a folder" + ("" if path.is_absolute() else f" in {Path.cwd()}"))
    try:
        scenes = [scene for folder in _walk(path, _DEEPEST) for scene in _scenes_of(folder)]
    except OSError as error:
        raise BopError(f"{error.filename}: cannot be listed: {error.strerror}") from error
    if not scenes:
        raise BopError(f"{path}: no BOP scene (scene_camera.json or KEY.camera.json) in it or below")
    return _numbered(scenes)


def read_scene(folder: Path) -> BopScene:
    """One scene folder, its files read and checked; all except the camera and images are optional. Raises BopError."""
    (scene,) = _numbered([_scene(folder)])
    _ = scene.frames
    return scene


def find_root(folder: Path) -> Path | None:
    """The dataset that a folder belongs to: the nearest one up with models, model_frame.toml or a list of targets."""
    here = _absolute(folder)
    for candidate in (here, *here.parents[:_DEEPEST]):
        named = (candidate / name for name in (MODEL_FRAME_FILE, TARGETS_FILE))
        if models_folder(candidate) is not None or any(path.is_file() for path in named):
            return candidate
    return next((c for c in (here, *here.parents[:_DEEPEST]) if (c / "camera.json").is_file()), None)


def dataset_of(scene: BopScene) -> Path | None:
    """The dataset that contains the scene; None if unknown, for example if a camera.json is in the scene itself."""
    return None if scene.root == _absolute(scene.folder) else scene.root


def names_split(path: Path, scene: BopScene) -> bool:
    """Whether `path`, in which find_scenes found the scene, is its split or lies in it, and is not a whole dataset."""
    return scene.split is not None and scene.split not in scene.folder.relative_to(path).parts


def _absolute(folder: Path) -> Path:
    return Path(os.path.abspath(folder))  # a split may be a link to another disk: its dataset is where the link is


def _walk(folder: Path, deepest: int) -> Iterator[Path]:
    """`folder` and those below it, sorted, that may be or contain scenes; nothing inside a scene."""
    yield folder
    if deepest == 0 or _is_scene(folder):
        return
    for child in sorted(folder.iterdir()):
        if not child.is_dir() or child.name.startswith((".", "models")):
            continue
        if os.access(child, os.R_OK | os.X_OK):
            yield from _walk(child, deepest - 1)
        else:
            _log.warning("%s: cannot be searched for scenes", child)


def _is_scene(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _SCENE_FILES)


def _scenes_of(folder: Path) -> Iterator[BopScene]:
    if _is_scene(folder):
        yield _scene(folder)
        return
    keys = imagewise_keys(folder)
    if keys:
        root, split = _root_and_split(folder, _absolute(folder))
        frames = read_model_frames(root)
        for scene_id, pictures in sorted(keys.items()):
            yield ImagewiseScene(folder, scene_id, split, root, frames, pictures)


def _scene(folder: Path) -> BopScene:
    here = _absolute(folder)
    root, split = _root_and_split(folder, here.parent)
    scene_id = int(here.name) if here.name.isdecimal() else -1
    return BopScene(folder, scene_id, split, root, read_model_frames(root))


def _root_and_split(folder: Path, holder: Path) -> tuple[Path | None, str | None]:
    """The dataset of `folder`, and its split's name if `holder`, the scenes' parent folder, is in one or is one."""
    root, named = find_root(folder), re.match(r"train|val|test", holder.name)
    if root is None:
        return (holder.parent, holder.name) if named else (None, None)
    if root in holder.parents:
        return root, holder.relative_to(root).parts[0]
    # A camera.json in the scene itself does not make it a dataset.
    return root, holder.name if named and root != holder else None


def _numbered(scenes: list[BopScene]) -> tuple[BopScene, ...]:
    """Sorted; scenes whose folders are not numbers are numbered after the others of their split. Raises BopError."""
    ordered = sorted(scenes, key=lambda s: (s.split or "", s.scene_id < 0, s.scene_id, str(s.folder)))
    out = []
    for split in dict.fromkeys((dataset_of(scene), scene.split) for scene in ordered):
        group = [scene for scene in ordered if (dataset_of(scene), scene.split) == split]
        for before, after in pairwise(group):
            if before.scene_id == after.scene_id >= 0:
                both = f"{before.folder} and {after.folder}"
                raise BopError(f"{both}: both are scene {after.scene_id} of one split; give one of them another number")
        above = count(max(scene.scene_id for scene in group) + 1)
        out += [scene if scene.scene_id >= 0 else replace(scene, scene_id=next(above)) for scene in group]
    return tuple(out)
