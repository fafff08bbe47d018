"""Liveries: an airframe's paint, drawn from a seed so that no colour identifies a type."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes.mesh import Part

PARTS = len(Part)


@dataclass(frozen=True)
class Livery:
    """Linear RGB albedos 0..1 and markings; lengths are fractions of the airframe's half span or length."""

    palette: NDArray[np.float32]  # [8, 3], by Part
    gloss: float  # strength of the specular highlight, 0..1
    camouflage: NDArray[np.float32]  # [3], the second tone
    camouflage_share: float  # share of the skin in the second tone, 0: none
    marking: NDArray[np.float32]  # [3]
    tip_from: float  # wings are marked beyond this fraction of the half span, >= 1: never
    band_x: float  # centre of a fuselage band, fraction of the length from the origin
    band_width: float  # its half width, fraction of the length, 0: none
    noise_offset: tuple[float, float]


class _Scheme(NamedTuple):
    """A family of paints: linear RGB between two shades, and for camouflage the second tone."""

    share: float
    darkest: tuple[float, float, float]
    lightest: tuple[float, float, float]
    second: tuple[float, float, float] | None = None


_SCHEMES = (
    _Scheme(0.20, (0.20, 0.21, 0.22), (0.45, 0.47, 0.50)),  # military greys
    _Scheme(0.22, (0.60, 0.60, 0.58), (0.88, 0.88, 0.88)),  # white
    _Scheme(0.08, (0.03, 0.03, 0.04), (0.12, 0.12, 0.14)),  # black, dark blue-grey
    _Scheme(0.07, (0.30, 0.23, 0.14), (0.50, 0.41, 0.29)),  # sand
    _Scheme(0.06, (0.05, 0.07, 0.03), (0.13, 0.16, 0.08)),  # olive
    _Scheme(0.07, (0.45, 0.46, 0.48), (0.62, 0.63, 0.65)),  # bare metal
    _Scheme(0.04, (0.60, 0.10, 0.02), (0.80, 0.22, 0.04)),  # target orange
    _Scheme(0.04, (0.60, 0.38, 0.02), (0.85, 0.58, 0.06)),  # trainer yellow
    _Scheme(0.04, (0.35, 0.02, 0.02), (0.60, 0.06, 0.05)),  # red
    _Scheme(0.04, (0.02, 0.05, 0.18), (0.08, 0.18, 0.45)),  # blue
    _Scheme(0.05, (0.05, 0.09, 0.04), (0.10, 0.15, 0.07), (0.15, 0.10, 0.06)),  # green and brown
    _Scheme(0.05, (0.34, 0.26, 0.16), (0.48, 0.38, 0.25), (0.19, 0.12, 0.07)),  # sand and brown
    _Scheme(0.04, (0.28, 0.30, 0.32), (0.38, 0.40, 0.43), (0.12, 0.13, 0.15)),  # two greys
)
_MARKINGS = np.array(
    [
        [0.60, 0.03, 0.03],
        [0.02, 0.05, 0.30],
        [0.75, 0.18, 0.02],
        [0.80, 0.55, 0.03],
        [0.03, 0.03, 0.03],
        [0.85, 0.85, 0.85],
        [0.03, 0.20, 0.06],
    ]
)


def livery_from_seed(seed: int) -> Livery:
    """A scheme (greys, white, dark, sand, olive, metal, bright, camouflage) with or without markings.

    The same for the same seed. Wings or tail may differ from the fuselage; wing tips, a fuselage band and the tail may
    carry the marking.
    """
    rng = np.random.default_rng([seed, 0x11FE])
    scheme = _SCHEMES[int(rng.choice(len(_SCHEMES), p=[s.share for s in _SCHEMES]))]
    shade = rng.uniform()
    base = (1.0 - shade) * np.array(scheme.darkest) + shade * np.array(scheme.lightest)
    base = np.clip(base * (1.0 + 0.06 * rng.uniform(-1, 1, 3)), 0.02, 0.92)
    marking = np.clip(_MARKINGS[rng.integers(len(_MARKINGS))] * rng.uniform(0.7, 1.1), 0.02, 0.9)
    palette = np.tile(base, (PARTS, 1))
    if rng.random() < 0.3:
        palette[Part.WING] = np.clip(base * rng.uniform(0.6, 1.35), 0.02, 0.92)
    if rng.random() < 0.3:
        palette[Part.TAIL] = marking if rng.random() < 0.5 else np.clip(base * rng.uniform(0.5, 1.5), 0.02, 0.92)
    palette[Part.GLASS] = rng.uniform(0.01, 0.06) * np.array([0.8, 0.95, 1.1])
    palette[Part.METAL] = rng.uniform(0.1, 0.5)
    palette[Part.SENSOR] = base if rng.random() < 0.3 else rng.uniform(0.02, 0.3)
    palette[Part.TYRE] = rng.uniform(0.01, 0.04)
    palette[Part.PROPELLER_DISC] = rng.uniform(0.05, 0.3)
    second = base if scheme.second is None else np.array(scheme.second) * rng.uniform(0.7, 1.3)
    return Livery(
        palette=palette.astype(np.float32),
        gloss=float(rng.uniform(0.0, 0.6)),
        camouflage=np.clip(second, 0.02, 0.92).astype(np.float32),
        camouflage_share=float(rng.uniform(0.3, 0.6)) if scheme.second is not None else 0.0,
        marking=marking.astype(np.float32),
        tip_from=float(rng.uniform(0.7, 0.95)) if rng.random() < 0.35 else 2.0,
        band_x=float(rng.uniform(-0.45, 0.3)),
        band_width=float(rng.uniform(0.01, 0.06)) if rng.random() < 0.3 else 0.0,
        noise_offset=(float(rng.uniform(0, 8)), float(rng.uniform(0, 8))),
    )
