"""Aircraft that nobody built: the fleet's parts exchanged, stretched and resized, for training alone.

A network that has only seen the fleet takes every stranger for the member that looks most like it, and is as sure of
its size. Numbers from `len(AIRFRAMES)` on mean such aircraft; they never occur in a dataset's labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from sim_replay.airframes.fleet import AIRFRAMES, Airframe
from sim_replay.airframes.mesh import Mesh, Part, merge, moved, scaled

VARIANTS = 4  # of each pair of members of the fleet; a renderer keeps all that it has drawn
SIZE_SIGMA = 0.35  # of the logarithm of span and length together
STRETCH = 0.22  # of the logarithm, either way, of length, span and height alone
SPAN_M = (1.5, 26.0)
EXCHANGED_SHARE = 0.6
_EXCHANGEABLE = (Part.WING, Part.TAIL)


def airframe_of(airframe_id: int) -> Airframe:
    """A member of the fleet, or beyond its end an invented aircraft. Raises IndexError beyond the last of those."""
    if airframe_id < len(AIRFRAMES):
        return AIRFRAMES[airframe_id]
    return _invented(airframe_id)


def draw_invented(rng: np.random.Generator, airframe_ids: Sequence[int]) -> int:
    """The number of an invented aircraft that is made of parts of these members of the fleet alone."""
    base, donor = (int(rng.choice(np.asarray(airframe_ids))) for _ in range(2))
    fleet = len(AIRFRAMES)
    return fleet + (int(rng.integers(VARIANTS)) * fleet + donor) * fleet + base


@cache
def _invented(airframe_id: int) -> Airframe:
    fleet = len(AIRFRAMES)
    rest, base = divmod(airframe_id - fleet, fleet)
    variant, donor = divmod(rest, fleet)
    if variant >= VARIANTS:
        raise IndexError(f"there is no airframe {airframe_id}")
    rng = np.random.default_rng([variant, donor, base])
    original, other = AIRFRAMES[base], AIRFRAMES[donor]
    exchanged = [part for part in _EXCHANGEABLE if base != donor and rng.random() < EXCHANGED_SHARE]
    stretch = np.exp(rng.uniform(-STRETCH, STRETCH, 3))
    low, high = np.log(np.array(SPAN_M) / (original.span_m * stretch[1]))
    size = float(np.exp(np.clip(rng.normal(0.0, SIZE_SIGMA), low, high)))

    def build() -> Mesh:
        mesh = original.mesh()
        for part in exchanged:
            mesh = _with_part_of(mesh, other.mesh(), part)
        return scaled(mesh, size * stretch)

    extent = np.ptp(build().vertices_m, axis=0)
    return Airframe(
        f"invented_{airframe_id}",
        f"{original.name} with parts of {other.name}, stretched",
        float(extent[1]),
        float(extent[0]),
        "no such aircraft exists",
        build,
    )


def _with_part_of(mesh: Mesh, other: Mesh, part: Part) -> Mesh:
    """The mesh with the other's part in the place of its own, fitted to its span; unchanged if either has none."""
    own, theirs = _only(mesh, mesh.part == part), _only(other, other.part == part)
    if not len(own.faces) or not len(theirs.faces):
        return mesh
    ratio = np.ptp(own.vertices_m[:, 1]) / max(float(np.ptp(theirs.vertices_m[:, 1])), 1e-3)
    # A span of next to nothing is a lone fin's: its height tells the size.
    if not 0.2 < ratio < 5.0:
        ratio = np.ptp(own.vertices_m[:, 2]) / max(float(np.ptp(theirs.vertices_m[:, 2])), 1e-3)
    fitted = scaled(theirs, [float(np.clip(ratio, 0.2, 5.0))] * 3)
    middle = [0.5 * (m.vertices_m.min(axis=0) + m.vertices_m.max(axis=0)) for m in (own, fitted)]
    by_m = middle[0] - middle[1]
    by_m[1] = 0.0
    return merge([_only(mesh, mesh.part != part), moved(fitted, by_m)])


def _only(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The vertices [V] marked, and the faces between them."""
    number = np.cumsum(kept) - 1
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    return Mesh(
        mesh.vertices_m[kept], mesh.normals[kept], mesh.part[kept], number[faces].reshape(-1, 3).astype(np.int32)
    )
