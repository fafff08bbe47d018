"""Writes BOP scenes and the files of a dataset (thodan/bop_toolkit docs/bop_datasets_format.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.cameras.sequence import DISTORTION_KEY
from sim_replay.bop.models import largest_distance
from sim_replay.bop.ply import write_ply
from sim_replay.bop.records import MM_PER_M, Array, BopFrame, BopTarget, Distortion

if TYPE_CHECKING:
    from sim_replay.airframes.mesh import Mesh

DEPTH_SCALE = 1.0  # of files without depth


@dataclass
class SceneWriter:
    """Writes images as they come and the indices when it is closed; use it in a `with` statement."""

    folder: Path
    jpeg_quality: int = 90
    _frames: list[BopFrame] = field(default_factory=list)

    def __enter__(self) -> SceneWriter:
        for name in ("rgb", "mask", "mask_visib"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def add(
        self,
        frame: BopFrame,
        image_bgr: NDArray[np.uint8],
        masks: Sequence[NDArray[np.bool_]] = (),
        whole_masks: Sequence[NDArray[np.bool_]] = (),
    ) -> None:
        """Write one image [H, W, 3] and the masks [H, W] of its targets, in their order.

        Args:
            masks: The visible part of each target.
            whole_masks: Each target's silhouette without occlusion; if there is none, the visible mask is also written
                as the silhouette, unless the target's `whole_px` says that it is larger.
        """
        path = self.folder / "rgb" / f"{frame.image_id:06d}.jpg"
        write_picture(path, image_bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        for index, mask in enumerate(masks):
            self._write_mask("mask_visib", frame.image_id, index, mask)
            if not whole_masks and frame.targets[index].whole_px in (None, frame.targets[index].visible_px):
                self._write_mask("mask", frame.image_id, index, mask)
        for index, mask in enumerate(whole_masks):
            self._write_mask("mask", frame.image_id, index, mask)
        self._frames.append(frame)

    def add_encoded(self, frame: BopFrame, data: bytes, suffix: str) -> None:
        """Write one image without targets unchanged, byte for byte; `suffix` is jpg or png."""
        (self.folder / "rgb" / f"{frame.image_id:06d}.{suffix}").write_bytes(data)
        self._frames.append(frame)

    def _write_mask(self, kind: str, image_id: int, index: int, mask: NDArray[np.bool_]) -> None:
        path = self.folder / kind / f"{image_id:06d}_{index:06d}.png"
        write_picture(path, mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_COMPRESSION, 9])

    def close(self) -> None:
        """Write scene_camera.json, scene_gt.json and scene_gt_info.json for the frames so far."""
        frames = sorted(self._frames, key=lambda frame: frame.image_id)
        # The cameras last: a frame that they list and the poses do not, as after a kill in between, shows no target.
        _write_lines(
            self.folder / "scene_gt_info.json", {f.image_id: [_info_entry(t) for t in f.targets] for f in frames}
        )
        _write_lines(self.folder / "scene_gt.json", {f.image_id: [_pose_entry(t) for t in f.targets] for f in frames})
        _write_lines(self.folder / "scene_camera.json", {f.image_id: _camera_entry(f) for f in frames})


def write_picture(path: Path, pixels: NDArray[np.uint8], how: Sequence[int]) -> None:
    """Encode in the suffix's format, with OpenCV's flags `how`. Raises OSError, also if imwrite ignores an error."""
    encoded, data = cv2.imencode(path.suffix, pixels, how)
    if not encoded:
        raise OSError(f"{path} cannot be written")
    path.write_bytes(data.tobytes())


def _write_lines(path: Path, entries: Mapping[int, Any]) -> None:
    body = ",\n".join(f'  "{key}": {json.dumps(value)}' for key, value in entries.items())
    path.write_text("{\n" + body + "\n}\n", encoding="utf-8")


def _numbers(values: Array, digits: int = 9) -> list[float]:
    return [round(float(value), digits) for value in np.asarray(values).reshape(-1)]


def _camera_entry(frame: BopFrame) -> dict[str, Any]:
    entry: dict[str, Any] = {"cam_K": _numbers(frame.K), "depth_scale": DEPTH_SCALE}
    if frame.distortion is not None:
        entry[DISTORTION_KEY] = [float(value) for value in frame.distortion]
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
        "px_count_valid": 0,  # counts depth measurements, and there is no depth image
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


def write_camera(path: Path, K: Array, width_px: int, height_px: int, distortion: Distortion | None = None) -> None:
    """Write camera.json: the intrinsics shared by a dataset's scenes (scene_camera.json takes precedence)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    entry: dict[str, Any] = {
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "depth_scale": DEPTH_SCALE,
        "width": width_px,
        "height": height_px,
    }
    if distortion is not None:
        entry[DISTORTION_KEY] = [float(value) for value in distortion]
    path.write_text(json.dumps(entry, indent=2) + "\n", encoding="utf-8")


def write_models(folder: Path, meshes: Mapping[int, Mesh], names: Mapping[int, str] | None = None) -> None:
    """Write obj_NNNNNN.ply (millimetres, binary) of each object id and models_info.json into `folder`.

    `names` of objects are written to models_info.json as "name", an extension of ours by which scores name them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    info = {}
    for object_id, mesh in meshes.items():
        write_ply(folder / f"obj_{object_id:06d}.ply", mesh)
        points = mesh.vertices_m.astype(np.float64) * MM_PER_M
        low, size = points.min(axis=0), np.ptp(points, axis=0)
        info[object_id] = {
            **({"name": names[object_id]} if names and object_id in names else {}),
            "diameter": round(largest_distance(points), 4),
            **{f"min_{axis}": round(float(v), 4) for axis, v in zip("xyz", low, strict=True)},
            **{f"size_{axis}": round(float(v), 4) for axis, v in zip("xyz", size, strict=True)},
        }
    _write_lines(folder / "models_info.json", info)
