"""Draws scenes with OpenGL: aircraft supersampled, surroundings at pixel resolution.

Windows are drawn many at a time as tiles of one framebuffer. A whole frame is drawn in layers, each target alone, so
that occlusions are known. Runs on any EGL: a GPU, or Mesa's llvmpipe. The context belongs to the process and thread
that created it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import Mesh, Part, airframe_of
from sim_replay.render.backdrop import Backdrop, load_backdrop
from sim_replay.render.packing import (
    columns,
    noise_texture,
    packed_environment,
    packed_livery,
    sun_basis,
    write_lens,
    write_rows,
)
from sim_replay.render.projection import fine_mesh
from sim_replay.render.scene import Scene, Target
from sim_replay.render.view import Crop, Parts, crop_of, depth_projection, diameter_px, is_ahead, parts_of

Array = NDArray[np.float64]
SUN_THAT_CASTS_SHADOW = 0.2
SHADOWED_FROM_PX = 40.0  # of diameter: shadows that a smaller aircraft casts on itself are below the resolution
PIECES = (8, 6)  # of a whole frame, across and down
_NOISE_UNIT, _COLOUR_UNIT, _COORDINATE_UNIT, _SHADOW_UNIT, _SKY_UNIT, _BACKDROP_UNIT = range(6)


@dataclass(frozen=True)
class Rendered:
    """N images of H x W, colour with gamma 2, before the sensor model."""

    image_bgr: NDArray[np.uint8]  # [N, H, W, 3]
    coverage: NDArray[np.uint8]  # [N, H, W], share of the pixel that is aircraft, 255: all
    coordinate: NDArray[np.float16]  # [N, H, W, 3], body point / model diameter; zeros outside aircraft
    target: NDArray[np.uint8]  # [N, H, W], 0: none, k: the scene's k-th target


@dataclass(frozen=True)
class Layer:
    """One aircraft alone, without occlusion, in a crop of the frame."""

    x0_px: int
    y0_px: int
    colour_bgr: NDArray[np.uint8]  # [h, w, 3], gamma 2, premultiplied by the cover
    cover: NDArray[np.float32]  # [h, w], share of the pixel's light that it blocks, propeller disc included
    solid: NDArray[np.uint8]  # [h, w], share of the pixel that is aircraft, 255: all; without the propeller disc


@dataclass(frozen=True)
class _GpuMesh:
    aircraft: Any  # vertex array with normals and parts
    shadow: Any  # vertex array with positions alone
    solid_indices: int  # indices of faces that cast shadow; the propeller disc comes after them
    radius_m: float  # of the sphere about the origin that contains it


class Renderer:
    """Tiles of at most width x height pixels, `columns` x `rows` of them in one draw."""

    def __init__(self, width_px: int, height_px: int, columns: int, rows: int) -> None:
        self.width_px, self.height_px, self.columns, self.rows = width_px, height_px, columns, rows
        # Twice the window: a target that fills it is sampled 2 x 2, a small one up to 4 x 4.
        self._fine_px = max(min(2 * max(width_px, height_px), 2048), width_px, height_px)
        self._shadow_px = min(self._fine_px, 1024)
        self._context = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]
        self._aircraft = self._program("aircraft.vert", "aircraft.frag")
        self._shadow = self._program("shadow.vert", "shadow.frag")
        self._fine = self._framebuffer(self._fine_px * columns, self._fine_px * rows, depth=True)
        self._image = self._framebuffer(width_px * columns, height_px * rows, depth=False)
        shadow_size = (self._shadow_px * columns, self._shadow_px * rows * (2 if self.capacity > 1 else 1))
        self._shadow_map = self._context.depth_texture(shadow_size)
        self._shadow_map.compare_func = "<="
        self._shadow_map.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._shadow_buffer = self._context.framebuffer(depth_attachment=self._shadow_map)
        noise = noise_texture()
        texture = self._context.texture(noise.shape[1::-1], 4, noise.tobytes(), dtype="f2")
        texture.build_mipmaps()
        texture.use(_NOISE_UNIT)
        for unit, attachment in zip((_COLOUR_UNIT, _COORDINATE_UNIT), self._fine.color_attachments, strict=True):
            attachment.use(unit)
        self._shadow_map.use(_SHADOW_UNIT)
        self._aircraft["noise"].value, self._aircraft["shadows"].value = _NOISE_UNIT, _SHADOW_UNIT
        self._corners = self._context.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32).tobytes())
        self._screens: dict[tuple[str, Parts | None], tuple[Any, Any]] = {}
        self._meshes: dict[tuple[int, bool], _GpuMesh] = {}
        self._sky: Any = None
        self._backdrop: tuple[Backdrop, Any] | None = None

    @property
    def capacity(self) -> int:
        """Number of scenes in one call of `draw`."""
        return self.columns * self.rows

    # --- programs, buffers, meshes ------------------------------------------------------------------------------------

    def _program(self, vertex: str, fragment: str, prelude: str = "") -> Any:
        folder = files("sim_replay").joinpath("shaders")
        texts = [folder.joinpath(name).read_text(encoding="utf-8") for name in (vertex, fragment)]
        return self._context.program(texts[0], prelude + texts[1])

    def _screen(self, name: str, parts: Parts | None = None) -> tuple[Any, Any]:
        """(program, vertex array) of a fragment shader that covers its viewport, with these parts of the world."""
        if (name, parts) not in self._screens:
            prelude = ""
            if parts is not None:
                text = files("sim_replay").joinpath("shaders", "world.glsl").read_text(encoding="utf-8")
                prelude = "\n".join(["#version 330 core", *(f"#define {part}" for part in parts), text])
            program = self._program("surroundings.vert", f"{name}.frag", prelude)
            units = {
                "noise": _NOISE_UNIT,
                "aircraft_colour": _COLOUR_UNIT,
                "aircraft_coordinate": _COORDINATE_UNIT,
                "far_sky": _SKY_UNIT,
                "backdrop": _BACKDROP_UNIT,
            }
            for uniform in set(units) & set(program):
                program[uniform].value = units[uniform]
            screen = self._context.vertex_array(program, [(self._corners, "2f", "in_corner")])
            self._screens[(name, parts)] = program, screen
        return self._screens[(name, parts)]

    def _framebuffer(self, width: int, height: int, depth: bool) -> Any:
        textures = [self._context.texture((width, height), 4, dtype=dtype) for dtype in ("f1", "f2")]
        for texture in textures:
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return self._context.framebuffer(textures, self._context.depth_renderbuffer((width, height)) if depth else None)

    def _mesh(self, airframe_id: int, fine: bool) -> _GpuMesh:
        key = (airframe_id, fine)
        if key not in self._meshes:
            mesh: Mesh = fine_mesh(airframe_id) if fine else airframe_of(airframe_id).mesh()
            vertex = np.hstack([mesh.vertices_m, mesh.normals, mesh.part[:, None].astype(np.float32)])
            # The nearly transparent disc is drawn last, so that it does not hide what is behind it.
            disc = mesh.part[mesh.faces[:, 0]] == Part.PROPELLER_DISC
            faces = mesh.faces[np.argsort(disc, kind="stable")].astype(np.int32)
            vertices = self._context.buffer(vertex.astype(np.float32).tobytes())
            indices = self._context.buffer(faces.tobytes())
            layout = (vertices, "3f 3f 1f", "in_position", "in_normal", "in_part")
            self._meshes[key] = _GpuMesh(
                self._context.vertex_array(self._aircraft, [layout], indices),
                self._context.vertex_array(self._shadow, [(vertices, "3f 16x", "in_position")], indices),
                3 * int((~disc).sum()),
                float(np.linalg.norm(mesh.vertices_m, axis=1).max()),
            )
        return self._meshes[key]

    # --- windows ------------------------------------------------------------------------------------------------------

    def draw(self, scenes: Sequence[Scene], first_tile: int = 0) -> Rendered:
        """Scenes in the tiles from `first_tile` on; pixels beyond a scene's own width and height are undefined.

        Interpolation rounds depending on a tile's place, so only the same tile gives bit-identical coordinates.
        """
        stop = first_tile + len(scenes)
        if stop > self.capacity:
            raise ValueError(f"{len(scenes)} scenes from tile {first_tile} do not fit {self.capacity} tiles")
        # A process may have several renderers, each with its own context.
        with self._context:
            slots = self._draw_shadows(scenes)
            self._fine.use()
            self._fine.clear()
            self._context.enable_only(moderngl.DEPTH_TEST)
            crops = [self._draw_targets(first_tile + k, scene, slots, k) for k, scene in enumerate(scenes)]
            self._image.use()
            self._context.enable_only(moderngl.NOTHING)
            for k, (scene, (crop, samples)) in enumerate(zip(scenes, crops, strict=True), first_tile):
                self._draw_surroundings(k, scene, crop, samples)
            colour = self._tiles(0, "f1", np.dtype(np.uint8))[first_tile:stop]
            place = self._tiles(1, "f2", np.dtype(np.float16))[first_tile:stop]
        return Rendered(colour[..., :3], colour[..., 3], place[..., :3], (place[..., 3] + 0.5).astype(np.uint8))

    def _tiles(self, attachment: int, kind: str, dtype: np.dtype[Any]) -> NDArray[Any]:
        raw = self._image.read(components=4, attachment=attachment, dtype=kind)
        grid = np.frombuffer(raw, dtype=dtype).reshape(self.rows, self.height_px, self.columns, self.width_px, 4)
        return grid.swapaxes(1, 2).reshape(self.capacity, self.height_px, self.width_px, 4)

    def _draw_targets(self, tile: int, scene: Scene, slots: dict[tuple[int, int], int], order: int) -> tuple[Crop, int]:
        crop = crop_of(scene.targets, scene.camera)
        width, height = crop[2] - crop[0], crop[3] - crop[1]
        drawn = [t for t in scene.targets if is_ahead(t, scene.camera)]
        if width == 0 or not drawn:
            return crop, 1
        samples = int(np.clip(self._fine_px // max(width, height), 1, 4))
        corner = (tile % self.columns * self._fine_px, tile // self.columns * self._fine_px)
        self._fine.viewport = (*corner, width * samples, height * samples)
        # One depth range for all targets, so that the nearer occludes the farther.
        projection = depth_projection(drawn, scene.camera, crop)
        for number, target in enumerate(scene.targets, start=1):
            if is_ahead(target, scene.camera):
                self._draw_target(target, scene, projection, number, slots.get((order, number)), corner)
        return crop, samples

    def _draw_surroundings(self, tile: int, scene: Scene, crop: Crop, samples: int) -> None:
        whole = (0, 0, scene.camera.width_px, scene.camera.height_px)
        program, screen = self._screen("surroundings", parts_of(scene, whole))
        column, row = tile % self.columns, tile // self.columns
        self._image.viewport = (
            column * self.width_px,
            row * self.height_px,
            scene.camera.width_px,
            scene.camera.height_px,
        )
        _write_world(program, scene)
        program["tile"].value = (column * self.width_px, row * self.height_px, samples, 0)
        program["crop"].value = crop
        program["crop_at"].value = (column * self._fine_px, row * self._fine_px)
        screen.render()

    # --- whole frames -------------------------------------------------------------------------------------------------

    def surroundings(self, scene: Scene) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """(BGR [H, W, 3] with gamma 2, without any aircraft; opacity of near cloud [H, W], 255: opaque).

        The scene's camera must be as large as a tile. Raises BackdropError if its backdrop cannot be read.
        """
        backdrop = load_backdrop(scene.backdrop) if scene.backdrop else None
        if backdrop is not None:
            frame: Crop = (0, 0, self.width_px, self.height_px)
            pieces = [
                (frame, (*(p for p in parts_of(scene, frame) if p in ("LENS", "VEIL", "NEAR_CLOUD")), "BACKDROP"))
            ]
        else:
            pieces = [(piece, parts_of(scene, piece)) for piece in self._pieces()]
        with self._context:
            self._context.enable_only(moderngl.NOTHING)
            if any("SKY" in parts for _, parts in pieces):
                self._draw_far_sky(scene)
            self._image.use()
            self._image.viewport = (0, 0, self.width_px, self.height_px)
            for (x0, y0, x1, y1), parts in pieces:
                program, screen = self._screen("frame", parts)
                self._image.scissor = (x0, y0, x1 - x0, y1 - y0)
                _write_world(program, scene)
                if backdrop is not None:
                    program["backdrop_map"].value = self._use_backdrop(backdrop, scene)
                screen.render()
            self._image.scissor = None
            raw = self._image.read((0, 0, self.width_px, self.height_px), components=4, dtype="f1")
        pixels = np.frombuffer(raw, np.uint8).reshape(self.height_px, self.width_px, 4)
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR), np.uint8), pixels[..., 3]

    def _pieces(self) -> list[Crop]:
        """The frame in pieces, most of which show only sky or only ground."""
        x = np.linspace(0, self.width_px, PIECES[0] + 1).astype(int).tolist()
        y = np.linspace(0, self.height_px, PIECES[1] + 1).astype(int).tolist()
        return [(x0, y0, x1, y1) for y0, y1 in pairwise(y) for x0, x1 in pairwise(x)]

    def _draw_far_sky(self, scene: Scene) -> None:
        if self._sky is None:
            texture = self._context.texture(((self.width_px + 1) // 2, (self.height_px + 1) // 2), 4, dtype="f2")
            texture.repeat_x = texture.repeat_y = False
            texture.use(_SKY_UNIT)
            self._sky = self._context.framebuffer([texture])
        program, screen = self._screen("far_sky", ("LENS",) if scene.camera.distortion else ())
        self._sky.use()
        _write_world(program, scene)
        screen.render()

    def _use_backdrop(self, backdrop: Backdrop, scene: Scene) -> tuple[float, float, float]:
        if self._backdrop is None or self._backdrop[0] is not backdrop:
            if self._backdrop is not None:
                self._backdrop[1].release()
            height, width = backdrop.image_rgb.shape[:2]
            texture = self._context.texture((width, height), 3, backdrop.image_rgb.tobytes(), alignment=1)
            texture.build_mipmaps()
            texture.use(_BACKDROP_UNIT)
            self._backdrop = backdrop, texture
        return backdrop.map_for(scene.camera, scene.sensor_seed)

    def layer(self, scene: Scene, index: int) -> Layer | None:
        """The scene's target of that index alone; None if no pixel of the image can show it."""
        target, camera = scene.targets[index], scene.camera
        crop = crop_of((target,), camera)
        width, height = crop[2] - crop[0], crop[3] - crop[1]
        if width == 0 or not is_ahead(target, camera):
            return None
        samples = int(np.clip(self._fine_px // max(width, height), 1, 4))
        with self._context:
            slots = self._draw_shadows([Scene(camera, (target,), scene.environment)])
            self._fine.use()
            self._fine.viewport = (0, 0, width * samples, height * samples)
            self._fine.clear(viewport=self._fine.viewport)
            self._context.enable_only(moderngl.DEPTH_TEST)
            projection = depth_projection([target], camera, crop)
            self._draw_target(target, scene, projection, 1, slots.get((0, 1)), (0, 0))
            self._context.enable_only(moderngl.NOTHING)
            program, screen = self._screen("layer")
            program["samples"].value = (samples, 0)
            self._image.use()
            self._image.viewport = (0, 0, width, height)
            screen.render()
            colour = self._image.read((0, 0, width, height), components=4, dtype="f1")
            cover = self._image.read((0, 0, width, height), components=1, attachment=1, dtype="f2")
        pixels = np.frombuffer(colour, np.uint8).reshape(height, width, 4)
        share = np.frombuffer(cover, np.float16).reshape(height, width).astype(np.float32)
        return Layer(crop[0], crop[1], pixels[..., :3], share, pixels[..., 3])

    # --- aircraft -----------------------------------------------------------------------------------------------------

    def _draw_shadows(self, scenes: Sequence[Scene]) -> dict[tuple[int, int], int]:
        """Each target as seen from the sun, in a slot of the atlas; returns slots by (scene, target number)."""
        casting = [
            ((order, number), target, scene.environment.sun_ned)
            for order, scene in enumerate(scenes)
            if scene.environment.sun_colour.max() > SUN_THAT_CASTS_SHADOW
            for number, target in enumerate(scene.targets, start=1)
            if is_ahead(target, scene.camera) and diameter_px(target, scene.camera) >= SHADOWED_FROM_PX
        ]
        if not casting:
            return {}
        self._shadow_buffer.use()
        self._shadow_buffer.viewport = (0, 0, *self._shadow_map.size)
        self._shadow_buffer.clear()
        self._context.enable_only(moderngl.DEPTH_TEST)
        slots = {}
        across = self._shadow_map.width // self._shadow_px
        room = across * (self._shadow_map.height // self._shadow_px)
        for slot, (key, target, sun_ned) in enumerate(casting[:room]):
            at = (slot % across * self._shadow_px, slot // across * self._shadow_px)
            self._shadow_buffer.viewport = (*at, self._shadow_px, self._shadow_px)
            mesh = self._mesh(target.airframe_id, fine=False)
            clip = np.eye(4)
            clip[:3, :3] = sun_basis(target.R_ned_body.T @ sun_ned) / mesh.radius_m * np.array([[1.0], [1.0], [-1.0]])
            self._shadow["clip_from_body"].write(columns(clip))
            mesh.shadow.render(vertices=mesh.solid_indices)
            slots[key] = slot
        return slots

    def _write_shadow(self, target: Target, sun_ned: Array, slot: int | None, radius_m: float) -> None:
        program = self._aircraft
        program["shadowed"].value = float(slot is not None)
        if slot is None:
            return
        basis = sun_basis(target.R_ned_body.T @ sun_ned)
        size = np.array(self._shadow_map.size, dtype=np.float64)
        across = self._shadow_map.width // self._shadow_px
        atlas = np.eye(4)
        for axis, place in enumerate((slot % across, slot // across)):
            atlas[axis, :3] = 0.5 * basis[axis] / radius_m * self._shadow_px / size[axis]
            atlas[axis, 3] = (place + 0.5) * self._shadow_px / size[axis]
        atlas[2, :3], atlas[2, 3] = -0.5 * basis[2] / radius_m, 0.5 - 1e-4
        program["shadow_from_body"].write(columns(atlas))
        # With an offset of two texels, a lit surface does not shadow itself.
        program["sun_body"].value = (*basis[2], 4.0 * radius_m / self._shadow_px)

    def _draw_target(
        self, target: Target, scene: Scene, projection: Array, number: int, slot: int | None, corner: tuple[int, int]
    ) -> None:
        airframe, camera, program = airframe_of(target.airframe_id), scene.camera, self._aircraft
        mesh = self._mesh(target.airframe_id, fine=camera.distortion is not None)
        R_cam_body, t_cam_body_m = target.pose_in(camera)
        cam_from_body = np.eye(4)
        cam_from_body[:3, :3], cam_from_body[:3, 3] = R_cam_body, t_cam_body_m
        program["cam_from_body"].write(columns(cam_from_body))
        program["clip_from_cam"].write(columns(projection))
        program["ned_from_body"].write(columns(target.R_ned_body))
        program["camera_body_m"].value = tuple(-R_cam_body.T @ t_cam_body_m)
        program["corner"].value = corner
        program["extent"].value = (1.0 / airframe.diameter_m(), 0.5 * airframe.span_m, airframe.length_m, float(number))
        write_rows(program["environment"], packed_environment(scene.environment))
        write_rows(program["livery"], packed_livery(target.livery_seed))
        write_lens(program, camera)
        self._write_shadow(target, scene.environment.sun_ned, slot, mesh.radius_m)
        mesh.aircraft.render()


def _write_world(program: Any, scene: Scene) -> None:
    camera = scene.camera
    # Programs without some parts of the world lack their uniforms.
    used = set(program)
    if "K" in used:
        program["K"].value = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])
    if "ned_from_cam" in used:
        program["ned_from_cam"].write(columns(camera.R_ned_cam))
    if "camera_ned_m" in used:
        program["camera_ned_m"].value = tuple(camera.t_ned_cam_m)
    if "environment" in used:
        write_rows(program["environment"], packed_environment(scene.environment))
    if "lens" in used:
        write_lens(program, camera)
