"""Whole frames: surroundings, aircraft and what occludes them in layers, exposed by a camera, with exact labels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.render.distractors import Sprite, sprites
from sim_replay.render.motion import background_motion, blurred, longest_px, target_motion
from sim_replay.render.projection import extents_px, fine_solid_vertices_m, project_px, solid_vertices_m
from sim_replay.render.renderer import Layer, Renderer
from sim_replay.render.scene import Camera, Scene, Target
from sim_replay.render.sensor import Sensor, exposed_frame, sensor_from

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]
MASK_COVERAGE_MIN = 64  # of 255: a quarter of the pixel, so that thin wings stay in the mask
HIDDEN_FROM = 128  # of 255: cloud or a bird that blocks half of a pixel's light occludes what is behind it


@dataclass(frozen=True)
class SeenTarget:
    """One target's appearance in a frame. Box edges lie half a pixel outside the outermost pixel centres."""

    mask_visib: NDArray[np.bool_]  # [H, W]
    mask: NDArray[np.bool_]  # [H, W], the silhouette inside the image without occlusion
    box_visible_xyxy_px: Box | None  # None if nothing of it is visible
    box_whole_xyxy_px: Box | None  # of the whole outline, also beyond the image; None behind the camera
    visible_px: int  # pixels of mask_visib
    whole_px: int  # pixels of mask
    origin_px: Array  # [2], the projected model origin; NaN behind the camera


@dataclass(frozen=True)
class RenderedFrame:
    """An image and its targets, in the scene's order."""

    image_bgr: NDArray[np.uint8]  # [H, W, 3]
    targets: tuple[SeenTarget, ...]


def outline_px(target: Target, camera: Camera) -> Array:
    """Projected vertices [V, 2] of the target without its propeller disc, dense enough to follow lens distortion."""
    points = (solid_vertices_m if camera.distortion is None else fine_solid_vertices_m)(target.airframe_id)
    return project_px(points, *target.pose_in(camera), camera.K, camera.distortion)


def mask_extents_px(mask: NDArray[np.bool_]) -> Box | None:
    """(x0, y0, x1, y1), half a pixel outside the outermost pixels of a mask [H, W]; None if it is empty."""
    x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return (x[0] - 0.5, y[0] - 0.5, x[-1] + 0.5, y[-1] + 0.5) if len(x) else None


def is_inside(box: Box | None, width_px: int, height_px: int) -> bool:
    """Whether a box lies within the image."""
    return box is not None and min(box[:2]) >= -0.5 and box[2] <= width_px - 0.5 and box[3] <= height_px - 0.5


_renderers: dict[tuple[int, int], Renderer] = {}


def frame_renderer(width_px: int, height_px: int) -> Renderer:
    """This process's renderer for frames of that size, created on first use."""
    if (width_px, height_px) not in _renderers:
        _renderers[(width_px, height_px)] = Renderer(width_px, height_px, 1, 1)
    return _renderers[(width_px, height_px)]


def render_frame(scene: Scene, sensor: Sensor | None = None) -> RenderedFrame:
    """A whole frame with every target labelled. Raises BackdropError.

    Sky, ground and camera (unless given) depend on the scene's values alone, so frames of a sequence that share an
    environment and a sensor seed show the same world; noise, exposure drift and distractors follow `frame_index`. If
    the scene has a `shutter_close`, the image is blurred by that motion instead of the sensor's `motion_px`.
    """
    camera = scene.camera
    renderer = frame_renderer(camera.width_px, camera.height_px)
    image, cloud = renderer.surroundings(scene)
    birds = sprites(scene)
    for bird in birds:
        if not bird.before:
            _put_sprite(image, bird)
    if scene.shutter_close is not None:
        image = blurred(image, background_motion(camera, scene.shutter_close[0]))
    layers = [renderer.layer(scene, k) for k in range(len(scene.targets))]
    far_to_near = sorted(range(len(layers)), key=lambda k: -scene.targets[k].pose_in(camera)[1][2])
    for k in far_to_near:
        layer = layers[k]
        if layer is not None:
            _put_aircraft(image, layer, _motion_of(scene, k))
    hidden = cloud >= HIDDEN_FROM
    for bird in birds:
        if bird.before:
            _put_sprite(image, bird)
            hidden = _with_sprite(hidden, bird)
    if scene.environment.near_cloud > 0.0:
        image = _veiled(image, cloud, scene)
    seen = _labels(scene, layers, far_to_near, hidden)
    chosen = sensor or sensor_from(np.random.default_rng([scene.sensor_seed, 1]))
    moved = scene.shutter_close is not None
    return RenderedFrame(exposed_frame(image, chosen, scene.sensor_seed, scene.frame_index, moved), seen)


def _motion_of(scene: Scene, index: int) -> Array | None:
    if scene.shutter_close is None:
        return None
    camera_close, targets_close = scene.shutter_close
    return target_motion(scene.targets[index], scene.camera, targets_close[index], camera_close)


def _put_aircraft(image_bgr: NDArray[np.uint8], layer: Layer, motion: Array | None) -> None:
    """Composite an aircraft onto the image [H, W, 3] in place, blurred along its own motion."""
    colour = np.square(layer.colour_bgr.astype(np.float32) / np.float32(255))
    cover, x0, y0 = layer.cover, layer.x0_px, layer.y0_px
    if motion is not None:
        height, width = cover.shape
        pad = int(np.ceil(longest_px(motion, x0, y0, width, height) / 2)) + 1
        stack = np.dstack([colour, cover])
        stack = cv2.copyMakeBorder(stack, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=(0, 0, 0, 0))
        stack = blurred(stack, motion, x0 - pad, y0 - pad)
        left, top = max(pad - x0, 0), max(pad - y0, 0)
        x0, y0 = max(x0 - pad, 0), max(y0 - pad, 0)
        stack = stack[top : top + image_bgr.shape[0] - y0, left : left + image_bgr.shape[1] - x0]
        colour, cover = stack[..., :3], stack[..., 3]
    height, width = cover.shape
    place = image_bgr[y0 : y0 + height, x0 : x0 + width]
    behind = np.square(place.astype(np.float32) / np.float32(255))
    place[:] = np.rint(np.sqrt(np.clip(colour + (1.0 - cover[..., None]) * behind, 0.0, 1.0)) * 255.0)


def _put_sprite(image_bgr: NDArray[np.uint8], sprite: Sprite) -> None:
    height, width = sprite.alpha.shape
    place = image_bgr[sprite.y0_px : sprite.y0_px + height, sprite.x0_px : sprite.x0_px + width]
    place[:] = np.rint(place + sprite.alpha[..., None] * (sprite.level - place.astype(np.float32)))


def _with_sprite(hidden: NDArray[np.bool_], sprite: Sprite) -> NDArray[np.bool_]:
    height, width = sprite.alpha.shape
    place = hidden[sprite.y0_px : sprite.y0_px + height, sprite.x0_px : sprite.x0_px + width]
    place |= sprite.alpha * 255 >= HIDDEN_FROM
    return hidden


def _veiled(image_bgr: NDArray[np.uint8], cloud: NDArray[np.uint8], scene: Scene) -> NDArray[np.uint8]:
    environment = scene.environment
    colour = 0.5 * (environment.cloud + environment.horizon)[::-1]
    share = (cloud.astype(np.float32) / np.float32(255))[..., None]
    linear = np.square(image_bgr.astype(np.float32) / np.float32(255))
    mixed = linear + share * (colour.astype(np.float32) - linear)
    return np.rint(np.sqrt(np.clip(mixed, 0.0, 1.0)) * 255.0).astype(np.uint8)


def _labels(
    scene: Scene, layers: list[Layer | None], far_to_near: list[int], hidden: NDArray[np.bool_]
) -> tuple[SeenTarget, ...]:
    seen: dict[int, SeenTarget] = {}
    taken = hidden.copy()
    for k in reversed(far_to_near):
        mask = np.zeros(hidden.shape, np.bool_)
        layer = layers[k]
        if layer is not None:
            height, width = layer.solid.shape
            at = np.s_[layer.y0_px : layer.y0_px + height, layer.x0_px : layer.x0_px + width]
            mask[at] = layer.solid >= MASK_COVERAGE_MIN
        visible = mask & ~taken
        taken |= mask
        seen[k] = _label(scene.targets[k], scene.camera, mask, visible)
    return tuple(seen[k] for k in range(len(layers)))


def _label(target: Target, camera: Camera, mask: NDArray[np.bool_], visible: NDArray[np.bool_]) -> SeenTarget:
    whole_px, visible_px = int(mask.sum()), int(visible.sum())
    outline = extents_px(outline_px(target, camera))
    box = mask_extents_px(visible)
    # A target that is neither truncated nor occluded has its outline's box, exact to a fraction of a pixel.
    if box is not None and visible_px == whole_px and is_inside(outline, camera.width_px, camera.height_px):
        box = outline
    origin = project_px(np.zeros((1, 3)), *target.pose_in(camera), camera.K, camera.distortion)[0]
    return SeenTarget(visible, mask, box, outline, visible_px, whole_px, origin)
