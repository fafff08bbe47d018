"""The models of a BOP dataset: size, diameter and vertices of each object, in body axes (FRD), metres."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sim_replay.bop.fields import by_number, load_object, matrix, number_key
from sim_replay.bop.model_frame import ModelFrame, ModelFrames
from sim_replay.bop.ply import read_ply_vertices_m
from sim_replay.bop.records import MM_PER_M, Array, BopError

_CHUNK = 2048


@dataclass(frozen=True, eq=False)
class Model:
    """One object. Its vertices are read on first use."""

    diameter_m: float  # largest distance between two vertices
    low_m: tuple[float, float, float] | None = None  # corner of the box along the body axes; None: unknown
    size_m: tuple[float, float, float] | None = None
    ply: Path | None = None
    frame: ModelFrame | None = None
    name: str = ""  # models_info.json's optional "name"; empty: it has none

    @cached_property
    def vertices_m(self) -> Array | None:
        """[V, 3] in body, metres; None if the dataset has no mesh of the object. Raises BopError."""
        if self.ply is None:
            return None
        vertices = read_ply_vertices_m(self.ply).astype(np.float64)
        return vertices if self.frame is None else self.frame.points_in_body(vertices)

    @property
    def points_m(self) -> Array | None:
        """Points [N, 3] in body that bound the object: its vertices, otherwise its box's corners; None: unknown."""
        if self.vertices_m is not None or self.low_m is None or self.size_m is None:
            return self.vertices_m
        return _corners(np.array(self.low_m), np.array(self.size_m))


def models_folder(root: Path) -> Path | None:
    """models/, otherwise models_eval/, otherwise another models_*/ with models_info.json or obj_*.ply."""
    preferred = ("models", "models_eval")
    names = sorted(root.glob("models*"), key=lambda path: (*(path.name != name for name in preferred), path.name))
    return next((path for path in names if (path / "models_info.json").is_file() or any(path.glob("obj_*.ply"))), None)


def object_names(root: Path | None) -> dict[int, str]:
    """Names of a dataset's objects in models_info.json, by id; those without "name" are left out. Raises BopError.

    "name" is an extension of ours: an id alone means a different object in each dataset.
    """
    folder = None if root is None else models_folder(root)
    if folder is None:
        return {}
    path = folder / "models_info.json"
    entries = by_number(path, load_object(path, optional=True))
    return {
        number: str(entry["name"]) for number, entry in entries.items() if isinstance(entry, dict) and "name" in entry
    }


def read_models(root: Path, frames: ModelFrames) -> dict[int, Model]:
    """The objects of a dataset by id: from models_info.json, meshes, or diameters in model_frame.toml; else none.

    Raises BopError.
    """
    folder = models_folder(root)
    models = {} if folder is None else dict(_files_of(folder, frames))
    for object_id, frame in frames.by_object.items():
        if object_id not in models and frame.diameter_m is not None:
            models[object_id] = Model(frame.diameter_m)
    return models


def _files_of(folder: Path, frames: ModelFrames) -> Iterator[tuple[int, Model]]:
    path = folder / "models_info.json"
    info = {number_key(path, key): (key, entry) for key, entry in load_object(path, optional=True).items()}
    names = ((re.fullmatch(r"obj_(\d+)", file.stem), file) for file in folder.glob("obj_*.ply"))
    meshes = {int(name[1]): file for name, file in names if name}
    for object_id in sorted(info.keys() | meshes.keys()):
        key, entry = info.get(object_id, (str(object_id), None))
        yield object_id, _model(path, key, entry, meshes.get(object_id), frames.of(object_id))


def _model(path: Path, key: str, entry: Any, ply: Path | None, frame: ModelFrame) -> Model:
    """One object; values missing in models_info.json are computed from the mesh."""
    known = entry if isinstance(entry, dict) else {}
    name = str(known.get("name", ""))
    diameter_m = _metres(path, key, entry, "diameter") if "diameter" in known or ply is None else None
    corners = None
    if all(f"{kind}_{axis}" in known for kind in ("min", "size") for axis in "xyz"):
        low, size = (
            np.array([_metres(path, key, entry, f"{kind}_{axis}") for axis in "xyz"]) for kind in ("min", "size")
        )
        corners = frame.points_in_body(_corners(low, size))
    if ply is not None and (diameter_m is None or corners is None):
        vertices = Model(0.0, ply=ply, frame=frame).vertices_m
        assert vertices is not None
        corners = vertices if corners is None else corners
        diameter_m = largest_distance(vertices) if diameter_m is None else diameter_m
    assert diameter_m is not None
    if diameter_m <= 0:
        raise BopError(f"{path}: 'diameter' of {key!r} is not above zero")
    if corners is None:
        return Model(diameter_m, name=name)  # nor is there a mesh
    return Model(diameter_m, _triple(corners.min(axis=0)), _triple(np.ptp(corners, axis=0)), ply, frame, name)


def largest_distance(points: Array) -> float:
    """Largest distance between two of the points [N, 3] (BOP's diameter), exact, in their unit.

    Walking to the farthest point gives a lower bound; points too near the middle to reach it are discarded.
    """
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = np.linalg.norm(points - middle, axis=1)
    start = points[radius.argmax()]
    for _ in range(4):
        reach = np.linalg.norm(points - start, axis=1)
        start, bound = points[reach.argmax()], float(reach.max())
    outer = points[radius >= bound - radius.max() - 1e-9 * bound]
    best = bound**2
    for first in range(0, len(outer), _CHUNK):
        block = outer[first : first + _CHUNK]
        for second in range(first, len(outer), _CHUNK):
            apart = block[:, None] - outer[None, second : second + _CHUNK]
            best = max(best, float(np.einsum("ijk,ijk->ij", apart, apart).max()))
    return float(np.sqrt(best))


def _corners(low: Array, size: Array) -> Array:
    return low + ((np.arange(8)[:, None] >> np.arange(3)) & 1) * size


def _metres(path: Path, key: str, entry: Any, name: str) -> float:
    return float(matrix(path, key, entry, name, ())) / MM_PER_M


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
