"""Triangle meshes of aircraft parts: lofts, lifting surfaces, discs, struts. Pure NumPy.

Everything is in the target's body frame (FRD: x nose, y right, z down), metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Part(IntEnum):
    """What a vertex belongs to; a livery colours by it."""

    FUSELAGE = 0
    WING = 1
    TAIL = 2
    GLASS = 3
    METAL = 4
    SENSOR = 5
    TYRE = 6
    PROPELLER_DISC = 7


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in body FRD metres."""

    vertices_m: NDArray[np.float32]  # [V, 3]
    normals: NDArray[np.float32]  # [V, 3], unit, outward
    part: NDArray[np.uint8]  # [V], Part
    faces: NDArray[np.int32]  # [F, 3], counter-clockwise seen from outside


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of many; vertices are kept in order."""
    starts = np.cumsum([0] + [len(m.vertices_m) for m in meshes])
    return Mesh(
        np.concatenate([m.vertices_m for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.part for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)]).astype(np.int32),
    )


def scaled(mesh: Mesh, factor_xyz: ArrayLike) -> Mesh:
    """The mesh stretched along the body axes by positive factors [3]; normals stay normal."""
    factor = np.asarray(factor_xyz, dtype=np.float64)
    normals = mesh.normals / factor
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh((mesh.vertices_m * factor).astype(np.float32), normals.astype(np.float32), mesh.part, mesh.faces)


def mirrored(mesh: Mesh) -> Mesh:
    """The part on the other side of the plane y = 0."""
    flip = np.array([1, -1, 1], dtype=np.float32)
    return Mesh(mesh.vertices_m * flip, mesh.normals * flip, mesh.part, mesh.faces[:, ::-1].copy())


def both_sides(mesh: Mesh) -> Mesh:
    """A part and its mirror image."""
    return merge([mesh, mirrored(mesh)])


def diameter_m(mesh: Mesh) -> float:
    """Largest distance between two vertices (BOP's `diameter`), metres."""
    points = mesh.vertices_m.astype(np.float64)
    squared = np.sum(points**2, axis=1)
    distance2 = squared[:, None] + squared[None, :] - 2.0 * points @ points.T
    return float(np.sqrt(distance2.max()))


def _face_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _build(vertices: Array, faces: NDArray[np.int64], part: Part) -> Mesh:
    """Smooth normals by area; faces turned outward by the sign of the enclosed volume."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    centre = vertices.mean(axis=0)
    volume = np.sum(np.einsum("ij,ij->i", a - centre, np.cross(b - centre, c - centre)))
    if volume < 0:
        faces = faces[:, ::-1]
    normals = np.zeros_like(vertices)
    face_normals = _face_normals(vertices, faces)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, -1.0])
    return Mesh(
        vertices.astype(np.float32),
        normals.astype(np.float32),
        np.full(len(vertices), part, np.uint8),
        faces.astype(np.int32),
    )


def loft(rings: Array, part: Part, wrap: bool = True) -> Mesh:
    """A capped surface through rings [S, P, 3]; `wrap` joins each ring's last point to its first.

    Caps have vertices of their own, so their edges stay sharp.
    """
    stations, points, _ = rings.shape
    i, j = np.meshgrid(np.arange(stations - 1), np.arange(points if wrap else points - 1), indexing="ij")
    nxt = (j + 1) % points
    p00, p01, p10, p11 = i * points + j, i * points + nxt, (i + 1) * points + j, (i + 1) * points + nxt
    quads = np.concatenate([np.stack([p00, p10, p11], -1).reshape(-1, 3), np.stack([p00, p11, p01], -1).reshape(-1, 3)])
    vertices = [rings.reshape(-1, 3)]
    faces = [quads]
    start = stations * points
    for ring, reverse in ((rings[0], False), (rings[-1], True)):
        k = np.arange(points)
        fan = np.stack([start + k, start + (k + 1) % points, np.full(points, start + points)], -1)
        faces.append(fan[:, ::-1] if reverse else fan)
        vertices += [ring, ring.mean(axis=0, keepdims=True)]
        start += points + 1
    return _build(np.concatenate(vertices), np.concatenate(faces), part)


def _smooth_interpolation(x_new: Array, x: Array, y: Array) -> Array:
    """Monotone cubic interpolation (Fritsch-Carlson, harmonic-mean slopes): no overshoot in a lofted body."""
    step, secant = np.diff(x), np.diff(y) / np.diff(x)
    slope = np.zeros_like(y)
    same_sign = secant[:-1] * secant[1:] > 0
    safe = np.where(same_sign, secant[:-1] + secant[1:], 1.0)
    slope[1:-1] = np.where(same_sign, 2.0 * secant[:-1] * secant[1:] / safe, 0.0)
    slope[0], slope[-1] = secant[0], secant[-1]
    k = np.clip(np.searchsorted(x, x_new, side="right") - 1, 0, len(step) - 1)
    t, h = (x_new - x[k]) / step[k], step[k]
    h00, h10 = (1 + 2 * t) * (1 - t) ** 2, t * (1 - t) ** 2
    h01, h11 = t * t * (3 - 2 * t), t * t * (t - 1)
    return h00 * y[k] + h10 * h * slope[k] + h01 * y[k + 1] + h11 * h * slope[k + 1]


def fuselage(
    stations: Sequence[tuple[float, float, float, float]],
    exponent: float = 2.2,
    part: Part = Part.FUSELAGE,
    y_m: float = 0.0,
    rings: int = 18,
    points: int = 14,
) -> Mesh:
    """A body of superellipse sections. Stations, nose to tail: (x, width, height, z of the centre), metres."""
    table = np.asarray(stations, dtype=np.float64)
    arc = np.linspace(0.0, 1.0, len(table))
    dense = np.unique(np.concatenate([np.linspace(0.0, 1.0, rings), arc]))
    x, width, height, z = (_smooth_interpolation(dense, arc, table[:, k]) for k in range(4))
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    cosine = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** (2.0 / exponent)
    sine = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** (2.0 / exponent)
    ring = np.stack(
        [
            np.broadcast_to(x[:, None], (len(x), points)),
            y_m + 0.5 * width[:, None] * cosine,
            z[:, None] + 0.5 * height[:, None] * sine,
        ],
        axis=-1,
    )
    return loft(ring, part)


def lifting_surface(
    sections: Sequence[tuple[float, float, float, float]], thickness: float = 0.12, part: Part = Part.WING
) -> Mesh:
    """A wing, tailplane or fin. Sections, root to tip: (x, y, z of the leading edge, chord), metres.

    The chord runs along -x; the aerofoil is a symmetric NACA four-digit section, `thickness` of the chord thick.
    """
    table = np.asarray(sections, dtype=np.float64)
    span = np.gradient(table[:, 1:3], axis=0)
    span /= np.linalg.norm(span, axis=1, keepdims=True)
    up = np.stack([np.zeros(len(table)), -span[:, 1], span[:, 0]], axis=1)
    c = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, 7)))
    half = 5.0 * thickness * (0.2969 * np.sqrt(c) - 0.1260 * c - 0.3516 * c**2 + 0.2843 * c**3 - 0.1036 * c**4)
    along = np.concatenate([c[::-1], c[1:]])
    across = np.concatenate([half[::-1], -half[1:]])
    chord = table[:, 3][:, None, None]
    rings = (
        table[:, None, :3]
        - chord * along[None, :, None] * np.array([1.0, 0.0, 0.0])
        + chord * across[None, :, None] * up[:, None, :]
    )
    return loft(rings, part, wrap=False)


def ellipsoid(centre_m: ArrayLike, semi_axes_m: ArrayLike, part: Part) -> Mesh:
    """An ellipsoid along the body axes: sensor balls, canopies, spinners, wheels."""
    latitude = np.linspace(-0.5 * np.pi + 0.05, 0.5 * np.pi - 0.05, 8)[:, None]
    longitude = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)[None, :]
    unit = np.stack(
        [
            np.broadcast_to(np.sin(latitude), (8, 10)),
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
        ],
        axis=-1,
    )
    return loft(np.asarray(centre_m) + unit * np.asarray(semi_axes_m), part)


def strut(start_m: ArrayLike, end_m: ArrayLike, width_m: float, part: Part = Part.METAL) -> Mesh:
    """A square bar between two points."""
    start, end = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.8 else [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    corners = 0.5 * width_m * np.array([side + up, up - side, -side - up, side - up])
    return loft(np.stack([start + corners, end + corners]), part)


def propeller_disc(centre_m: ArrayLike, radius_m: float) -> Mesh:
    """The disc that a turning propeller sweeps, normal to x; the renderer draws it nearly transparent."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = np.stack([np.zeros(24), np.cos(angle), np.sin(angle)], axis=-1) * radius_m
    centre = np.asarray(centre_m, dtype=np.float64)
    vertices = np.concatenate([rim, np.zeros((1, 3))]) + centre
    k = np.arange(24)
    faces = np.stack([k, (k + 1) % 24, np.full(24, 24)], axis=-1)
    normals = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (25, 1))
    return Mesh(
        vertices.astype(np.float32), normals, np.full(25, Part.PROPELLER_DISC, np.uint8), faces.astype(np.int32)
    )
