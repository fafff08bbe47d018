"""Scene values as the shaders' uniforms, and the textures that they read."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes.livery import livery_from_seed
from sim_replay.render.projection import NO_DISTORTION, fold_radius2
from sim_replay.render.scene import Camera, Environment

Array = NDArray[np.float64]
PALETTE_ROWS = 16


def noise_texture(side: int = 512, seed: int = 20) -> NDArray[np.float16]:
    """Periodic noise [side, side, 4] in 0..1 by spectral synthesis: two cloud-like, one rough, one white channel."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(side)[:, None] * side, np.fft.rfftfreq(side)[None, :] * side
    radius = np.maximum(np.hypot(fx, fy), 1.0)
    channels = []
    # Low frequencies of the rough channel would make its period visible where it repeats across a landscape.
    for exponent, slowest in ((1.75, 1.0), (1.75, 1.0), (0.9, 9.0), (0.0, 1.0)):
        spectrum = np.fft.rfft2(rng.standard_normal((side, side))) / radius**exponent
        spectrum[np.hypot(fx, fy) < slowest] = 0.0
        field = np.fft.irfft2(spectrum, s=(side, side))
        channels.append(np.clip(0.5 + 0.18 * field / field.std(), 0.0, 1.0))
    return np.stack(channels, axis=-1).astype(np.float16)


def packed_environment(e: Environment) -> NDArray[np.float32]:
    """[11, 4], the rows that world.glsl and aircraft.frag refer to by number."""
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
        [e.veil, e.relief_m, e.near_cloud, 0.0],
        [*(e.horizon if e.horizon_away is None else e.horizon_away), 0.0],
    ]
    return np.asarray(rows, dtype=np.float32)


def packed_livery(seed: int) -> NDArray[np.float32]:
    """[19, 4], the rows that aircraft.frag refers to by number."""
    paint = livery_from_seed(seed)
    out = np.zeros((PALETTE_ROWS + 3, 4), np.float32)
    out[: len(paint.palette), :3], out[: len(paint.palette), 3] = paint.palette, paint.gloss
    out[PALETTE_ROWS] = [*paint.camouflage, paint.camouflage_share]
    out[PALETTE_ROWS + 1] = [*paint.marking, paint.tip_from]
    out[PALETTE_ROWS + 2] = [paint.band_x, paint.band_width, *paint.noise_offset]
    return out


def write_rows(uniform: Any, rows: NDArray[np.float32]) -> None:
    """Write the rows of an array uniform; drivers remove trailing rows that a shader never reads."""
    uniform.write(rows[: uniform.array_length].tobytes())


def columns(matrix: Array) -> bytes:
    """A matrix in OpenGL's memory layout (column-major)."""
    return np.ascontiguousarray(matrix.T, dtype=np.float32).tobytes()


def write_lens(program: Any, camera: Camera) -> None:
    """Write the camera's distortion."""
    k1, k2, p1, p2, k3 = camera.distortion or NO_DISTORTION
    program["lens"].value = (k1, k2, p1, p2)
    program["lens_end"].value = (k3, fold_radius2(camera.distortion) if camera.distortion else 1e6)


def sun_basis(sun_body: Array) -> Array:
    """[3, 3] with rows (across, across, towards the sun), orthonormal, in body axes."""
    x, y, z = (sun_body / np.linalg.norm(sun_body)).tolist()
    # Duff et al., Building an Orthonormal Basis, Revisited, JCGT 2017.
    sign = 1.0 if z >= 0.0 else -1.0
    a, b = -1.0 / (sign + z), -x * y / (sign + z)
    return np.array([[1.0 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y], [x, y, z]])
