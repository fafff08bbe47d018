"""What is to be drawn: a camera, targets and the surroundings, as plain values in local NED metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs.geometry import R_from_euler

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres lie at integer coordinates. Its K has no skew."""

    K: Array  # [3, 3], pixels
    width_px: int
    height_px: int
    R_ned_cam: Array  # [3, 3]
    t_ned_cam_m: Array  # [3]; height above the ground is -z


@dataclass(frozen=True)
class Target:
    """An aircraft in the scene."""

    airframe_id: int  # index into AIRFRAMES
    livery_seed: int
    R_ned_body: Array  # [3, 3]
    t_ned_body_m: Array  # [3]

    def pose_in(self, camera: Camera) -> tuple[Array, Array]:
        """(R_cam_target [3, 3], t_cam_target_m [3]) as that camera sees it."""
        R_cam_ned = camera.R_ned_cam.T
        return R_cam_ned @ self.R_ned_body, R_cam_ned @ (self.t_ned_body_m - camera.t_ned_cam_m)


@dataclass(frozen=True)
class Environment:
    """Light, sky, clouds and ground. Colours are linear; one value draws the same world from every camera."""

    sun_ned: Array  # [3], unit, towards the sun
    sun_colour: Array  # [3]
    zenith: Array  # [3]
    horizon: Array  # [3], also the colour that haze tends to
    haze_per_m: float  # extinction; visibility is 3.9 / haze (Koschmieder, 2 % contrast)
    cloud: Array  # [3]
    cloud_threshold: float  # noise above it is cloud: 0 overcast, 1 clear
    cloud_softness: float
    cloud_base_m: float  # above ground
    cloud_scale_m: float
    cirrus: float
    ground: Array  # [3, 3], three tones
    ground_kind: int  # 0 fields, 1 forest, 2 desert, 3 sea
    field_m: float
    ground_turn_rad: float
    noise_offset: tuple[float, float]
    glow: float


@dataclass(frozen=True)
class Scene:
    """One exposure. Labels describe the first target; the others are merely seen."""

    camera: Camera
    targets: tuple[Target, ...]
    environment: Environment
    sensor_seed: int = 0  # blur, exposure and colour of the camera
    frame_index: int = 0  # noise differs from frame to frame


_GROUND = np.array(
    [
        [[0.10, 0.13, 0.04], [0.22, 0.20, 0.09], [0.05, 0.08, 0.03]],
        [[0.03, 0.06, 0.02], [0.07, 0.10, 0.04], [0.12, 0.12, 0.07]],
        [[0.38, 0.28, 0.17], [0.50, 0.40, 0.27], [0.26, 0.19, 0.12]],
        [[0.01, 0.04, 0.06], [0.03, 0.08, 0.10], [0.20, 0.24, 0.26]],
    ]
)


def environment_from_seed(seed: int) -> Environment:
    """Day, low sun or overcast over fields, forest, desert or sea; the same for the same seed."""
    rng = np.random.default_rng([seed, 0x5C1E])
    kind = rng.choice(3, p=[0.55, 0.2, 0.25])  # day, low sun, overcast
    sun_elevation = np.radians([rng.uniform(20, 70), rng.uniform(3, 15), rng.uniform(20, 60)][kind])
    azimuth = rng.uniform(0, 2 * np.pi)
    sun = R_from_euler(0.0, sun_elevation, azimuth) @ np.array([1.0, 0.0, 0.0])
    blue = rng.uniform(0.0, 1.0)
    zenith = [
        np.array([0.08, 0.20, 0.48]) * (1 - blue) + np.array([0.22, 0.36, 0.58]) * blue,
        np.array([0.08, 0.13, 0.27]),
        np.array([0.42, 0.45, 0.49]),
    ][kind] * rng.uniform(0.8, 1.25)
    horizon = (
        [
            np.array([0.55, 0.64, 0.74]),
            np.array([0.75, 0.50, 0.33]),
            np.array([0.58, 0.60, 0.62]),
        ][kind]
        * rng.uniform(0.75, 1.15)
        * rng.uniform(0.93, 1.07, 3)
    )
    ground_kind = int(rng.choice(4, p=[0.4, 0.25, 0.15, 0.2]))
    sun_colour = [np.array([1.05, 1.0, 0.92]), np.array([0.95, 0.62, 0.36]), np.array([0.12, 0.12, 0.13])][kind]
    brightness = [1.0, rng.uniform(0.45, 0.85), rng.uniform(0.55, 0.95)][kind]
    threshold = [rng.uniform(0.45, 1.05), rng.uniform(0.45, 1.0), rng.uniform(0.15, 0.5)][kind]
    return Environment(
        sun_ned=sun,
        sun_colour=sun_colour * rng.uniform(0.8, 1.2) * brightness,
        zenith=zenith * brightness,
        horizon=horizon * brightness,
        haze_per_m=3.9 / float(np.exp(rng.uniform(np.log(4e3), np.log(6e4)))),
        cloud=(np.array([0.78, 0.79, 0.81]) if kind != 1 else np.array([0.62, 0.46, 0.38]))
        * rng.uniform(0.6, 1.1)
        * brightness,
        cloud_threshold=float(threshold),
        cloud_softness=float(rng.uniform(0.05, 0.35)),
        cloud_base_m=float(rng.uniform(4500.0, 8000.0)),
        cloud_scale_m=float(np.exp(rng.uniform(7.6, 9.7))),
        cirrus=float(rng.uniform(0.0, 0.5) * (rng.random() < 0.6)),
        ground=_GROUND[ground_kind] * rng.uniform(0.6, 1.5) * rng.uniform(0.8, 1.2, 3) * brightness,
        ground_kind=ground_kind,
        field_m=float(np.exp(rng.uniform(np.log(60), np.log(400)))),
        ground_turn_rad=float(rng.uniform(0, np.pi)),
        noise_offset=(float(rng.uniform(0, 1)), float(rng.uniform(0, 1))),
        glow=float(rng.uniform(0.1, 0.6) if kind != 2 else rng.uniform(0.0, 0.15)),
    )
