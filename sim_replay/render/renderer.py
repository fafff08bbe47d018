"""Draws scenes as tiles of one framebuffer: aircraft supersampled, surroundings at pixel resolution, one readback.

Runs on whatever EGL offers: a GPU, or Mesa's llvmpipe. The context belongs to the process and thread that made it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import AIRFRAMES, Part
from sim_replay.airframes.livery import livery_from_seed
from sim_replay.render.scene import Camera, Environment, Scene, Target

Array = NDArray[np.float64]
NEAREST_VERTEX_M = 1.0


@dataclass(frozen=True)
class Rendered:
    """N images of H x W, colour with gamma 2, before any sensor."""

    image_bgr: NDArray[np.uint8]  # [N, H, W, 3]
    coverage: NDArray[np.uint8]  # [N, H, W], share of the pixel that is aircraft, 255: all
    coordinate: NDArray[np.float16]  # [N, H, W, 3], body point / model diameter; zeros where no aircraft is
    target: NDArray[np.uint8]  # [N, H, W], 0: none, k: the scene's k-th target


def solid_vertices_m(airframe_id: int) -> Array:
    """Vertices [V, 3] of the airframe without its propeller disc, which no mask holds."""
    mesh = AIRFRAMES[airframe_id].mesh()
    return mesh.vertices_m[mesh.part != Part.PROPELLER_DISC].astype(np.float64)


def project_px(points_m: Array, R_cam_body: Array, t_cam_body_m: Array, K: Array) -> Array:
    """Body points [V, 3] to pixels [V, 2]; NaN for points less than a metre ahead of the camera."""
    cam = points_m @ R_cam_body.T + t_cam_body_m
    depth = np.where(cam[:, 2:] < NEAREST_VERTEX_M, np.nan, cam[:, 2:])
    return (cam / depth) @ K.T[:, :2]


def extents_px(pixels: Array) -> tuple[float, float, float, float] | None:
    """(x0, y0, x1, y1) of projected points [V, 2], or None if any lies behind the camera."""
    if not np.all(np.isfinite(pixels)):
        return None
    (x0, y0), (x1, y1) = pixels.min(axis=0), pixels.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def noise_texture(side: int = 512, seed: int = 20) -> NDArray[np.float16]:
    """Periodic noise [side, side, 4] in 0..1 by spectral synthesis: two cloud-like, one rough, one white channel."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(side)[:, None] * side, np.fft.rfftfreq(side)[None, :] * side
    radius = np.maximum(np.hypot(fx, fy), 1.0)
    channels = []
    for exponent in (1.75, 1.75, 0.9, 0.0):
        spectrum = np.fft.rfft2(rng.standard_normal((side, side))) / radius**exponent
        spectrum[0, 0] = 0.0
        field = np.fft.irfft2(spectrum, s=(side, side))
        channels.append(np.clip(0.5 + 0.18 * field / field.std(), 0.0, 1.0))
    return np.stack(channels, axis=-1).astype(np.float16)


def clip_from_cam(K: Array, x0: int, y0: int, width: int, height: int, near_m: float, far_m: float) -> Array:
    """[4, 4] projection of a crop at (x0, y0): pixel centres at integers, row 0 first in the framebuffer."""
    fx, fy, skew, cx, cy = K[0, 0], K[1, 1], K[0, 1], K[0, 2] - x0, K[1, 2] - y0
    depth = far_m - near_m
    return np.array(
        [
            [2 * fx / width, 2 * skew / width, 2 * (cx + 0.5) / width - 1, 0],
            [0, 2 * fy / height, 2 * (cy + 0.5) / height - 1, 0],
            [0, 0, (far_m + near_m) / depth, -2 * far_m * near_m / depth],
            [0, 0, 1, 0],
        ]
    )


def _packed_environment(e: Environment) -> NDArray[np.float32]:
    rows = [
        [*e.sun_ned, e.cloud_threshold],
        [*e.sun_colour, e.cloud_softness],
        [*e.zenith, e.cloud_base_m],
        [*e.horizon, e.haze_per_m],
        [*e.cloud, e.cirrus],
        [*e.ground[0], float(e.ground_kind)],
        [*e.ground[1], e.field_m],
        [*e.ground[2], e.ground_turn_rad],
        [*e.noise_offset, e.cloud_scale_m, e.glow],
    ]
    return np.asarray(rows, dtype=np.float32)


def _packed_livery(seed: int) -> NDArray[np.float32]:
    paint = livery_from_seed(seed)
    rows = [[*rgb, paint.gloss] for rgb in paint.palette]
    rows += [
        [*paint.camouflage, paint.camouflage_share],
        [*paint.marking, paint.tip_from],
        [paint.band_x, paint.band_width, *paint.noise_offset],
    ]
    return np.asarray(rows, dtype=np.float32)


def _columns(matrix: Array) -> bytes:
    return np.ascontiguousarray(matrix.T, dtype=np.float32).tobytes()


def _write_rows(uniform: Any, rows: NDArray[np.float32]) -> None:
    # A driver drops the trailing rows that a shader never reads.
    uniform.write(rows[: uniform.array_length].tobytes())


class Renderer:
    """Tiles of at most width x height pixels, `columns` x `rows` of them in one draw."""

    def __init__(self, width_px: int, height_px: int, columns: int, rows: int) -> None:
        self.width_px, self.height_px, self.columns, self.rows = width_px, height_px, columns, rows
        # Twice the window: a target that fills it is sampled 2 x 2, a small one up to 4 x 4.
        self._fine_px = max(min(2 * max(width_px, height_px), 2048), width_px, height_px)
        self._context = moderngl.create_context(standalone=True, backend="egl")  # type: ignore[arg-type]
        self._aircraft = self._program("aircraft")
        self._surroundings = self._program("surroundings")
        self._fine = self._framebuffer(self._fine_px * columns, self._fine_px * rows, depth=True)
        self._image = self._framebuffer(width_px * columns, height_px * rows, depth=False)
        noise = noise_texture()
        texture = self._context.texture(noise.shape[1::-1], 4, noise.tobytes(), dtype="f2")
        texture.build_mipmaps()
        texture.use(0)
        for unit, attachment in enumerate(self._fine.color_attachments, start=1):
            attachment.use(unit)
        self._aircraft["noise"].value = 0
        for unit, name in enumerate(("noise", "aircraft_colour", "aircraft_coordinate")):
            self._surroundings[name].value = unit
        corners = self._context.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32).tobytes())
        self._screen = self._context.vertex_array(self._surroundings, [(corners, "2f", "in_corner")])
        self._meshes: dict[int, Any] = {}

    @property
    def capacity(self) -> int:
        """Scenes that one call of `draw` takes."""
        return self.columns * self.rows

    def _program(self, name: str) -> Any:
        folder = files("sim_replay").joinpath("shaders")
        vertex, fragment = (folder.joinpath(f"{name}.{kind}").read_text(encoding="utf-8") for kind in ("vert", "frag"))
        return self._context.program(vertex, fragment)

    def _framebuffer(self, width: int, height: int, depth: bool) -> Any:
        textures = [self._context.texture((width, height), 4, dtype=dtype) for dtype in ("f1", "f2")]
        for texture in textures:
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return self._context.framebuffer(textures, self._context.depth_renderbuffer((width, height)) if depth else None)

    def _mesh(self, airframe_id: int) -> Any:
        if airframe_id not in self._meshes:
            mesh = AIRFRAMES[airframe_id].mesh()
            vertex = np.hstack([mesh.vertices_m, mesh.normals, mesh.part[:, None].astype(np.float32)])
            # The nearly transparent disc goes last, so that it hides nothing it does not cover.
            order = np.argsort(mesh.part[mesh.faces[:, 0]] == Part.PROPELLER_DISC, kind="stable")
            self._meshes[airframe_id] = self._context.vertex_array(
                self._aircraft,
                [
                    (
                        self._context.buffer(vertex.astype(np.float32).tobytes()),
                        "3f 3f 1f",
                        "in_position",
                        "in_normal",
                        "in_part",
                    )
                ],
                self._context.buffer(mesh.faces[order].astype(np.int32).tobytes()),
            )
        return self._meshes[airframe_id]

    def draw(self, scenes: Sequence[Scene], first_tile: int = 0) -> Rendered:
        """Scenes in the tiles from `first_tile` on; pixels beyond a scene's own width and height are undefined.

        Interpolation rounds by a tile's place, so only the same tile gives the same coordinates to the last bit.
        """
        stop = first_tile + len(scenes)
        if stop > self.capacity:
            raise ValueError(f"{len(scenes)} scenes from tile {first_tile} do not fit {self.capacity} tiles")
        # A process may hold several renderers, each with a context of its own.
        with self._context:
            self._fine.use()
            self._fine.clear()
            self._context.enable_only(moderngl.DEPTH_TEST)
            crops = [self._draw_targets(k, scene) for k, scene in enumerate(scenes, first_tile)]
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

    def _crop(self, scene: Scene) -> tuple[int, int, int, int]:
        """Pixels that the targets may touch, clipped to the image; empty if there are none."""
        x0, y0, x1, y1 = scene.camera.width_px, scene.camera.height_px, 0, 0
        for target in scene.targets:
            vertices = AIRFRAMES[target.airframe_id].mesh().vertices_m.astype(np.float64)
            box = extents_px(project_px(vertices, *target.pose_in(scene.camera), scene.camera.K))
            if box is not None:
                low, high = np.floor(box[:2]).astype(int) - 1, np.ceil(box[2:]).astype(int) + 2
                x0, y0, x1, y1 = min(x0, low[0]), min(y0, low[1]), max(x1, high[0]), max(y1, high[1])
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, scene.camera.width_px), min(y1, scene.camera.height_px)
        return (int(x0), int(y0), int(x1), int(y1)) if x1 > x0 and y1 > y0 else (0, 0, 0, 0)

    def _draw_targets(self, tile: int, scene: Scene) -> tuple[tuple[int, int, int, int], int]:
        crop = self._crop(scene)
        width, height = crop[2] - crop[0], crop[3] - crop[1]
        if width == 0:
            return crop, 1
        samples = int(np.clip(self._fine_px // max(width, height), 1, 4))
        corner = (tile % self.columns * self._fine_px, tile // self.columns * self._fine_px)
        self._fine.viewport = (*corner, width * samples, height * samples)
        _write_rows(self._aircraft["environment"], _packed_environment(scene.environment))
        self._aircraft["corner"].value = corner
        # One depth range for all targets, so that the nearer hides the farther.
        reach = [(t.pose_in(scene.camera)[1][2], AIRFRAMES[t.airframe_id].diameter_m()) for t in scene.targets]
        ahead = [z - size >= NEAREST_VERTEX_M for z, size in reach]
        if not any(ahead):
            return crop, samples
        near_m = min(z - size for (z, size), drawn in zip(reach, ahead, strict=True) if drawn)
        far_m = max(z + size for z, size in reach)
        projection = clip_from_cam(scene.camera.K, crop[0], crop[1], width, height, near_m, far_m)
        for number, (target, drawn) in enumerate(zip(scene.targets, ahead, strict=True), start=1):
            if drawn:
                self._draw_target(target, scene.camera, projection, number)
        return crop, samples

    def _draw_target(self, target: Target, camera: Camera, projection: Array, number: int) -> None:
        airframe = AIRFRAMES[target.airframe_id]
        R_cam_body, t_cam_body_m = target.pose_in(camera)
        diameter_m = airframe.diameter_m()
        cam_from_body = np.eye(4)
        cam_from_body[:3, :3], cam_from_body[:3, 3] = R_cam_body, t_cam_body_m
        program = self._aircraft
        program["clip_from_body"].write(_columns(projection @ cam_from_body))
        program["ned_from_body"].write(_columns(target.R_ned_body))
        program["camera_body_m"].value = tuple(-R_cam_body.T @ t_cam_body_m)
        program["livery"].write(_packed_livery(target.livery_seed).tobytes())
        program["extent"].value = (1.0 / diameter_m, 0.5 * airframe.span_m, airframe.length_m, float(number))
        self._mesh(target.airframe_id).render()

    def _draw_surroundings(self, tile: int, scene: Scene, crop: tuple[int, int, int, int], samples: int) -> None:
        camera, program = scene.camera, self._surroundings
        column, row = tile % self.columns, tile // self.columns
        self._image.viewport = (column * self.width_px, row * self.height_px, camera.width_px, camera.height_px)
        _write_rows(program["environment"], _packed_environment(scene.environment))
        program["K"].value = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])
        program["ned_from_cam"].write(_columns(camera.R_ned_cam))
        program["camera_ned_m"].value = tuple(camera.t_ned_cam_m)
        program["tile"].value = (column * self.width_px, row * self.height_px, samples, 0)
        program["crop"].value = crop
        program["crop_at"].value = (column * self._fine_px, row * self._fine_px)
        self._screen.render()
