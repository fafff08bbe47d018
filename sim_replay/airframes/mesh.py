"""Triangle meshes whose faces belong to parts of an aircraft. Pure NumPy.

Everything is in the target's body frame (FRD: x nose, y right, z down), metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
SLIVER = 2e-5  # a triangle thinner than this share of its length is dropped
Parts = NDArray[np.uint8]


class Part(IntEnum):
    """The part that a vertex belongs to; liveries colour by part. No face connects vertices of two parts."""

    FUSELAGE = 0
    WING = 1
    TAIL = 2
    GLASS = 3
    METAL = 4  # bare metal: exhausts, struts, cowling rings
    SENSOR = 5  # gimballed balls, pods, stores
    TYRE = 6  # black: tyres, de-icing boots, anti-glare panels, the depths of intakes and exhausts
    PROPELLER_DISC = 7


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in body FRD metres."""

    vertices_m: NDArray[np.float32]  # [V, 3]
    normals: NDArray[np.float32]  # [V, 3], unit, outward
    part: Parts  # [V], Part
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
    """The mesh stretched along the body axes by positive factors [3]; normals stay perpendicular."""
    factor = np.asarray(factor_xyz, dtype=np.float64)
    normals = mesh.normals / factor
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh((mesh.vertices_m * factor).astype(np.float32), normals.astype(np.float32), mesh.part, mesh.faces)


def moved(mesh: Mesh, by_m: ArrayLike) -> Mesh:
    """The mesh shifted by [3] metres."""
    return Mesh(
        (mesh.vertices_m + np.asarray(by_m, np.float64)).astype(np.float32), mesh.normals, mesh.part, mesh.faces
    )


def mirrored(mesh: Mesh) -> Mesh:
    """The part on the other side of the plane y = 0."""
    flip = np.array([1, -1, 1], dtype=np.float32)
    return Mesh(mesh.vertices_m * flip, mesh.normals * flip, mesh.part, mesh.faces[:, ::-1].copy())


def both_sides(*meshes: Mesh) -> Mesh:
    """Parts and their mirror images."""
    return merge([*meshes, *(mirrored(mesh) for mesh in meshes)])


def built(vertices: Array, faces: NDArray[np.int64], face_part: Part | Parts) -> Mesh:
    """A mesh with normals smoothed by area, its faces turned outward by the sign of the enclosed volume.

    vertices [V, 3], faces [F, 3]; face_part one Part or [F]. Faces without area are dropped. Normals are continuous
    across a border between parts; the vertices there are doubled, so that a flat-shaded part index is exact.
    """
    parts = np.broadcast_to(np.asarray(face_part, dtype=np.int64), len(faces))
    # Faces below single precision would have no normal after conversion to it.
    vertices = vertices.astype(np.float32).astype(np.float64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    longest = np.maximum.reduce([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))])
    kept = np.linalg.norm(normal, axis=1) > SLIVER * longest
    faces, parts, normal = faces[kept], parts[kept], normal[kept]
    centre = vertices.mean(axis=0)
    if np.sum(np.einsum("ij,ij->i", a[kept] - centre, np.cross(b[kept] - centre, c[kept] - centre))) < 0:
        faces, normal = faces[:, ::-1], -normal
    smooth = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(smooth, faces[:, k], normal)
    used, inverse = np.unique(faces * len(Part) + parts[:, None], return_inverse=True)
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    smooth = np.where(length > 1e-12, smooth / np.maximum(length, 1e-12), [0.0, 0.0, -1.0])
    return Mesh(
        vertices[used // len(Part)].astype(np.float32),
        smooth[used // len(Part)].astype(np.float32),
        (used % len(Part)).astype(np.uint8),
        inverse.reshape(-1, 3).astype(np.int32),
    )


def _zipped(points: int) -> NDArray[np.int64]:
    """Triangles [P - 2, 3] of a convex or two-sided ring of P points, zipped from its two ends."""
    triangles, i, j = [], 0, points - 1
    while j - i > 1:
        triangles.append((i, i + 1, j))
        i += 1
        if j - i > 1:
            triangles.append((i, j - 1, j))
            j -= 1
    return np.array(triangles, dtype=np.int64)


def loft(rings: Array, part: Part | Parts, caps: tuple[Part | None, Part | None] | None = None) -> Mesh:
    """A closed surface through rings [S, P, 3] with flat ends.

    part is one Part or one for each quad [S - 1, P]; `caps` are the parts of the two ends (by default the surface's
    own). The ends have their own vertices, so their edges stay sharp.
    """
    stations, points, _ = rings.shape
    quad_part = np.broadcast_to(np.asarray(part, np.uint8), (stations - 1, points))
    i, j = np.meshgrid(np.arange(stations - 1), np.arange(points), indexing="ij")
    nxt = (j + 1) % points
    p00, p01, p10, p11 = i * points + j, i * points + nxt, (i + 1) * points + j, (i + 1) * points + nxt
    faces = [np.stack([p00, p10, p11], -1).reshape(-1, 3), np.stack([p00, p11, p01], -1).reshape(-1, 3)]
    parts = [quad_part.reshape(-1), quad_part.reshape(-1)]
    end = _zipped(points)
    cap_parts = caps or (None, None)
    for k, (own, cap) in enumerate(zip((quad_part[0, 0], quad_part[-1, 0]), cap_parts, strict=True)):
        faces.append((end if k == 0 else end[:, ::-1]) + (stations + k) * points)
        parts.append(np.full(len(end), own if cap is None else cap, np.uint8))
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0], rings[-1]])
    return built(vertices, np.concatenate(faces), np.concatenate(parts))
