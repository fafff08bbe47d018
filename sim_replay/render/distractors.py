"""Distractors, objects that are not aircraft: birds, specks, wisps of cloud, other things."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.render.other_things import paint
from sim_replay.render.scene import Scene

_SPAN_PX = (5.0, 60.0)
_MARGIN_PX = 80
_WINDOW_SPAN_PX, _WINDOW_SPAN_SHARE = 3.0, 0.35  # in a window: from this many pixels to this share of its side
_PALE_SHARE = 0.15
_RUFFLED = 0.012  # 1-sigma displacement of an outline's corners, share of the span


WISP_SHARE, BIRD_SHARE = 0.25, 0.4  # of decoys; the rest are other things


@dataclass(frozen=True)
class Decoy:
    """A bird, a wisp of cloud or another thing placed like a target."""

    center_px: tuple[float, float]
    span_px: float


def bird_outline(span_px: float, flap: float, chord: float, bend: float, turn_rad: float) -> NDArray[np.float64]:
    """Outline [9, 2] of a bird about its own centre, pixels; `flap` -0.5..0.5 lifts the wing tips."""
    elbow = bend * flap
    outline = np.array(
        [
            [-0.5, flap - 0.02],
            [-0.2, elbow - chord / 2],
            [0, -0.35 * chord],
            [0.2, elbow - chord / 2],
            [0.5, flap - 0.02],
            [0.22, elbow + chord / 2],
            [0.03, chord],
            [-0.03, chord],
            [-0.22, elbow + chord / 2],
        ]
    )
    rotation = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    return span_px * outline @ rotation.T


def _filled(points: NDArray[np.float64], width: int, height: int) -> NDArray[np.float32]:
    alpha = np.zeros((height, width), np.uint8)
    cv2.fillPoly(alpha, [np.round(points * 16).astype(np.int32)], 255, cv2.LINE_AA, shift=4)
    return alpha.astype(np.float32) / np.float32(255)


def _bird(
    rng: np.random.Generator, side: int, decoy: Decoy | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Opacity [side, side] in 0..1 and colour [3] of a bird; without a `decoy`, of random size and place.

    Every shape is different, so that a network cannot learn to recognise birds by one fixed drawing.
    """
    span = decoy.span_px if decoy else rng.uniform(_WINDOW_SPAN_PX, _WINDOW_SPAN_SHARE * side)
    center = np.array(decoy.center_px) if decoy else rng.uniform(0, side, 2)
    flap, turn = rng.uniform(-0.5, 0.5), rng.uniform(0, 2 * np.pi)
    outline = bird_outline(span, flap, rng.uniform(0.08, 0.2), rng.uniform(0.0, 0.25), turn)
    outline += rng.normal(0.0, _RUFFLED * span, outline.shape)
    along, narrower = rng.uniform(0, np.pi), rng.uniform(0.6, 1.0)  # viewed obliquely
    across = np.array([np.cos(along), np.sin(along)])
    outline -= (1.0 - narrower) * np.outer(outline @ across, across)
    level = rng.uniform(110, 235) if rng.random() < _PALE_SHARE else rng.uniform(10, 110)
    return _filled(outline + center, side, side), level * (1.0 + 0.05 * rng.normal(size=3))


def blob(rng: np.random.Generator, side: int, radius_px: tuple[float, float]) -> NDArray[np.float32]:
    """A soft ellipse [side, side] in 0..1 at a random place in the image."""
    y, x = np.mgrid[:side, :side].astype(np.float32)
    centre, turn = rng.uniform(0, side, 2), rng.uniform(0, np.pi)
    a, b = rng.uniform(*radius_px, 2)
    u = (np.cos(turn) * (x - centre[0]) + np.sin(turn) * (y - centre[1])) / a
    v = (-np.sin(turn) * (x - centre[0]) + np.cos(turn) * (y - centre[1])) / b
    return np.exp(-0.5 * (u * u + v * v)).astype(np.float32)


def _wisp(rng: np.random.Generator, side: int, decoy: Decoy) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Opacity [side, side] in 0..1 and colour [3] of a ragged wisp of cloud, or of a gap in one."""
    y, x = np.mgrid[:side, :side].astype(np.float32) - np.array(decoy.center_px, np.float32)[::-1, None, None]
    turn = rng.uniform(0, np.pi)
    long_px = decoy.span_px / 4.0  # sigma of a Gaussian whose span is +-2 sigma
    wide_px = long_px * rng.uniform(0.15, 0.7)
    u = (np.cos(turn) * x + np.sin(turn) * y) / np.float32(long_px)
    v = (np.cos(turn) * y - np.sin(turn) * x) / np.float32(wide_px)
    cells = np.clip(side / long_px * rng.uniform(0.5, 2.5, 2), 4, side).astype(int)
    coarse = rng.normal(size=cells).astype(np.float32)
    ragged = np.asarray(cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC))
    alpha = rng.uniform(0.15, 0.5) * np.clip(np.exp(-0.5 * (u * u + v * v)) * (1.0 + ragged), 0.0, 1.0)
    return alpha.astype(np.float32), rng.uniform(0, 255) * (1.0 + 0.08 * rng.normal(size=3))


def add_decoy(image_bgr: NDArray[np.uint8], decoy: Decoy, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw a bird, a wisp of cloud or another thing on a square image [S, S, 3]."""
    kind, side = rng.random(), image_bgr.shape[0]
    if kind < WISP_SHARE + BIRD_SHARE:
        alpha, level = (_wisp if kind < WISP_SHARE else _bird)(rng, side, decoy)
        colour = level.astype(np.float32)
    else:
        thing = paint(rng, side, decoy.center_px, decoy.span_px)
        alpha, colour = thing.alpha, thing.colour
    image = image_bgr + alpha[..., None] * (colour - image_bgr)
    return np.clip(image, 0, 255).astype(np.uint8)


def add_distractors(
    image_bgr: NDArray[np.uint8], coverage: NDArray[np.uint8], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Draw birds, specks and wisps of cloud on a square image [S, S, 3], behind the aircraft."""
    side = image_bgr.shape[0]
    image, behind = image_bgr.astype(np.float32), 1.0 - coverage.astype(np.float32) / 255
    for _ in range(int(rng.integers(1, 5))):
        kind = rng.random()
        if kind < 0.6:
            alpha, level = _bird(rng, side)
        elif kind < 0.8:
            alpha, level = blob(rng, side, (0.6, 2.5)), rng.uniform(0, 255) * np.ones(3)
        else:
            alpha, level = 0.7 * blob(rng, side, (0.03 * side, 0.2 * side)), rng.uniform(140, 235) * np.ones(3)
        seen = (alpha * behind)[..., None]
        image += seen * (level.astype(np.float32) - image)
    return np.clip(image, 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Sprite:
    """One distractor in a whole frame."""

    x0_px: int
    y0_px: int
    alpha: NDArray[np.float32]  # [h, w], within the image
    level: float  # 0..255, gamma 2
    before: bool  # in front of the targets


def sprites(scene: Scene) -> list[Sprite]:
    """The scene's distractors at their places in this frame; those outside the image are left out.

    Their paths depend on the sensor seed alone, so they fly on and beat their wings from frame to frame.
    """
    out = []
    width, height = scene.camera.width_px, scene.camera.height_px
    for number in range(scene.distractors):
        rng = np.random.default_rng([scene.sensor_seed, 0xB12D, number])
        span = float(np.exp(rng.uniform(*np.log(_SPAN_PX))))
        speed, heading = rng.uniform(0.3, 4.0) * span / 20.0, rng.uniform(0, 2 * np.pi)
        room = np.array([width, height]) + 2.0 * _MARGIN_PX
        start = rng.uniform(0.0, room)
        at = (start + scene.frame_index * speed * np.array([np.cos(heading), np.sin(heading)])) % room - _MARGIN_PX
        phase, beat = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.9)
        flap = 0.1 + 0.3 * np.sin(phase + beat * scene.frame_index)
        level, before = float(rng.uniform(12, 120)), bool(rng.random() < 0.5)
        outline = bird_outline(span, flap, rng.uniform(0.1, 0.2), rng.uniform(0.0, 0.25), rng.normal(0.0, 0.5)) + at
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, [width, height])
        if np.all(high > low):
            alpha = _filled(outline - low, int(high[0] - low[0]), int(high[1] - low[1]))
            out.append(Sprite(int(low[0]), int(low[1]), alpha, level, before))
    return out
