"""Light, sky, clouds and ground of a world, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Weather = Literal["clear", "haze", "overcast", "low_sun", "dusk", "fog", "glare", "broken_cloud"]
WEATHERS: tuple[Weather, ...] = get_args(Weather)
# Frequency of each in training: mostly weather in which one flies.
SHARES = (0.38, 0.13, 0.15, 0.11, 0.05, 0.03, 0.05, 0.10)
GROUND_KINDS = ("fields", "forest", "desert", "sea", "town", "snow")
GROUND_SHARES = (0.34, 0.2, 0.12, 0.17, 0.11, 0.06)
_GROUND = np.array(
    [
        [[0.10, 0.13, 0.04], [0.22, 0.20, 0.09], [0.05, 0.08, 0.03]],
        [[0.03, 0.06, 0.02], [0.07, 0.10, 0.04], [0.12, 0.12, 0.07]],
        [[0.38, 0.28, 0.17], [0.50, 0.40, 0.27], [0.26, 0.19, 0.12]],
        [[0.01, 0.04, 0.06], [0.03, 0.08, 0.10], [0.20, 0.24, 0.26]],
        [[0.22, 0.13, 0.09], [0.26, 0.25, 0.24], [0.09, 0.12, 0.05]],
        [[0.62, 0.66, 0.72], [0.50, 0.54, 0.60], [0.06, 0.08, 0.05]],
    ]
)


@dataclass(frozen=True)
class Environment:
    """Light, sky, clouds and ground. Colours are linear; one value draws the same world from every camera."""

    sun_ned: Array  # [3], unit, towards the sun
    sun_colour: Array  # [3]
    zenith: Array  # [3]
    horizon: Array  # [3], also the colour that haze converges to
    haze_per_m: float  # extinction; visibility is 3.9 / haze (Koschmieder, 2 % contrast)
    cloud: Array  # [3]
    cloud_threshold: float  # noise above it is cloud: 0 overcast, 1 clear
    cloud_softness: float
    cloud_base_m: float  # above ground
    cloud_scale_m: float
    cirrus: float
    ground: Array  # [3, 3], three tones
    ground_kind: int  # index into GROUND_KINDS
    field_m: float
    ground_turn_rad: float
    noise_offset: tuple[float, float]
    glow: float
    relief_m: float = 0.0  # height of the hills on the horizon
    veil: float = 0.0  # veiling glare: light that the lens scatters over the image when the sun is in or near it
    horizon_away: Array | None = None  # [3], the horizon opposite the sun; None: the same in all directions
    near_cloud: float = 0.0  # share of the view covered by wisps of cloud nearer than any target, 0: none


@dataclass(frozen=True)
class _Light:
    """Ranges from which a kind of weather is drawn."""

    sun_elevation_deg: tuple[float, float]
    sun_colour: tuple[float, float, float]
    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]
    brightness: tuple[float, float]
    cloud_threshold: tuple[float, float]
    visibility_m: tuple[float, float]
    glow: tuple[float, float]
    veil: tuple[float, float] = (0.0, 0.0)
    cloud: tuple[float, float, float] = (0.78, 0.79, 0.81)
    horizon_away: tuple[float, float, float] | None = None


_DAY = ((20.0, 70.0), (1.05, 1.0, 0.92), (0.15, 0.28, 0.53), (0.55, 0.64, 0.74))
_GREY = ((20.0, 60.0), (0.12, 0.12, 0.13), (0.44, 0.46, 0.49), (0.58, 0.60, 0.62))
_WARM_CLOUD = (0.66, 0.53, 0.46)
_LIGHTS: dict[Weather, _Light] = {
    "clear": _Light(*_DAY, (0.9, 1.05), (0.6, 1.05), (1.5e4, 6e4), (0.1, 0.5)),
    "haze": _Light(*_DAY, (0.8, 1.0), (0.5, 1.05), (2.5e3, 9e3), (0.2, 0.6), (0.0, 0.06)),
    "overcast": _Light(*_GREY, (0.55, 0.95), (0.12, 0.4), (4e3, 3e4), (0.0, 0.15)),
    "low_sun": _Light(
        (4.0, 15.0), (0.95, 0.62, 0.36), (0.13, 0.21, 0.40), (0.85, 0.60, 0.40), (0.6, 0.95), (0.45, 1.0), (8e3, 5e4),
        (0.2, 0.6), (0.0, 0.05), _WARM_CLOUD, (0.42, 0.45, 0.53),
    ),
    "dusk": _Light(
        (0.5, 3.0), (0.42, 0.20, 0.11), (0.08, 0.12, 0.23), (0.70, 0.40, 0.26), (0.25, 0.5), (0.4, 1.0), (8e3, 4e4),
        (0.15, 0.4), (0.0, 0.02), (0.34, 0.28, 0.30), (0.19, 0.21, 0.29),
    ),
    "fog": _Light(*_GREY, (0.6, 1.0), (0.0, 0.2), (5e2, 2.2e3), (0.0, 0.1)),
    "glare": _Light(
        (6.0, 35.0), (1.15, 1.0, 0.82), (0.12, 0.23, 0.44), (0.50, 0.53, 0.57), (0.7, 0.95), (0.55, 1.05), (5e3, 4e4),
        (0.4, 0.7), (0.08, 0.28),
    ),
    "broken_cloud": _Light(*_DAY, (0.8, 1.05), (0.38, 0.5), (1e4, 6e4), (0.1, 0.4)),
}  # fmt: skip


def direction_ned(elevation_rad: float, azimuth_rad: float) -> Array:
    """Unit vector [3] at this elevation above the horizon and azimuth from north through east."""
    level = np.cos(elevation_rad)
    return np.array([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), -np.sin(elevation_rad)])


def _sun_ned(rng: np.random.Generator, elevation_rad: float, weather: Weather, sight_ned: Array | None) -> Array:
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    aside, above = rng.normal(0.0, np.radians(9.0)), rng.uniform(np.radians(1.0), np.radians(14.0))
    if weather == "glare" and sight_ned is not None:
        azimuth = float(np.arctan2(sight_ned[1], sight_ned[0])) + aside
        sight_up = np.arctan2(-sight_ned[2], np.hypot(sight_ned[0], sight_ned[1]))
        elevation_rad = float(np.clip(sight_up + above, np.radians(3.0), np.radians(75.0)))
    return direction_ned(elevation_rad, azimuth)


def environment_from_seed(seed: int, weather: Weather | None = None, sight_ned: Array | None = None) -> Environment:
    """The world of that seed; `weather` None draws one with training's SHARES.

    With "glare" the sun is within some degrees of `sight_ned` [3], the camera's viewing direction.
    """
    rng = np.random.default_rng([seed, 0x5C1E])
    drawn = WEATHERS[int(rng.choice(len(WEATHERS), p=SHARES))]
    kind = weather or drawn
    light = _LIGHTS[kind]
    brightness = rng.uniform(*light.brightness)
    sun_ned = _sun_ned(rng, np.radians(rng.uniform(*light.sun_elevation_deg)), kind, sight_ned)
    ground_kind = int(rng.choice(len(GROUND_KINDS), p=GROUND_SHARES))
    near_cloud = rng.uniform(0.3, 0.65) if rng.random() < (0.3 if kind == "broken_cloud" else 0.03) else 0.0
    warmth = rng.normal(0.0, 0.035)
    horizon_tint = rng.uniform(0.75, 1.15) * brightness * np.array([1.0 + warmth, 1.0, 1.0 - warmth])
    hills = rng.random() < 0.5 and GROUND_KINDS[ground_kind] != "sea"
    return Environment(
        sun_ned=sun_ned,
        sun_colour=np.array(light.sun_colour) * rng.uniform(0.8, 1.2) * brightness,
        zenith=np.array(light.zenith) * np.array([1.3, 1.12, 1.0]) ** rng.uniform(-1.5, 1.2) * brightness,
        horizon=np.array(light.horizon) * horizon_tint,
        haze_per_m=3.9 / float(np.exp(rng.uniform(*np.log(light.visibility_m)))),
        cloud=np.array(light.cloud) * rng.uniform(0.75, 1.1) * brightness,
        cloud_threshold=float(rng.uniform(*light.cloud_threshold)),
        cloud_softness=float(rng.uniform(0.05, 0.16) if kind == "broken_cloud" else rng.uniform(0.05, 0.35)),
        cloud_base_m=float(rng.uniform(4500.0, 8000.0)),
        cloud_scale_m=float(np.exp(rng.uniform(7.6, 9.7))),
        cirrus=float(rng.uniform(0.0, 0.5) * (rng.random() < 0.6)),
        ground=_GROUND[ground_kind] * rng.uniform(0.6, 1.5) * rng.uniform(0.8, 1.2, 3) * brightness,
        ground_kind=ground_kind,
        field_m=float(np.exp(rng.uniform(np.log(60), np.log(400)))),
        ground_turn_rad=float(rng.uniform(0, np.pi)),
        noise_offset=(float(rng.uniform(0, 1)), float(rng.uniform(0, 1))),
        glow=float(rng.uniform(*light.glow)),
        relief_m=float(rng.uniform(150.0, 900.0)) if hills else 0.0,
        veil=float(rng.uniform(*light.veil)),
        near_cloud=float(near_cloud),
        horizon_away=np.array(light.horizon_away or light.horizon) * horizon_tint,
    )
