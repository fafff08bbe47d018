"""Converts entries of BOP's scene files to `BopFrame`, for scenewise and imagewise datasets. Lengths in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.cameras.sequence import DISTORTION_KEY
from sim_replay.bop.fields import integer, length_m, matrix, rotation
from sim_replay.bop.model_frame import ModelFrames
from sim_replay.bop.records import Array, BopError, BopFrame, BopTarget, Distortion

ROUNDING = 1e-6  # of values in a camera matrix that must be 0 or 1


class Source(NamedTuple):
    """The files with an image's entries, to name them in errors."""

    camera: Path
    gt: Path
    gt_info: Path


def frame_of(source: Source, image_id: int, camera: Any, poses: Any, info: Any, models: ModelFrames) -> BopFrame:
    """One image's record; `info` may be None, and `poses` if no file has them: `info` then tells nothing. Raises
    BopError.

    The targets' poses are those of their body axes.
    """
    key = str(image_id)
    targets = [] if poses is None else _targets(source, key, poses or [], info)
    K = matrix(source.camera, key, camera, "cam_K", (3, 3))
    if min(K[0, 0], K[1, 1]) <= 0:
        raise BopError(f"{source.camera}: 'cam_K' of {key!r} has no positive focal lengths")
    if np.abs(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() > ROUNDING:
        raise BopError(f"{source.camera}: 'cam_K' of {key!r} is not, row by row, fx 0 cx, 0 fy cy, 0 0 1")
    has_world = "cam_R_w2c" in camera and "cam_t_w2c" in camera
    return BopFrame(
        image_id=image_id,
        K=K,
        targets=tuple(models.in_body(target) for target in targets),
        R_cam_world=rotation(source.camera, key, camera, "cam_R_w2c") if has_world else None,
        t_cam_world_m=length_m(source.camera, key, camera, "cam_t_w2c", (3,)) if has_world else None,
        distortion=distortion_of(source.camera, key, camera),
        truth_known=poses is not None,
    )


def distortion_of(path: Path, key: str, entry: dict[str, Any]) -> Distortion | None:
    """The lens distortion in a camera's entry; None if it has none. Raises BopError."""
    if DISTORTION_KEY not in entry:
        return None
    k1, k2, p1, p2, k3 = (float(value) for value in matrix(path, key, entry, DISTORTION_KEY, (5,)))
    return (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else None


def _targets(source: Source, key: str, poses: Any, info: Any) -> list[BopTarget]:
    if not isinstance(poses, list):
        raise BopError(f"{source.gt}: {key!r} is not a list of objects")
    if info is not None and (not isinstance(info, list) or len(info) != len(poses)):
        raise BopError(f"{source.gt_info}: {key!r} does not list the {len(poses)} objects of {source.gt.name}")
    targets = [
        BopTarget(
            integer(source.gt, key, entry, "obj_id"),
            rotation(source.gt, key, entry, "cam_R_m2c"),
            length_m(source.gt, key, entry, "cam_t_m2c", (3,)),
            **({} if info is None else _seen(source.gt_info, key, info[index])),
        )
        for index, entry in enumerate(poses)
    ]
    for target in targets:
        if not target.t_cam_target_m.any() and target.visible_px != 0:
            raise BopError(f"{source.gt}: 'cam_t_m2c' of {key!r} puts obj_id {target.object_id} into the camera itself")
        if target.t_cam_target_m[2] <= 0 and target.box_visible_xyxy_px is not None and target.visible_px != 0:
            raise BopError(
                f"{source.gt}: 'cam_t_m2c' of {key!r} puts obj_id {target.object_id} behind the camera, "
                f"but {source.gt_info.name} has a 'bbox_visib' of it"
            )
        if target.t_cam_target_m[2] > 0 and target.box_visible_xyxy_px is not None and target.visible_px == 0:
            raise BopError(
                f"{source.gt_info}: {key!r} has a 'bbox_visib' of obj_id {target.object_id}, but 'px_count_visib' says "
                "that nothing of it is visible; leave out the count if nobody counted"
            )
    return targets


def _seen(path: Path, key: str, entry: Any) -> dict[str, Any]:
    """A target's entry in scene_gt_info; the visible box is required, the rest may be absent."""
    seen: dict[str, Any] = {}
    if not isinstance(entry, dict):
        raise BopError(f"{path}: {key!r} does not hold what is seen of each object")
    for field, name in (("visible_px", "px_count_visib"), ("whole_px", "px_count_all")):
        if name in entry:
            seen[field] = integer(path, key, entry, name)
    seen["box_visible_xyxy_px"] = _box(path, key, entry, "bbox_visib", seen.get("visible_px", 0))
    if seen["box_visible_xyxy_px"] is not None and seen.get("visible_px") == seen.get("whole_px") == 0:
        del seen["visible_px"], seen["whole_px"]  # a tool that draws no masks counts nothing
    if "bbox_obj" in entry:
        seen["box_whole_xyxy_px"] = _box(path, key, entry, "bbox_obj", seen.get("whole_px", 0))
    if seen["box_visible_xyxy_px"] is None:
        seen["visible_px"] = 0
    return seen


def _box(path: Path, key: str, entry: Any, name: str, pixels: int) -> Array | None:
    x, y, width, height = matrix(path, key, entry, name, (4,))
    if pixels > 0 and min(width, height) == 0:
        width, height = max(width, 1), max(height, 1)  # bop_toolkit's side lengths are one pixel short
    if width <= 0 or height <= 0:
        return None
    return np.array([x, y, x + width, y + height]) - 0.5
