"""What an image of a scene can show: which parts of the world, which pixels of the targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import airframe_of
from sim_replay.render.projection import NEAREST_VERTEX_M, clip_from_cam, extents_px, project_px, vertices_m
from sim_replay.render.scene import Camera, Scene, Target, rays_ned

Array = NDArray[np.float64]
Crop = tuple[int, int, int, int]  # x0, y0, x1, y1, pixels
Parts = tuple[str, ...]  # names that world.glsl tests for
HILLS_M = 14_000.0  # as in world.glsl


def parts_of(scene: Scene, crop: Crop) -> Parts:
    """The parts of world.glsl that a crop of the scene's image can show."""
    camera, environment = scene.camera, scene.environment
    count = 2 if camera.distortion is None else 5
    u, v = np.meshgrid(np.linspace(crop[0] - 1, crop[2], count), np.linspace(crop[1] - 1, crop[3], count))
    down = rays_ned(np.stack([u.ravel(), v.ravel()], axis=1), camera)[:, 2]
    # A lens curves the horizon between the points that are tested.
    margin = 0.0 if camera.distortion is None else 0.02
    parts = []
    if down.min() <= margin:
        parts.append("SKY")
        if environment.relief_m > 0.0 and -down.max() < 1.01 * environment.relief_m / HILLS_M + margin:
            parts.append("HILLS")
    if down.max() >= -margin:
        parts.append(f"GROUND {environment.ground_kind}")
    present = {"VEIL": environment.veil > 0, "NEAR_CLOUD": environment.near_cloud > 0, "LENS": bool(camera.distortion)}
    return (*parts, *(name for name, shown in present.items() if shown))


def is_ahead(target: Target, camera: Camera) -> bool:
    """Whether the whole aircraft lies in front of the camera."""
    depth_m = target.pose_in(camera)[1][2]
    return bool(depth_m - airframe_of(target.airframe_id).diameter_m() >= NEAREST_VERTEX_M)


def diameter_px(target: Target, camera: Camera) -> float:
    """Pixels spanned by the target's diameter at its range, seen broadside."""
    range_m = np.linalg.norm(target.t_ned_body_m - camera.t_ned_cam_m)
    return float(camera.K[0, 0] * airframe_of(target.airframe_id).diameter_m() / range_m)


def crop_of(targets: Sequence[Target], camera: Camera) -> Crop:
    """Pixels that the targets may touch, clipped to the image; zeros if there are none."""
    x0, y0, x1, y1 = camera.width_px, camera.height_px, 0, 0
    for target in targets:
        points = vertices_m(target.airframe_id)
        box = extents_px(project_px(points, *target.pose_in(camera), camera.K, camera.distortion))
        if box is not None:
            # Under distortion an edge may curve beyond its end points.
            margin = 1 if camera.distortion is None else 6
            low, high = np.floor(box[:2]).astype(int) - margin, np.ceil(box[2:]).astype(int) + 1 + margin
            x0, y0, x1, y1 = min(x0, low[0]), min(y0, low[1]), max(x1, high[0]), max(y1, high[1])
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, camera.width_px), min(y1, camera.height_px)
    return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else (0, 0, 0, 0)


def depth_projection(targets: Sequence[Target], camera: Camera, crop: Crop) -> Array:
    """[4, 4] projection of a crop whose depth range contains exactly those targets."""
    reach = [(t.pose_in(camera)[1][2], airframe_of(t.airframe_id).diameter_m()) for t in targets]
    near_m, far_m = min(z - size for z, size in reach), max(z + size for z, size in reach)
    return clip_from_cam(camera.K, crop[0], crop[1], crop[2] - crop[0], crop[3] - crop[1], near_m, far_m)
