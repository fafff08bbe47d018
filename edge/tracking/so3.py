"""Single rotations in plain floats: many times as fast as the broadcasting functions of msgs.geometry. Pure."""

from __future__ import annotations

import math

import numpy as np

from edge.types import Array

IDENTITY = np.eye(3)
IDENTITY.setflags(write=False)
SMALL_RAD = 1e-4  # below it the series are exact to rounding


def skew(vector: Array) -> Array:
    """[3] to the [3, 3] matrix with skew(v) @ w = v x w."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(rotation_vector_rad: Array) -> Array:
    """A rotation vector [3] to its matrix [3, 3] (Rodrigues)."""
    x, y, z = rotation_vector_rad.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < SMALL_RAD:
        a, b = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    bx, by, bz = b * x, b * y, b * z
    return np.array(
        [
            [1.0 - by * y - bz * z, bx * y - a * z, bx * z + a * y],
            [bx * y + a * z, 1.0 - bx * x - bz * z, by * z - a * x],
            [bx * z - a * y, by * z + a * x, 1.0 - bx * x - by * y],
        ]
    )


def log(R: Array) -> Array:
    """A rotation matrix [3, 3] to its rotation vector [3], of length up to pi; well-conditioned up to there.

    By way of the quaternion, computed from its largest component (Shepperd's method).
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        w, x, y, z = 1.0 + trace, h - f, c - g, d - b
    elif largest == a:
        w, x, y, z = h - f, 1.0 + a - e - i, b + d, c + g
    elif largest == e:
        w, x, y, z = c - g, b + d, 1.0 - a + e - i, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1.0 - a - e + i
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if length < SMALL_RAD * w else 2.0 * math.atan2(length, w) / length
    return np.array([scale * x, scale * y, scale * z])


def turn(start: Array, end: Array) -> Array:
    """The rotation vector [3] of the shortest turn from one direction [3] to another; 0 between opposite ones."""
    across = skew(start) @ end
    sine = float(np.linalg.norm(across))
    return across * (math.atan2(sine, float(start @ end)) / sine if sine > 0.0 else 0.0)
