"""Draws from the training distribution: lens, range, attitude and position of a target, and the window around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs.geometry import R_from_euler, so3_exp
from sim_replay.airframes.invented import FLEET_ALONE, Invention, draw_invented
from sim_replay.render.distractors import Decoy
from sim_replay.render.environment import direction_ned
from sim_replay.render.flown import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, NONE_FLOWN, FlownShare
from sim_replay.render.frame import outline_px
from sim_replay.render.projection import extents_px, solid_vertices_m
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed
from sim_replay.render.sensor import Quality
from sim_replay.sample import AcquireView

Array = NDArray[np.float64]
Kind = Literal["track", "acquire"]
RANGE_M = (90.0, 550.0)
FOCAL_PX = (1200.0, 8000.0)
BOX_PX = (40.0, 400.0)  # longer side of the visible box on the frame, uniformly distributed
# Small, distant aircraft: this share is log-uniform in these sizes, as far as lenses allow; otherwise hardly any would
# be as small. The share is higher for windows without a target: a large non-target is recognisable by its shape.
SMALL_BOX_PX, SMALL_RANGE_M, SMALL_SHARE, SMALL_EMPTY_SHARE = (16.0, 130.0), (250.0, 550.0), 0.25, 0.7
WINDOW_SCALE = 1.8
ACQUIRE_DOWNSCALE = (1.5, 3.0)  # downscaling of the whole frame for the acquire stage
VISIBLE_SHARE_MIN = 0.35
DISTRACTORS_SHARE, DISTRACTORS_EMPTY_SHARE = 0.2, 0.5  # of windows with a target, and of those without
# Share of the windows without a target that show a bird, a wisp or another thing in its place. More often than not, a
# false detection in the whole frame is one of these, and the window around it shows it as large as a target.
DECOY_SHARE = 0.75
QUALITIES: tuple[Quality, ...] = get_args(Quality)
QUALITY_SHARES = (0.2, 0.65, 0.15)  # good, ordinary, poor


@dataclass(frozen=True)
class Window:
    """One window to render: the scene at render resolution and how it is processed."""

    scene: Scene
    kind: Kind
    size_px: int  # side of the finished window; the scene may be rendered smaller and then enlarged
    native_scale: float  # rendered pixels per native pixel, at most 1; geometric mean of both axes if they differ
    visible_share: float  # share of the target's outline inside the window; 0 without a target
    distractors: bool
    quality: Quality
    decoy: Decoy | None  # rendered pixels


def crop_K(K: Array, x0_px: float, y0_px: float, scale_x: float, scale_y: float) -> Array:
    """Intrinsics of a window whose first pixel is (x0, y0) of the frame, resized by the scales: c' = (c+0.5)s-0.5."""
    out = K.copy()
    out[0] *= scale_x
    out[1] *= scale_y
    out[0, 2] = (K[0, 2] - x0_px + 0.5) * scale_x - 0.5
    out[1, 2] = (K[1, 2] - y0_px + 0.5) * scale_y - 0.5
    return out


def _cross(a: Array, b: Array) -> Array:
    # np.cross takes a tenth of a millisecond per pair, and a window needs several.
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def looking_along(direction_ned: Array, roll_rad: float, ray_cam: Array) -> Array:
    """R_ned_cam of a camera whose pixel ray [3] points along a direction [3] that is not vertical, rolled about it."""
    z = direction_ned / np.sqrt(direction_ned @ direction_ned)
    x = np.array([-z[1], z[0], 0.0]) / np.hypot(z[0], z[1])
    upright = np.stack([x, _cross(z, x), z], axis=1)
    ray = ray_cam / np.sqrt(ray_cam @ ray_cam)
    axis = np.array([ray[1], -ray[0], 0.0])
    sine = float(np.hypot(ray[0], ray[1]))
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rolled = upright @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(rolled @ so3_exp(axis / sine * np.arctan2(sine, ray[2])) if sine > 1e-12 else rolled)


def _clipped_normal(rng: np.random.Generator, sigma_deg: float, limit_deg: float) -> float:
    return float(np.radians(np.clip(rng.normal(0.0, sigma_deg), -limit_deg, limit_deg)))


def _lens_for(
    rng: np.random.Generator, vertices_m: Array, R_ned_body: Array, los: Array, range_m: float, small: bool
) -> float:
    """Focal length, pixels, that shows the target in a size of BOX_PX or SMALL_BOX_PX, within the available lenses."""
    if not small and rng.random() < 0.16:
        return float(np.exp(rng.uniform(*np.log(FOCAL_PX))))
    across = vertices_m @ R_ned_body.T @ looking_along(los, 0.0, np.array([0.0, 0.0, 1.0]))
    size_m = np.ptp(across[:, :2], axis=0).max()
    if not small:
        return float(np.clip(rng.uniform(*BOX_PX) * range_m / size_m, *FOCAL_PX))
    low_px, high_px = np.clip(SMALL_BOX_PX, *(np.array(FOCAL_PX) * size_m / range_m))
    return float(np.exp(rng.uniform(np.log(low_px), np.log(high_px))) * range_m / size_m)


def frame_scene(
    rng: np.random.Generator,
    airframe_ids: Sequence[int],
    invention: Invention = FLEET_ALONE,
    small_share: float = SMALL_SHARE,
) -> Scene:
    """A whole 1920 x 1080 frame with one target, entirely inside it where the lens allows."""
    if invention.share > 0.0 and rng.random() < invention.share:
        airframe_id = draw_invented(rng, airframe_ids, invention.variants)
    else:
        airframe_id = int(rng.choice(np.asarray(airframe_ids)))
    vertices_m = solid_vertices_m(airframe_id)
    small = bool(rng.random() < small_share)
    if small:
        range_m = rng.uniform(*SMALL_RANGE_M)
    else:
        range_m = rng.uniform(*RANGE_M) if rng.random() < 0.5 else np.exp(rng.uniform(*np.log(RANGE_M)))
    R_ned_body = R_from_euler(_clipped_normal(rng, 25, 75), _clipped_normal(rng, 8, 30), rng.uniform(-np.pi, np.pi))
    los = direction_ned(_clipped_normal(rng, 13, 40), rng.uniform(-np.pi, np.pi))
    focal = _lens_for(rng, vertices_m, R_ned_body, los, float(range_m), small)
    anisotropy = np.exp(rng.normal(0.0, 0.003))
    fx, fy = focal * anisotropy, focal / anisotropy
    K = np.array(
        [
            [fx, 0, (FRAME_WIDTH_PX - 1) / 2 + rng.normal(0, 12)],
            [0, fy, (FRAME_HEIGHT_PX - 1) / 2 + rng.normal(0, 12)],
            [0, 0, 1],
        ]
    )
    reach_px = 0.55 * focal * np.linalg.norm(np.ptp(vertices_m, axis=0)) / range_m
    margin = np.minimum([reach_px, reach_px], [0.45 * FRAME_WIDTH_PX, 0.45 * FRAME_HEIGHT_PX])
    pixel = rng.uniform(margin, np.array([FRAME_WIDTH_PX, FRAME_HEIGHT_PX]) - margin)
    ray = np.linalg.solve(K, [*pixel, 1.0])
    R_ned_cam = looking_along(los, _clipped_normal(rng, 12, 40), ray)
    lowest_m = 60.0 + max(0.0, float(los[2]) * float(range_m))
    height_m = max(lowest_m, float(np.exp(rng.uniform(np.log(150.0), np.log(3500.0)))))
    t_ned_cam_m = np.array([rng.uniform(-4000, 4000), rng.uniform(-4000, 4000), -height_m])
    target = Target(airframe_id, int(rng.integers(2**31)), R_ned_body, t_ned_cam_m + range_m * los)
    camera = Camera(K, FRAME_WIDTH_PX, FRAME_HEIGHT_PX, R_ned_cam, t_ned_cam_m)
    return Scene(camera, (target,), environment_from_seed(int(rng.integers(2**31)), sight_ned=los))


def visible_share(pixels: Array, width_px: int, height_px: int) -> float:
    """Share of the area of the projected convex hull that lies inside the image."""
    hull = cv2.convexHull(pixels.astype(np.float32))
    edges = np.array([[-0.5, -0.5], [width_px - 0.5, -0.5], [width_px - 0.5, height_px - 0.5], [-0.5, height_px - 0.5]])
    area = cv2.contourArea(hull)
    inside, _ = cv2.intersectConvexConvex(hull, edges.astype(np.float32))
    return float(min(inside / area, 1.0)) if area > 1e-6 else 0.0


def _track_cut(rng: np.random.Generator, scene: Scene) -> tuple[float, float, float]:
    """(x0, y0, side) on the frame of a jittered window around the visible box."""
    box = extents_px(outline_px(scene.targets[0], scene.camera))
    assert box is not None, "a target at flying range lies ahead of the camera"
    low, high = np.maximum(box[:2], -0.5), np.minimum(box[2:], [FRAME_WIDTH_PX - 0.5, FRAME_HEIGHT_PX - 0.5])
    side = WINDOW_SCALE * float((high - low).max()) * float(np.exp(rng.uniform(np.log(0.75), np.log(1.33))))
    centre = 0.5 * (low + high) + side * rng.uniform(-0.15, 0.15, 2)
    return float(centre[0] - side / 2 + 0.5), float(centre[1] - side / 2 + 0.5), side


def _acquire_cut(rng: np.random.Generator, scene: Scene, size_px: int) -> tuple[float, float, float]:
    """(x0, y0, side) on the frame of a window of the downscaled frame, with the target at a random place in it."""
    side = size_px * float(np.exp(rng.uniform(*np.log(ACQUIRE_DOWNSCALE))))
    pixel = outline_px(scene.targets[0], scene.camera).mean(axis=0)
    corner = pixel - rng.uniform(0.0, 1.0, 2) * side
    # If the frame is larger than the window, the window lies inside the frame.
    limit = np.array([FRAME_WIDTH_PX, FRAME_HEIGHT_PX]) - side
    corner = np.where(limit > 0, np.clip(corner, 0.0, np.maximum(limit, 0.0)), corner)
    return float(corner[0]), float(corner[1]), side


def _decoy(rng: np.random.Generator, target: Target, camera: Camera) -> Decoy | None:
    """A non-target in place of the target, about as large."""
    box = extents_px(outline_px(target, camera))
    if box is None:
        return None
    left, top, right, bottom = box
    size = max(right - left, bottom - top)
    return Decoy((0.5 * (left + right), 0.5 * (top + bottom)), size * float(rng.uniform(0.8, 1.25)))


def draw_window(
    seed: int,
    index: int,
    size_px: int,
    airframe_ids: Sequence[int],
    acquire_share: float,
    empty_share: float,
    invention: Invention = FLEET_ALONE,
    acquire_view: AcquireView = "crop",
    flown: FlownShare = NONE_FLOWN,
) -> Window:
    """Window number `index`: a pure function of its arguments."""
    rng = np.random.default_rng([seed, index, size_px])
    kind: Kind = "acquire" if rng.random() < acquire_share else "track"
    empty = bool(rng.random() < empty_share)
    distractors = bool(rng.random() < (DISTRACTORS_EMPTY_SHARE if empty else DISTRACTORS_SHARE))
    if flown.frames is not None and rng.random() < flown.share:
        invented = rng.random() < invention.share
        frame = flown.frames.scene(rng, draw_invented(rng, airframe_ids, invention.variants) if invented else None)
    else:
        frame = frame_scene(rng, airframe_ids, invention, SMALL_EMPTY_SHARE if empty else SMALL_SHARE)
    if kind == "acquire" and acquire_view == "frame":
        rendered_px = size_px
        x0, y0, scale_x, scale_y = 0.0, 0.0, size_px / FRAME_WIDTH_PX, size_px / FRAME_HEIGHT_PX
    else:
        x0, y0, side = _acquire_cut(rng, frame, size_px) if kind == "acquire" else _track_cut(rng, frame)
        rendered_px = int(np.clip(round(side), 24, size_px))
        scale_x = scale_y = rendered_px / side
    camera = Camera(
        crop_K(frame.camera.K, x0, y0, scale_x, scale_y),
        rendered_px,
        rendered_px,
        frame.camera.R_ned_cam,
        frame.camera.t_ned_cam_m,
    )
    targets = () if empty else frame.targets
    share = visible_share(outline_px(targets[0], camera), rendered_px, rendered_px) if targets else 0.0
    if share == 0.0:
        targets = ()
    scene = Scene(camera, targets, frame.environment, int(rng.integers(2**31)), index)
    quality = QUALITIES[int(rng.choice(len(QUALITIES), p=QUALITY_SHARES))]
    decoy = _decoy(rng, frame.targets[0], camera) if empty and rng.random() < DECOY_SHARE else None
    native_scale = min(float(np.sqrt(scale_x * scale_y)), 1.0)
    return Window(scene, kind, size_px, native_scale, share, distractors, quality, decoy)
