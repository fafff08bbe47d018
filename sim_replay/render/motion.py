"""Blur along the true image motion while the shutter is open."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.render.projection import distorted, project_px, solid_vertices_m
from sim_replay.render.scene import Camera, Target, rays_ned

Array = NDArray[np.float64]
FEWEST_PX = 0.7  # shorter motion is not visible in the lens's own blur
UNIFORM_PX = 1.0  # a motion field that varies less over the image is blurred with one kernel
FARTHEST_GROUND_M = 30_000.0
STEPS_MAX = 24


def motion_kernel(motion_px: tuple[float, float]) -> NDArray[np.float32] | None:
    """A line of that length and direction, centred, summing to 1; None if it is too short to be visible."""
    length = float(np.hypot(*motion_px))
    if length < FEWEST_PX:
        return None
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * half + 1):
        x, y = half + t * motion_px[0], half + t * motion_px[1]
        i, j = int(y), int(x)
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx]).astype(np.float32)
    return kernel / kernel.sum()


def _affine(start_px: Array, moved_px: Array) -> Array:
    """[2, 3] least-squares fit of the displacement [N, 2] over pixels [N, 2]; zeros if no motion is observed."""
    seen = np.isfinite(start_px).all(axis=1) & np.isfinite(moved_px).all(axis=1)
    if seen.sum() < 4:
        return np.zeros((2, 3))
    here = np.hstack([start_px[seen], np.ones((int(seen.sum()), 1))])
    # A slender aircraft hardly determines the gradient across it: small gradients are preferred.
    ridge = 1e-3 * np.diag([1.0, 1.0, 0.0])
    centre = np.append(here[:, :2].mean(axis=0), 0.0)
    local = here - centre
    fit = np.linalg.solve(local.T @ local + ridge, local.T @ (moved_px - start_px)[seen]).T
    fit[:, 2] -= fit[:, :2] @ centre[:2]
    return np.asarray(fit)


def target_motion(target: Target, camera: Camera, target_close: Target, camera_close: Camera) -> Array:
    """[2, 3] affine displacement of the target's image, pixels, from mid exposure to the shutter's close."""
    points = solid_vertices_m(target.airframe_id)
    points = points[:: max(len(points) // 60, 1)]
    start = project_px(points, *target.pose_in(camera), camera.K, camera.distortion)
    moved = project_px(points, *target_close.pose_in(camera_close), camera_close.K, camera_close.distortion)
    return _affine(start, moved)


def background_motion(camera: Camera, close: Camera) -> Array:
    """[2, 3] affine displacement of sky and ground, pixels, from mid exposure to the shutter's close."""
    u, v = np.meshgrid(np.linspace(0, camera.width_px - 1, 6), np.linspace(0, camera.height_px - 1, 5))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = rays_ned(pixels, camera)
    down = np.maximum(rays[:, 2], 1e-9)
    range_m = np.where(rays[:, 2] > 0, np.minimum(-camera.t_ned_cam_m[2] / down, FARTHEST_GROUND_M), FARTHEST_GROUND_M)
    moved = rays * range_m[:, None] + camera.t_ned_cam_m - close.t_ned_cam_m
    cam = moved @ close.R_ned_cam
    plane = cam[:, :2] / np.where(cam[:, 2:] > 0, cam[:, 2:], np.nan)
    if close.distortion is not None:
        plane = distorted(plane, close.distortion)
    return _affine(pixels, plane @ close.K[:2, :2].T + close.K[:2, 2])


def longest_px(field: Array, x0: int, y0: int, width: int, height: int) -> float:
    """Longest motion within a crop, pixels, over the whole exposure."""
    return float(2.0 * np.linalg.norm(_at_corners(field, x0, y0, width, height), axis=1).max())


def _at_corners(field: Array, x0: int, y0: int, width: int, height: int) -> Array:
    corners = [[x, y, 1.0] for x in (x0, x0 + width - 1) for y in (y0, y0 + height - 1)]
    return np.asarray(corners) @ field.T


def blurred(image: NDArray[Any], field: Array, x0: int = 0, y0: int = 0) -> NDArray[Any]:
    """The crop at (x0, y0) blurred along `field` [2, 3], which is half of the exposure's motion; same type and size."""
    height, width = image.shape[:2]
    moves = _at_corners(field, x0, y0, width, height)
    if longest_px(field, x0, y0, width, height) < FEWEST_PX:
        return image
    if 2.0 * np.linalg.norm(moves - moves.mean(axis=0), axis=1).max() < UNIFORM_PX:
        mean = 2.0 * moves.mean(axis=0)
        kernel = motion_kernel((float(mean[0]), float(mean[1])))
        return image if kernel is None else cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    steps = min(int(np.ceil(longest_px(field, x0, y0, width, height))) + 1, STEPS_MAX)
    total = np.zeros(image.shape, np.float32)
    local = field.copy()
    local[:, 2] = field @ [x0, y0, 1.0]
    for share in np.linspace(-1.0, 1.0, steps):
        warp = np.eye(2, 3) + share * local
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.accumulate(
            cv2.warpAffine(image, warp, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE), total
        )
    total /= steps
    return total if image.dtype == np.float32 else np.rint(total).astype(image.dtype)
