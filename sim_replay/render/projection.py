"""Projects body points into the image: OpenCV's pinhole camera with its five-coefficient lens. Pure NumPy."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_replay.airframes import Part, airframe_of
from sim_replay.airframes.mesh import Mesh

Array = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]  # OpenCV's k1, k2, p1, p2, k3
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
NEAREST_VERTEX_M = 1.0
# Straight edges curve under distortion; pieces this short, as a share of the diameter, do not visibly.
LONGEST_EDGE = 1 / 40
FARTHEST_RADIUS2 = 25.0  # squared tangent of 79 degrees: wider than the field of view of any lens here


@cache
def vertices_m(airframe_id: int) -> Array:
    """All vertices [V, 3] of the airframe; read-only."""
    vertices = airframe_of(airframe_id).mesh().vertices_m.astype(np.float64)
    vertices.setflags(write=False)
    return vertices


@cache
def solid_vertices_m(airframe_id: int) -> Array:
    """Vertices [V, 3] of the airframe without its propeller disc, which no mask contains; read-only."""
    return _without_disc(airframe_of(airframe_id).mesh())


def _without_disc(mesh: Mesh) -> Array:
    vertices = mesh.vertices_m[mesh.part != Part.PROPELLER_DISC].astype(np.float64)
    vertices.setflags(write=False)
    return vertices


@cache
def fine_mesh(airframe_id: int) -> Mesh:
    """The airframe with edges halved until none is longer than LONGEST_EDGE of the diameter; the surface is the same.

    Halving the longest edge first avoids slivers, and every vertex of the airframe is kept.
    """
    airframe = airframe_of(airframe_id)
    mesh, longest_m = airframe.mesh(), airframe.diameter_m() * LONGEST_EDGE
    vertices, normals, part = mesh.vertices_m, mesh.normals, mesh.part
    done: list[NDArray[np.int32]] = []
    faces = mesh.faces
    while len(faces):
        length = np.stack(
            [np.linalg.norm(vertices[faces[:, k]] - vertices[faces[:, (k + 1) % 3]], axis=1) for k in range(3)], axis=1
        )
        keep = length.max(axis=1) <= longest_m
        done.append(faces[keep])
        faces, first = faces[~keep], length[~keep].argmax(axis=1)
        rows = np.arange(len(faces))
        a, b, c = (faces[rows, (first + k) % 3] for k in range(3))
        middle = np.arange(len(vertices), len(vertices) + len(faces), dtype=np.int32)
        vertices = np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])
        between = normals[a] + normals[b]
        between = between / np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-6)
        normals = np.concatenate([normals, between.astype(np.float32)])
        part = np.concatenate([part, part[a]])
        faces = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return Mesh(vertices, normals, part, np.concatenate(done))


@cache
def fine_solid_vertices_m(airframe_id: int) -> Array:
    """Vertices [V, 3] of `fine_mesh` without the propeller disc; read-only."""
    return _without_disc(fine_mesh(airframe_id))


def fold_radius2(distortion: Distortion) -> float:
    """Squared radius, normalised, beyond which the lens model is no longer monotonic and would fold the image."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(min(real.min(initial=FARTHEST_RADIUS2), FARTHEST_RADIUS2))


def distorted(points: ArrayLike, distortion: Distortion) -> Array:
    """Normalised image points [..., 2] through OpenCV's lens model; past the fold the radial factor stays as it is."""
    p = np.asarray(points, dtype=np.float64)
    k1, k2, p1, p2, k3 = distortion
    x, y = p[..., 0], p[..., 1]
    r2 = np.minimum(x * x + y * y, fold_radius2(distortion))
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([u, v], axis=-1)


def undistorted(points: ArrayLike, distortion: Distortion) -> Array:
    """The inverse of `distorted` for points [..., 2] inside the fold, by fixed-point iteration."""
    seen = np.asarray(points, dtype=np.float64)
    p = seen.copy()
    for _ in range(30):
        shift = distorted(p, distortion)
        p = p - (shift - seen)
    return p


def project_px(
    points_m: Array, R_cam_body: Array, t_cam_body_m: Array, K: Array, distortion: Distortion | None = None
) -> Array:
    """Body points [V, 3] to pixels [V, 2]; NaN for points less than a metre ahead of the camera."""
    cam = points_m @ R_cam_body.T + t_cam_body_m
    depth = np.where(cam[:, 2:] < NEAREST_VERTEX_M, np.nan, cam[:, 2:])
    plane = cam[:, :2] / depth
    if distortion is not None:
        plane = distorted(plane, distortion)
    return plane @ K[:2, :2].T + K[:2, 2]


def extents_px(pixels: Array) -> tuple[float, float, float, float] | None:
    """(x0, y0, x1, y1) of projected points [V, 2], or None if any lies behind the camera."""
    if not np.all(np.isfinite(pixels)):
        return None
    (x0, y0), (x1, y1) = pixels.min(axis=0), pixels.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def clip_from_cam(K: Array, x0: int, y0: int, width: int, height: int, near_m: float, far_m: float) -> Array:
    """[4, 4] projection of a crop at (x0, y0): pixel centres at integers, row 0 first in the framebuffer."""
    fx, fy, skew, cx, cy = K[0, 0], K[1, 1], K[0, 1], K[0, 2] - x0, K[1, 2] - y0
    depth = far_m - near_m
    return np.array(
        [
            [2 * fx / width, 2 * skew / width, 2 * (cx + 0.5) / width - 1, 0],
            [0, 2 * fy / height, 2 * (cy + 0.5) / height - 1, 0],
            [0, 0, (far_m + near_m) / depth, -2 * far_m * near_m / depth],
            [0, 0, 1, 0],
        ]
    )
