"""BOP scenes on disk (thodan/bop_toolkit docs/bop_datasets_format.md): write them, read them.

Lengths are millimetres in the files and metres here. A scene's world is local NED where this project wrote it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes.mesh import Mesh, diameter_m

Array = NDArray[np.float64]
MM_PER_M = 1000.0
DEPTH_SCALE = 1.0  # of files that hold no depth


class BopError(ValueError):
    """A BOP file that cannot be used; the text is a sentence that names the file and the key."""


@dataclass(frozen=True, eq=False)
class BopTarget:
    """One object in one picture."""

    object_id: int
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]
    box_visible_xyxy_px: Array | None = None  # [4], edges half a pixel outside the outermost visible pixel centres
    box_whole_xyxy_px: Array | None = None  # [4], of the whole outline, also beyond the picture
    visible_px: int | None = None  # pixels of the visible mask
    whole_px: int | None = None  # pixels of the whole outline


@dataclass(frozen=True, eq=False)
class BopFrame:
    """One picture: its camera and the objects in it."""

    image_id: int
    K: Array  # [3, 3]
    targets: tuple[BopTarget, ...] = ()
    R_cam_world: Array | None = None  # [3, 3]
    t_cam_world_m: Array | None = None  # [3]


@dataclass(frozen=True, eq=False)
class BopScene:
    """A scene folder that has been read; pictures and masks stay on disk."""

    folder: Path
    frames: tuple[BopFrame, ...]

    def image_path(self, frame: BopFrame) -> Path:
        """The frame's picture, JPEG or PNG. Raises BopError if there is none."""
        for suffix in (".jpg", ".png"):
            path = self.folder / "rgb" / f"{frame.image_id:06d}{suffix}"
            if path.is_file():
                return path
        raise BopError(f"{self.folder / 'rgb'} holds no picture {frame.image_id:06d}")

    def image_bgr(self, frame: BopFrame) -> NDArray[np.uint8]:
        """The frame's picture [H, W, 3]. Raises BopError."""
        return _pixels(self.image_path(frame), cv2.IMREAD_COLOR)

    def mask(self, frame: BopFrame, target_index: int) -> NDArray[np.bool_] | None:
        """The visible mask [H, W] of a target, or None where the data set has no masks. Raises BopError."""
        path = _mask_path(self.folder, frame.image_id, target_index)
        return _pixels(path, cv2.IMREAD_GRAYSCALE) > 127 if path.is_file() else None


def _mask_path(folder: Path, image_id: int, target_index: int) -> Path:
    return folder / "mask_visib" / f"{image_id:06d}_{target_index:06d}.png"


def _pixels(path: Path, flags: int) -> NDArray[np.uint8]:
    pixels = cv2.imread(str(path), flags)
    if pixels is None:
        raise BopError(f"{path} is not a readable picture")
    return np.asarray(pixels, dtype=np.uint8)


# --- scenes: writing --------------------------------------------------------------------------------------------------


@dataclass
class SceneWriter:
    """Writes pictures as they come and the indices when it is closed; use it in a `with` statement."""

    folder: Path
    jpeg_quality: int = 90
    _frames: list[BopFrame] = field(default_factory=list)

    def __enter__(self) -> SceneWriter:
        for name in ("rgb", "mask_visib"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def add(self, frame: BopFrame, image_bgr: NDArray[np.uint8], masks: Sequence[NDArray[np.bool_]] = ()) -> None:
        """Write one picture [H, W, 3] and the visible masks [H, W] of its targets, in their order."""
        path = self.folder / "rgb" / f"{frame.image_id:06d}.jpg"
        if not cv2.imwrite(str(path), image_bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality]):
            raise OSError(f"{path} cannot be written")
        for index, mask in enumerate(masks):
            png = str(_mask_path(self.folder, frame.image_id, index))
            cv2.imwrite(png, mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        self._frames.append(frame)

    def close(self) -> None:
        """Write scene_camera.json, scene_gt.json and scene_gt_info.json for the frames so far."""
        frames = sorted(self._frames, key=lambda frame: frame.image_id)
        _write_lines(self.folder / "scene_camera.json", {f.image_id: _camera_entry(f) for f in frames})
        _write_lines(self.folder / "scene_gt.json", {f.image_id: [_pose_entry(t) for t in f.targets] for f in frames})
        _write_lines(
            self.folder / "scene_gt_info.json", {f.image_id: [_info_entry(t) for t in f.targets] for f in frames}
        )


def _write_lines(path: Path, entries: Mapping[int, Any]) -> None:
    body = ",\n".join(f'  "{key}": {json.dumps(value)}' for key, value in entries.items())
    path.write_text("{\n" + body + "\n}\n", encoding="utf-8")


def _numbers(values: Array, digits: int = 9) -> list[float]:
    return [round(float(value), digits) for value in np.asarray(values).reshape(-1)]


def _camera_entry(frame: BopFrame) -> dict[str, Any]:
    entry: dict[str, Any] = {"cam_K": _numbers(frame.K), "depth_scale": DEPTH_SCALE}
    if frame.R_cam_world is not None and frame.t_cam_world_m is not None:
        entry["cam_R_w2c"] = _numbers(frame.R_cam_world)
        entry["cam_t_w2c"] = _numbers(frame.t_cam_world_m * MM_PER_M, 4)
    return entry


def _pose_entry(target: BopTarget) -> dict[str, Any]:
    return {
        "cam_R_m2c": _numbers(target.R_cam_target),
        "cam_t_m2c": _numbers(target.t_cam_target_m * MM_PER_M, 4),
        "obj_id": target.object_id,
    }


def _box_entry(box_xyxy_px: Array | None) -> list[int]:
    """BOP's (x, y, width, height) counts whole pixels; -1 stands for no box."""
    if box_xyxy_px is None:
        return [-1, -1, -1, -1]
    low, high = np.round(box_xyxy_px[:2] + 0.5).astype(int), np.round(box_xyxy_px[2:] - 0.5).astype(int)
    width, height = np.maximum(high - low + 1, 1)
    return [int(low[0]), int(low[1]), int(width), int(height)]


def _info_entry(target: BopTarget) -> dict[str, Any]:
    visible = target.visible_px or 0
    whole = visible if target.whole_px is None else target.whole_px
    return {
        "bbox_obj": _box_entry(target.box_whole_xyxy_px),
        "bbox_visib": _box_entry(target.box_visible_xyxy_px),
        "px_count_all": whole,
        "px_count_valid": 0,
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


# --- scenes: reading --------------------------------------------------------------------------------------------------


def read_scene(folder: Path) -> BopScene:
    """Read a scene; scene_gt.json and scene_gt_info.json may be absent, as in a test split. Raises BopError."""
    cameras = _load(folder / "scene_camera.json")
    poses, info = (_load(folder / name, optional=True) for name in ("scene_gt.json", "scene_gt_info.json"))
    frames = []
    for key in sorted(cameras, key=lambda name: _image_id(folder / "scene_camera.json", name)):
        path = folder / "scene_camera.json"
        entry = cameras[key]
        has_world = isinstance(entry, dict) and "cam_R_w2c" in entry
        frames.append(
            BopFrame(
                image_id=_image_id(path, key),
                K=_matrix(path, key, entry, "cam_K", (3, 3)),
                targets=_targets(folder, key, poses.get(key, []), info.get(key)),
                R_cam_world=_matrix(path, key, entry, "cam_R_w2c", (3, 3)) if has_world else None,
                t_cam_world_m=_matrix(path, key, entry, "cam_t_w2c", (3,)) / MM_PER_M if has_world else None,
            )
        )
    return BopScene(folder, tuple(frames))


def _load(path: Path, optional: bool = False) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        if optional:
            return {}
        raise BopError(f"{path} is missing") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BopError(f"{path} cannot be read: {getattr(error, 'strerror', 'not UTF-8 text')}") from error
    except json.JSONDecodeError as error:
        raise BopError(f"{path} line {error.lineno} is not JSON: {error.msg}") from error
    if not isinstance(value, dict):
        raise BopError(f"{path} does not hold an object of pictures or models")
    return value


def _image_id(path: Path, key: str) -> int:
    if not key.isdecimal():
        raise BopError(f"{path}: {key!r} is not the number of a picture or model")
    return int(key)


def _matrix(path: Path, key: str, entry: Any, name: str, shape: tuple[int, ...]) -> Array:
    if not isinstance(entry, dict) or name not in entry:
        raise BopError(f"{path}: {key!r} has no {name!r}")
    try:
        values = np.asarray(entry[name], dtype=np.float64).reshape(shape)
    except (ValueError, TypeError) as error:
        raise BopError(f"{path}: {name!r} of {key!r} is not {int(np.prod(shape))} numbers") from error
    if not np.isfinite(values).all():
        raise BopError(f"{path}: {name!r} of {key!r} is not finite")
    return values


def _integer(path: Path, key: str, entry: Any, name: str) -> int:
    if not isinstance(entry, dict) or not isinstance(entry.get(name), int):
        raise BopError(f"{path}: {key!r} has no integer {name!r}")
    return int(entry[name])


def _targets(folder: Path, key: str, poses: Any, info: Any) -> tuple[BopTarget, ...]:
    path, info_path = folder / "scene_gt.json", folder / "scene_gt_info.json"
    if not isinstance(poses, list):
        raise BopError(f"{path}: {key!r} is not a list of objects")
    if info is not None and (not isinstance(info, list) or len(info) != len(poses)):
        raise BopError(f"{info_path}: {key!r} does not list the {len(poses)} objects of scene_gt.json")
    targets = []
    for index, entry in enumerate(poses):
        extra: dict[str, Any] = {}
        if info is not None:
            extra = {
                "box_visible_xyxy_px": _box(info_path, key, info[index], "bbox_visib"),
                "box_whole_xyxy_px": _box(info_path, key, info[index], "bbox_obj"),
                "visible_px": _integer(info_path, key, info[index], "px_count_visib"),
                "whole_px": _integer(info_path, key, info[index], "px_count_all"),
            }
        targets.append(
            BopTarget(
                _integer(path, key, entry, "obj_id"),
                _matrix(path, key, entry, "cam_R_m2c", (3, 3)),
                _matrix(path, key, entry, "cam_t_m2c", (3,)) / MM_PER_M,
                **extra,
            )
        )
    return tuple(targets)


def _box(path: Path, key: str, entry: Any, name: str) -> Array | None:
    x, y, width, height = _matrix(path, key, entry, name, (4,))
    if width <= 0 or height <= 0:
        return None
    return np.array([x, y, x + width, y + height]) - 0.5


# --- the data set's own files -----------------------------------------------------------------------------------------


def write_camera(path: Path, K: Array, width_px: int, height_px: int) -> None:
    """Write camera.json: the intrinsics of a data set whose scenes share them (scene_camera.json has the last word)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    entry = {
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "depth_scale": DEPTH_SCALE,
        "width": width_px,
        "height": height_px,
    }
    path.write_text(json.dumps(entry, indent=2) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class ModelInfo:
    """Size of a model, metres, in its own frame."""

    diameter_m: float
    low_m: tuple[float, float, float]
    size_m: tuple[float, float, float]


def write_models(folder: Path, meshes: Mapping[int, Mesh]) -> None:
    """Write obj_NNNNNN.ply (millimetres, binary) of each object id and models_info.json into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    info = {}
    for object_id, mesh in meshes.items():
        write_ply(folder / f"obj_{object_id:06d}.ply", mesh)
        points = mesh.vertices_m.astype(np.float64) * MM_PER_M
        low, size = points.min(axis=0), np.ptp(points, axis=0)
        info[object_id] = {
            "diameter": round(diameter_m(mesh) * MM_PER_M, 4),
            **{f"min_{axis}": round(float(v), 4) for axis, v in zip("xyz", low, strict=True)},
            **{f"size_{axis}": round(float(v), 4) for axis, v in zip("xyz", size, strict=True)},
        }
    _write_lines(folder / "models_info.json", info)


def read_models_info(folder: Path) -> dict[int, ModelInfo]:
    """Read models_info.json in `folder`, by object id. Raises BopError."""
    path = folder / "models_info.json"
    out = {}
    for key, entry in _load(path).items():

        def value(name: str, key: str = key, entry: Any = entry) -> float:
            return float(_matrix(path, key, entry, name, ())) / MM_PER_M

        low, size = ((value(f"{kind}_x"), value(f"{kind}_y"), value(f"{kind}_z")) for kind in ("min", "size"))
        out[_image_id(path, key)] = ModelInfo(value("diameter"), low, size)
    return out


_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", (3,))])


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary PLY in millimetres."""
    vertices = np.empty(len(mesh.vertices_m), _VERTEX)
    for k, axis in enumerate("xyz"):
        vertices[axis], vertices[f"n{axis}"] = mesh.vertices_m[:, k] * MM_PER_M, mesh.normals[:, k]
    faces = np.empty(len(mesh.faces), _FACE)
    faces["count"], faces["vertex"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in _VERTEX.names or ()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes() + faces.tobytes())


def read_ply_vertices_m(path: Path) -> NDArray[np.float32]:
    """Vertices [V, 3], metres, of a PLY in millimetres, ASCII or binary little-endian. Raises BopError."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise BopError(f"{path} cannot be read: {error.strerror}") from error
    head, mark, body = raw.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not mark or lines[0] != ["ply"] or len(lines) < 3 or lines[1][:1] != ["format"]:
        raise BopError(f"{path} is not a PLY file")
    elements = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1] != "vertex":
        raise BopError(f"{path}: its first element is not 'vertex'")
    count = int(lines[elements[0]][2])
    stop = elements[1] if len(elements) > 1 else len(lines)
    properties = [line for line in lines[elements[0] : stop] if line[:1] == ["property"]]
    kinds = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1", "int": "<i4"}
    try:
        layout = np.dtype([(line[2], kinds[line[1]]) for line in properties])
        if lines[1][1] == "ascii":
            table = np.array([row.split()[: len(properties)] for row in body.splitlines()[:count]], dtype=np.float64)
            columns = {line[2]: table[:, i] for i, line in enumerate(properties)}
        else:
            block = np.frombuffer(body, layout, count)
            columns = {name: block[name] for name in layout.names or ()}
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    except (KeyError, ValueError, IndexError) as error:
        raise BopError(f"{path}: its {count} vertices cannot be read: {error}") from error
    return (points / MM_PER_M).astype(np.float32)
