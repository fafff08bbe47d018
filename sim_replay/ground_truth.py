"""What is true of a BOP scene, and of a sequence that can be flown: frames, intrinsics, target poses, own ship."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.cameras.sequence import read_scene
from edge.config import MountSettings
from edge.errors import InputError
from edge.types import Mount
from msgs.geometry import Array
from sim_replay.overlay import Extents
from sim_replay.score import Truth

_MM = 1e-3


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A BOP scene; frames are counted from 0 in the order of their picture numbers."""

    folder: Path
    images: list[Path]
    K: list[Array]  # [3, 3] for each frame
    truths: list[Truth]
    extents: dict[int, Extents]  # by object id

    @property
    def name(self) -> str:
        return self.folder.name


@dataclass(frozen=True, eq=False)
class PlayedSequence:
    """A scene with all it takes to fly it: rate, mount, telemetry of the own ship."""

    scene: SceneTruth
    fps: float
    mount: Mount
    telemetry_csv: Path


def read_scene_truth(folder: Path) -> SceneTruth:
    """Read a BOP scene folder and the dataset's models_info.json. Raises InputError, naming file and key."""
    images, K = read_scene(folder)
    models_path = _models_info(folder)
    with _blame(models_path):
        models = {int(key): value for key, value in json.loads(models_path.read_text(encoding="utf-8")).items()}
        extents = {key: _extents(model) for key, model in models.items()}
        diameters_m = {key: float(model["diameter"]) * _MM for key, model in models.items()}
    truths = []
    with _blame(folder / "scene_gt.json") as path:
        poses = json.loads(path.read_text(encoding="utf-8"))
        for frame, image in enumerate(images):
            for pose in poses.get(str(int(image.stem)), []):
                R_cam_target = np.array(pose["cam_R_m2c"], dtype=np.float64).reshape(3, 3)
                t_cam_target_m = np.array(pose["cam_t_m2c"], dtype=np.float64).reshape(3) * _MM
                object_id = int(pose["obj_id"])
                truths.append(Truth(frame, R_cam_target, t_cam_target_m, object_id, diameters_m[object_id]))
    return SceneTruth(folder, images, K, truths, extents)


def read_sequence(folder: Path) -> PlayedSequence:
    """Read a scene with its sequence.toml and telemetry.csv. Raises InputError, naming file and key."""
    scene = read_scene_truth(folder)
    with _blame(folder / "sequence.toml") as path:
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
        mount = MountSettings(R_body_cam=settings["R_body_cam"], t_body_cam_m=settings["t_body_cam_m"]).mount()
        fps = float(settings["fps"])
    return PlayedSequence(scene, fps, mount, folder / "telemetry.csv")


def _models_info(folder: Path) -> Path:
    """models_info.json of the dataset that the scene belongs to: BOP has scenes at <dataset>/<split>/<scene>."""
    for parent in (folder, *folder.resolve().parents[:2]):
        path = parent / "models" / "models_info.json"
        if path.is_file():
            return path
    raise InputError(f"{folder}: no models/models_info.json beside the scene or up to two folders above it")


def _extents(model: dict[str, Any]) -> Extents:
    low, size = ([float(model[f"{name}_{axis}"]) * _MM for axis in "xyz"] for name in ("min", "size"))
    return Extents((low[0], low[1], low[2]), (size[0], size[1], size[2]))


@contextmanager
def _blame(path: Path) -> Iterator[Path]:
    """Errors of reading `path` inside are told as InputError in a sentence that names it."""
    try:
        yield path
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]!r} is missing") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not as expected: {error}") from error
