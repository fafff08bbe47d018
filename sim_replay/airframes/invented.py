"""Invented aircraft, for generalisation to unseen airframes: the fleet's parts exchanged, swept, stretched, resized.

A network trained on the fleet alone takes every unseen airframe for the most similar member, and is as sure of its
size; one that has seen small wings only at tails takes a canard's nose for its tail. Airframe numbers from
`len(AIRFRAMES)` on are invented aircraft.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes.fleet import AIRFRAMES, Airframe
from sim_replay.airframes.mesh import Mesh, Part, merge, moved, scaled

# Variants of each pair of members of the fleet; limited, since a renderer keeps all that it has drawn. Uncertainty
# on unseen airframes is learnt from many aircraft that the network was not trained on, and evaluated on others that
# nothing was learnt from: memorised aircraft would not count as unseen.
TRAINING_VARIANTS, DATASET_VARIANTS, KEPT_BACK_VARIANTS = range(4), range(4, 8), range(8, 24)
_NAME = "invented_"
SIZE_SIGMA = 0.35  # of the logarithm of span and length together
STRETCH = 0.22  # of the logarithm, either way, of length, span and height separately
SPAN_M = (1.5, 26.0)
EXCHANGED_SHARE = 0.6
# Slopes of x and z over the span, outside the cabin's width: swept back (negative) to forwards, raised (negative)
# to drooping.
SWEEP, DIHEDRAL = (-0.35, 0.15), (-0.12, 0.08)
CABIN_SHARE = 0.06  # of the span, on either side of the middle
NOSE_STRETCH = 0.25  # of the logarithm, either way, of the part ahead of the wing, and of the part behind
CANARD_SHARE = 0.2
CANARD_SPAN, CANARD_CHORD = (0.25, 0.5), (0.3, 0.6)  # shares of the wing's
_EXCHANGEABLE = (Part.WING, Part.TAIL)


class Invention(NamedTuple):
    """How many targets are invented aircraft, and which ones."""

    share: float = 0.0  # 0..1
    variants: range = TRAINING_VARIANTS


FLEET_ALONE = Invention()


def airframe_of(number: int) -> Airframe:
    """A member of the fleet, or an invented aircraft for larger numbers. Raises IndexError beyond the last of those."""
    return AIRFRAMES[number] if number < len(AIRFRAMES) else _invented(number)


def airframe_id(name: str) -> int:
    """The number of the named airframe, the fleet's or invented. Raises ValueError that lists the fleet's."""
    names = [airframe.name for airframe in AIRFRAMES]
    if name in names:
        return names.index(name)
    invented, digits = range(len(names), _number(KEPT_BACK_VARIANTS.stop, 0, 0)), name.removeprefix(_NAME)
    if name.startswith(_NAME) and digits.isdecimal() and int(digits) in invented:
        return int(digits)
    raise ValueError(f"no airframe is called {name!r}; there are {', '.join(names)}")


def draw_invented(rng: np.random.Generator, airframe_ids: Sequence[int], variants: range = TRAINING_VARIANTS) -> int:
    """The number of an invented aircraft made only of parts of these members of the fleet."""
    base, donor = (int(rng.choice(np.asarray(airframe_ids))) for _ in range(2))
    return _number(int(rng.integers(variants.start, variants.stop)), donor, base)


def dataset_names(count: int, airframe_ids: Sequence[int]) -> tuple[str, ...]:
    """Names of `count` invented aircraft, made of parts of these members of the fleet, that no network is trained on.

    Raises ValueError if there are not enough.
    """
    pool = [_number(*made_of) for made_of in itertools.product(DATASET_VARIANTS, airframe_ids, airframe_ids)]
    if count > len(pool):
        raise ValueError(f"there are no {count} invented aircraft of so few parts, but {len(pool)}")
    drawn = np.random.default_rng(count).choice(pool, count, replace=False)
    return tuple(f"{_NAME}{number}" for number in drawn)


def _number(variant: int, donor: int, base: int) -> int:
    fleet = len(AIRFRAMES)
    return fleet + (variant * fleet + donor) * fleet + base


@cache
def _invented(number: int) -> Airframe:
    fleet = len(AIRFRAMES)
    rest, base = divmod(number - fleet, fleet)
    variant, donor = divmod(rest, fleet)
    if variant >= KEPT_BACK_VARIANTS.stop:
        raise IndexError(f"there is no airframe {number}")
    rng = np.random.default_rng([variant, donor, base])
    original, other = AIRFRAMES[base], AIRFRAMES[donor]
    exchanged = [part for part in _EXCHANGEABLE if base != donor and rng.random() < EXCHANGED_SHARE]
    stretch = np.exp(rng.uniform(-STRETCH, STRETCH, 3))
    slopes = rng.uniform(*SWEEP), rng.uniform(*DIHEDRAL)
    ahead_behind = np.exp(rng.uniform(-NOSE_STRETCH, NOSE_STRETCH, 2))
    canard = Canard.drawn(rng) if rng.random() < CANARD_SHARE else None
    low, high = np.log(np.array(SPAN_M) / (original.span_m * stretch[1]))
    size = float(np.exp(np.clip(rng.normal(0.0, SIZE_SIGMA), low, high)))

    def build() -> Mesh:
        mesh = original.mesh()
        for part in exchanged:
            mesh = _with_part_of(mesh, other.mesh(), part)
        if canard is not None:
            mesh = _as_canard(mesh, canard)
        return scaled(bent(mesh, slopes, ahead_behind), size * stretch)

    extent = np.ptp(build().vertices_m, axis=0)
    return Airframe(
        f"{_NAME}{number}",
        f"{original.name} with parts of {other.name}, stretched",
        float(extent[1]),
        float(extent[0]),
        "no such aircraft exists",
        build,
    )


def _with_part_of(mesh: Mesh, other: Mesh, part: Part) -> Mesh:
    """The mesh with the other's part in place of its own, fitted to its span; unchanged if either has none."""
    own, theirs = _only(mesh, mesh.part == part), _only(other, other.part == part)
    if not len(own.faces) or not len(theirs.faces):
        return mesh
    ratio = np.ptp(own.vertices_m[:, 1]) / max(float(np.ptp(theirs.vertices_m[:, 1])), 1e-3)
    # A part of almost no span is a single fin: its height is the measure of size.
    if not 0.2 < ratio < 5.0:
        ratio = np.ptp(own.vertices_m[:, 2]) / max(float(np.ptp(theirs.vertices_m[:, 2])), 1e-3)
    fitted = scaled(theirs, [float(np.clip(ratio, 0.2, 5.0))] * 3)
    middle = [0.5 * (m.vertices_m.min(axis=0) + m.vertices_m.max(axis=0)) for m in (own, fitted)]
    by_m = middle[0] - middle[1]
    by_m[1] = 0.0
    return merge([_only(mesh, mesh.part != part), moved(fitted, by_m)])


@dataclass(frozen=True)
class Canard:
    """A small wing at the nose, with the main wing far back. Shares, 0..1."""

    span: float  # of the wing's
    chord: float  # of the wing's
    nose: float  # its position between the wing (0) and the nose (1)
    tail: float  # remaining share of the length behind the wing
    keeps_tail: bool

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Canard:
        nose, tail = rng.uniform(0.55, 0.9), rng.uniform(0.15, 0.5)
        return cls(rng.uniform(*CANARD_SPAN), rng.uniform(*CANARD_CHORD), nose, tail, bool(rng.random() < 0.3))


def _as_canard(mesh: Mesh, canard: Canard) -> Mesh:
    """The mesh shortened behind its wing, lengthened ahead of it by as much, and with a small copy of the wing ahead;
    unchanged if it has no wing on a fuselage."""
    wing = _lifting(_only(mesh, mesh.part == Part.WING))
    if not len(wing.faces) or Part.FUSELAGE not in mesh.part:
        return mesh
    x_m = mesh.vertices_m[:, 0].astype(np.float64)
    nose_m, tail_m = x_m.max(), x_m.min()
    leading_m, trailing_m = wing.vertices_m[:, 0].max(), wing.vertices_m[:, 0].min()
    if nose_m - leading_m < 1e-3 or trailing_m - tail_m < 1e-3:  # a wing as long as the aircraft
        return mesh
    back_m = (1.0 - canard.tail) * (trailing_m - tail_m)
    # The wing and what is attached to it move back unchanged.
    knots_m = np.array([tail_m, trailing_m, leading_m, nose_m])
    moved_m = np.interp(x_m, knots_m, [tail_m, trailing_m - back_m, leading_m - back_m, nose_m])
    slope = np.diff([tail_m, trailing_m - back_m, leading_m - back_m, nose_m]) / np.diff(knots_m)
    normals = mesh.normals / np.stack([slope[np.digitize(x_m, knots_m[1:3])], np.ones(len(x_m)), np.ones(len(x_m))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices_m = np.column_stack([moved_m, mesh.vertices_m[:, 1:]]).astype(np.float32)
    longer = Mesh(vertices_m, normals.astype(np.float32), mesh.part, mesh.faces)
    body_m = vertices_m[mesh.part == Part.FUSELAGE]
    stands_m = leading_m - back_m + canard.nose * (nose_m - leading_m + back_m)
    near_m = body_m[np.argsort(np.abs(body_m[:, 0] - stands_m))[:40]]
    small = scaled(wing, [canard.chord, canard.span, canard.chord])
    middle_m = 0.5 * (small.vertices_m.min(axis=0) + small.vertices_m.max(axis=0))
    small = moved(small, [stands_m - middle_m[0], 0.0, 0.5 * (near_m[:, 2].min() + near_m[:, 2].max()) - middle_m[2]])
    rest = longer if canard.keeps_tail else _only(longer, longer.part != Part.TAIL)
    return merge([rest, small])


def _lifting(wing: Mesh) -> Mesh:
    """Only those surfaces of a wing that reach from the body to its tips, without fairings and struts."""
    if not len(wing.faces):
        return wing
    surface = np.arange(len(wing.vertices_m))
    while not np.array_equal(least := surface[wing.faces].min(axis=1), surface[wing.faces].max(axis=1)):
        np.minimum.at(surface, wing.faces, least[:, None])
    spans_m = {k: float(np.ptp(wing.vertices_m[surface == k, 1])) for k in np.unique(surface).tolist()}
    return _only(wing, np.isin(surface, [k for k, span_m in spans_m.items() if span_m > 0.6 * max(spans_m.values())]))


def bent(mesh: Mesh, slopes: tuple[float, float], ahead_behind: NDArray[np.float64]) -> Mesh:
    """The mesh with each point off the middle moved by `slopes` of its distance from there along x and z, and stretched
    ahead of the wings' middle and behind it by factors [2]. Connected parts stay connected, as all are bent alike.
    """
    vertices_m, normals = mesh.vertices_m.astype(np.float64), mesh.normals.astype(np.float64)
    wing = vertices_m[mesh.part == Part.WING] if Part.WING in mesh.part else vertices_m
    middle_x_m = 0.5 * (wing[:, 0].min() + wing[:, 0].max())
    factor = np.where(vertices_m[:, 0] > middle_x_m, *ahead_behind)
    x_m = middle_x_m + factor * (vertices_m[:, 0] - middle_x_m)
    beyond_m = np.abs(vertices_m[:, 1]) - CABIN_SHARE * np.ptp(vertices_m[:, 1])
    side = np.where(beyond_m > 0.0, np.sign(vertices_m[:, 1]), 0.0)
    along_x, along_z = slopes
    out_m = beyond_m.clip(min=0.0)
    bent_m = np.stack([x_m + along_x * out_m, vertices_m[:, 1], vertices_m[:, 2] + along_z * out_m], axis=1)
    nx, nz = normals[:, 0] / factor, normals[:, 2]
    turned = np.stack([nx, normals[:, 1] - side * (along_x * nx + along_z * nz), nz], axis=1)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return Mesh(bent_m.astype(np.float32), turned.astype(np.float32), mesh.part, mesh.faces)


def _only(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The marked vertices [V], and the faces between them."""
    number = np.cumsum(kept) - 1
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    return Mesh(
        mesh.vertices_m[kept], mesh.normals[kept], mesh.part[kept], number[faces].reshape(-1, 3).astype(np.int32)
    )
