"""Liveries: how an airframe is painted, drawn from a seed so that no colour stands for a type."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes.mesh import Part

PARTS = len(Part)


@dataclass(frozen=True)
class Livery:
    """Linear albedos 0..1 and markings; lengths are fractions of the airframe's half span or length."""

    palette: NDArray[np.float32]  # [8, 3], by Part
    gloss: float  # strength of the specular highlight, 0..1
    camouflage: NDArray[np.float32]  # [3], the second tone
    camouflage_share: float  # share of the skin in the second tone, 0: none
    marking: NDArray[np.float32]  # [3]
    tip_from: float  # wings are marked beyond this fraction of the half span, >= 1: never
    band_x: float  # centre of a fuselage band, fraction of the length from the origin
    band_width: float  # its half width, fraction of the length, 0: none
    noise_offset: tuple[float, float]


def livery_from_seed(seed: int) -> Livery:
    """A scheme (grey, white, dark, camouflage, bright) with or without markings; the same for the same seed."""
    rng = np.random.default_rng([seed, 0x11FE])
    scheme = rng.choice(5, p=[0.3, 0.27, 0.15, 0.18, 0.1])
    level = rng.uniform([0.22, 0.6, 0.04, 0.12, 0.35][scheme], [0.5, 0.88, 0.14, 0.35, 0.7][scheme])
    spread = [0.04, 0.03, 0.04, 0.12, 0.5][scheme]
    base = np.clip(level * (1.0 + spread * rng.uniform(-1, 1, 3)), 0.02, 0.92)
    palette = np.tile(base, (PARTS, 1))
    if rng.random() < 0.3:
        palette[Part.WING] = np.clip(base * rng.uniform(0.6, 1.35), 0.02, 0.92)
    if rng.random() < 0.3:
        palette[Part.TAIL] = rng.uniform(0.03, 0.8, 3)
    palette[Part.GLASS] = rng.uniform(0.01, 0.06, 3)
    palette[Part.METAL] = rng.uniform(0.1, 0.5)
    palette[Part.SENSOR] = rng.uniform(0.02, 0.3)
    palette[Part.TYRE] = rng.uniform(0.01, 0.04)
    palette[Part.PROPELLER_DISC] = rng.uniform(0.05, 0.3)
    return Livery(
        palette=palette.astype(np.float32),
        gloss=float(rng.uniform(0.0, 0.6)),
        camouflage=np.clip(base * rng.uniform(0.3, 1.6, 3), 0.02, 0.92).astype(np.float32),
        camouflage_share=float(rng.uniform(0.3, 0.6)) if scheme == 3 else 0.0,
        marking=rng.uniform(0.02, 0.85, 3).astype(np.float32),
        tip_from=float(rng.uniform(0.7, 0.95)) if rng.random() < 0.35 else 2.0,
        band_x=float(rng.uniform(-0.45, 0.3)),
        band_width=float(rng.uniform(0.01, 0.06)) if rng.random() < 0.3 else 0.0,
        noise_offset=(float(rng.uniform(0, 8)), float(rng.uniform(0, 8))),
    )
