"""Things that are no fixed-wing aircraft, drawn in place of one: rotorcraft, parachutes, balloons, masts, parts of the
own aircraft, and what cameras write into their pictures.

All are random in shape, colour and light, so that a network cannot learn one drawing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

SHIFT = 4  # fractional bits of drawn coordinates
LIT = 0.35  # largest difference of brightness from the top to the bottom of a thing
TILT_MAX_RAD = 0.6

Array = NDArray[np.float64]


class Canvas:
    """Opacity and colour on a square image, drawn in units of the thing's span about its centre, y down."""

    def __init__(self, side: int, center_px: ArrayLike, span_px: float, turn_rad: float, light: float) -> None:
        """`light`: brightness added at the top of the thing and taken away at its bottom, as a share."""
        self.alpha = np.zeros((side, side), np.float32)
        self.colour = np.zeros((side, side, 3), np.float32)
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        self._turned = span_px * np.array([[c, -s], [s, c]])
        self._center_px, self._span_px = np.asarray(center_px, np.float64), span_px
        y = (np.arange(side, dtype=np.float32) - np.float32(self._center_px[1])) / np.float32(span_px)
        self._lit = (1.0 - np.float32(2.0 * light) * y.clip(-0.5, 0.5))[:, None, None]

    def polygon(self, points: ArrayLike, bgr: Array, opacity: float = 1.0) -> None:
        placed = self._placed(points)
        part, low = self._around(placed, 1.0)
        mask = np.zeros(self.alpha[part].shape, np.uint8)
        if mask.size:
            cv2.fillPoly(mask, [_fixed(placed - low)], 255, cv2.LINE_AA, shift=SHIFT)
            self._lay(part, mask, bgr, opacity)

    def ellipse(self, at: Sequence[float], axes: Sequence[float], bgr: Array, opacity: float = 1.0) -> None:
        angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        self.polygon(np.asarray(at) + np.stack([axes[0] * np.cos(angle), axes[1] * np.sin(angle)], 1), bgr, opacity)

    def line(self, ends: ArrayLike, thick: float, bgr: Array, opacity: float = 1.0) -> None:
        """Through two or more points, `thick` in spans; one pixel at least."""
        width_px = max(round(thick * self._span_px), 1)
        placed = self._placed(ends)
        part, low = self._around(placed, 1.0 + width_px)
        mask = np.zeros(self.alpha[part].shape, np.uint8)
        if mask.size:
            cv2.polylines(mask, [_fixed(placed - low)], False, 255, width_px, cv2.LINE_AA, SHIFT)
            self._lay(part, mask, bgr, opacity)

    def _placed(self, points: ArrayLike) -> Array:
        placed: Array = np.asarray(points, np.float64) @ self._turned.T + self._center_px
        return placed

    def _around(self, placed_px: Array, margin_px: float) -> tuple[tuple[slice, slice], Array]:
        """The part of the image [rows, columns] that holds these points, empty if none does, and its corner (x, y)."""
        side = len(self.alpha)
        x0, y0 = np.clip(np.floor(placed_px.min(0) - margin_px), 0, side).astype(int)
        x1, y1 = np.clip(np.ceil(placed_px.max(0) + margin_px), 0, side).astype(int)
        return (slice(y0, y1), slice(x0, x1)), np.array([x0, y0], np.float64)

    def _lay(self, part: tuple[slice, slice], mask: NDArray[np.uint8], bgr: Array, opacity: float) -> None:
        over = mask.astype(np.float32) * np.float32(opacity / 255.0)
        self.colour[part] += over[..., None] * (self._lit[part[0]] * bgr.astype(np.float32) - self.colour[part])
        self.alpha[part] += over * (1.0 - self.alpha[part])


def _fixed(points_px: Array) -> NDArray[np.int32]:
    return np.round(points_px * 2**SHIFT).astype(np.int32)


def paint(rng: np.random.Generator, side: int, center_px: ArrayLike, span_px: float) -> Canvas:
    """A random thing about as large as `span_px`, upright within a third of a right angle if it has an upright."""
    draw, upright = KINDS[int(rng.integers(len(KINDS)))]
    turn = rng.normal(0.0, TILT_MAX_RAD / 3.0) if upright else rng.uniform(0.0, 2.0 * np.pi)
    canvas = Canvas(side, center_px, span_px, float(turn), float(rng.uniform(-0.1, LIT)))
    draw(canvas, rng)
    # Colours lie under their own opacity; where it is low, they were mixed with black.
    canvas.colour /= np.maximum(canvas.alpha, 1e-3)[..., None]
    return canvas


def _paint_of(rng: np.random.Generator, low: float = 15.0, high: float = 245.0) -> Array:
    """A colour [3], mostly greyish."""
    level, saturation = rng.uniform(low, high), rng.choice([0.05, 0.4], p=[0.75, 0.25])
    return (level * (1.0 + saturation * rng.normal(size=3))).clip(0.0, 255.0)


def _multirotor(canvas: Canvas, rng: np.random.Generator) -> None:
    body, disc = _paint_of(rng, high=160.0), _paint_of(rng)
    arms, flat, first = int(rng.choice([3, 4, 4, 6, 8])), rng.uniform(0.08, 0.6), rng.uniform(0.0, np.pi)
    reach, thick, rotor = 0.36, rng.uniform(0.02, 0.06), rng.uniform(0.1, 0.17)
    raised, seen = rng.uniform(-0.05, 0.02), rng.uniform(0.1, 0.8)
    for arm in range(arms):
        angle = first + 2.0 * np.pi * arm / arms
        tip = reach * np.array([np.cos(angle), flat * np.sin(angle)])
        canvas.line(np.stack([np.zeros(2), tip]), thick, body)
        canvas.ellipse((tip[0], tip[1] + raised), (rotor, rotor * flat), disc, seen)
    canvas.ellipse((0.0, 0.0), (rng.uniform(0.08, 0.16), rng.uniform(0.05, 0.12)), body)
    if rng.random() < 0.5:  # a load or a landing gear
        below = rng.uniform(0.08, 0.2)
        canvas.line([[-0.1, below], [0.1, below]], 0.02, body)
        canvas.line([[0.0, 0.0], [0.0, below]], 0.03, body)


def _helicopter(canvas: Canvas, rng: np.random.Generator) -> None:
    body, blades = _paint_of(rng), _paint_of(rng, high=120.0)
    long, high, side = rng.uniform(0.12, 0.2), rng.uniform(0.06, 0.11), rng.choice([-1.0, 1.0])
    boom = side * rng.uniform(0.4, 0.5)
    canvas.polygon([[0.0, -0.05], [boom, -0.04], [boom, 0.0], [0.0, 0.06]], body)
    canvas.ellipse((-side * 0.03, 0.0), (long, high), body)
    fin = rng.uniform(0.05, 0.12)
    canvas.polygon([[boom, -0.02], [boom + side * 0.04, -fin], [boom + side * 0.05, fin / 2]], body)
    mast = -high - rng.uniform(0.02, 0.05)
    canvas.line([[0.0, mast], [0.0, 0.0]], 0.02, body)
    if rng.random() < 0.5:
        canvas.ellipse((0.0, mast), (rng.uniform(0.4, 0.5), rng.uniform(0.01, 0.15)), blades, rng.uniform(0.1, 0.5))
    else:
        half = rng.uniform(0.25, 0.5)
        canvas.line([[-half, mast], [half, mast + rng.uniform(-0.05, 0.05)]], 0.015, blades)
    if rng.random() < 0.7:
        canvas.line([[-long, high + 0.04], [long, high + 0.04]], 0.015, blades)


def _parachute(canvas: Canvas, rng: np.random.Generator) -> None:
    canopy, lines = _paint_of(rng, low=40.0), _paint_of(rng, high=120.0)
    wide, high, bent = rng.uniform(0.3, 0.5), rng.uniform(0.08, 0.3), rng.uniform(0.0, 0.12)
    angle = np.linspace(np.pi, 2.0 * np.pi, 13)
    above = np.stack([wide * np.cos(angle), -0.3 + high * np.sin(angle)], 1)
    below = np.stack([np.linspace(wide, -wide, 9), -0.3 - bent * np.cos(np.linspace(-np.pi / 2, np.pi / 2, 9))], 1)
    load_y = rng.uniform(0.2, 0.5)
    for x in np.linspace(-wide, wide, int(rng.integers(3, 8))):
        canvas.line([[x, -0.3], [0.0, load_y]], 0.004, lines, 0.7)
    canvas.polygon(np.concatenate([above, below]), canopy)
    canvas.ellipse((0.0, load_y), (rng.uniform(0.015, 0.05), rng.uniform(0.03, 0.08)), lines)


def _balloon(canvas: Canvas, rng: np.random.Generator) -> None:
    envelope, high = _paint_of(rng, low=40.0), rng.uniform(0.3, 0.42)
    canvas.ellipse((0.0, -0.1), (rng.uniform(0.75, 1.0) * high, high), envelope)
    for x in np.linspace(-0.6, 0.6, int(rng.integers(0, 6))):
        canvas.line([[x * high, -0.1], [0.3 * x * high, -0.1 + high]], 0.02, _paint_of(rng), 0.6)
    if rng.random() < 0.7:
        canvas.polygon([[-0.04, 0.4], [0.04, 0.4], [0.03, 0.48], [-0.03, 0.48]], _paint_of(rng, high=120.0))


def _mast(canvas: Canvas, rng: np.random.Generator) -> None:
    steel = _paint_of(rng, high=200.0)
    foot, top, low = rng.uniform(0.03, 0.14), rng.uniform(0.005, 0.04), rng.uniform(0.5, 1.5)
    steps = int(rng.integers(3, 14))
    heights = np.linspace(-0.5, low, steps)
    half = np.interp(heights, [-0.5, low], [top, foot])
    thick = rng.uniform(0.008, 0.025)
    for sign in (-1.0, 1.0):
        canvas.line(np.stack([sign * half, heights], 1), thick, steel)
        zigzag = half * np.where(np.arange(steps) % 2, sign, -sign)
        canvas.line(np.stack([zigzag, heights], 1), 0.7 * thick, steel)
    for _ in range(int(rng.integers(0, 4))):
        arm, at = rng.uniform(0.1, 0.5), rng.uniform(-0.5, 0.2)
        canvas.line([[-arm, at], [0.0, at - rng.uniform(0.0, 0.05)], [arm, at]], rng.uniform(0.01, 0.04), steel)
    if rng.random() < 0.2:  # a wind turbine
        first = rng.uniform(0.0, 2.0)
        for blade in range(3):
            angle = first + 2.0 * np.pi * blade / 3.0
            along = np.array([np.cos(angle), np.sin(angle)])
            across = 0.02 * np.array([-along[1], along[0]])
            hub = np.array([0.0, -0.5])
            canvas.polygon([hub - across, hub + 0.2 * along - 1.5 * across, hub + 0.6 * along, hub + across], steel)


def _own_part(canvas: Canvas, rng: np.random.Generator) -> None:
    """A wing tip with or without a winglet, a fin, or a propeller's blade, that reaches in from somewhere."""
    skin, root, tip = _paint_of(rng), rng.uniform(0.08, 0.35), rng.uniform(0.02, 0.15)
    long, swept = rng.uniform(0.3, 0.6), rng.uniform(-0.3, 0.3)
    corners = [[3.0, -root / 2], [3.0, root / 2], [0.5, root / 2], [0.5 - long, swept + tip / 2]]
    if rng.random() < 0.5:
        up, lean = rng.uniform(-0.5, 0.5), rng.uniform(-0.15, 0.1)
        corners += [[0.5 - long + lean, swept + up], [0.5 - long + lean + tip, swept + up]]
    corners += [[0.5 - long + tip, swept - tip / 2], [0.5, -root / 2]]
    canvas.polygon(corners, skin)
    if rng.random() < 0.5:
        canvas.line([[3.0, 0.1 * root], [0.5 - 0.8 * long, swept]], 0.01, _paint_of(rng), 0.6)


def _overlay(canvas: Canvas, rng: np.random.Generator) -> None:
    """A cross hair, brackets, an artificial horizon or a few letters, as cameras and displays write them."""
    ink = np.full(3, rng.choice([0.0, 255.0])) if rng.random() < 0.7 else _paint_of(rng)
    thick, gap = rng.uniform(0.008, 0.04), rng.uniform(0.0, 0.15)
    kind = rng.integers(4)
    if kind == 0:
        for ends in ([[-0.5, 0], [-gap, 0]], [[gap, 0], [0.5, 0]], [[0, -0.5], [0, -gap]], [[0, gap], [0, 0.5]]):
            canvas.line(ends, thick, ink)
    elif kind == 1:
        arm = rng.uniform(0.1, 0.3)
        for x, y in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
            canvas.line([[x - np.sign(x) * arm, y], [x, y], [x, y - np.sign(y) * arm]], thick, ink)
    elif kind == 2:
        dip = rng.uniform(0.0, 0.2)
        canvas.line([[-0.5, 0], [-0.15, 0], [0, dip], [0.15, 0], [0.5, 0]], thick, ink)
    else:
        high = rng.uniform(0.12, 0.3)
        for x in np.arange(-0.5, 0.5, 0.8 * high):
            strokes = rng.uniform(0.0, high, (int(rng.integers(3, 6)), 2)) * np.array([0.6, 1.0])
            canvas.line(strokes + np.array([x, -high / 2]), thick, ink)


# Each with whether it has an upright.
KINDS: tuple[tuple[Callable[[Canvas, np.random.Generator], None], bool], ...] = (
    (_multirotor, True),
    (_helicopter, True),
    (_parachute, True),
    (_balloon, True),
    (_mast, True),
    (_own_part, False),
    (_overlay, True),
)
