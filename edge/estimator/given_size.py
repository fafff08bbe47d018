"""Depth of an aircraft whose wingspan and length are given, from how large it appears and how it is turned. Pure.

The network infers an aircraft's size from its appearance, rightly for those that it was trained on, wrongly for most
others. Two numbers of a data sheet replace that: the box of the image, the rotation and the size give the depth, apart
from the aircraft's shape. The result is combined with the network's own depth, which is the better one if the network
knows the aircraft; how well the two agree tells whether it does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.tracking import so3
from edge.types import Array

# An aircraft's box in any orientation: its side along an image axis is the p-norm of the body axes' shares of that
# axis times these extents, of the length, the wingspan and (for the height) the length again. Fitted to the outlines of
# 80 generated aircraft, then made 3 % smaller, as the shipped model's boxes are on the validation split.
EXTENTS = np.array([1.02, 0.98, 0.25])
ROUNDNESS = 2.5
SHAPE_SIGMA = 0.07  # of log depth: what an aircraft of this size may look larger or smaller for its shape
TURN_MAX_RAD = 0.5  # larger errors of rotation than this are not a matter of derivatives
# The network's own log depth, of sigma s, is a mixture (docs/tracker.md, the table of known and strange aircraft): with
# the probability 1 / (1 + (s / EVEN_SIGMA) ** STEEPNESS) it knows the aircraft and errs by KNOWN_SHARE * s, else by s,
# but at least by STRANGE_SIGMA, the largest of that table.
EVEN_SIGMA, STEEPNESS = 0.18, 2.7
KNOWN_SHARE, KNOWN_SIGMA_MIN = 0.25, 0.02
STRANGE_SIGMA = 0.45
# Probability that the given size is not this aircraft's, and the width of log depth that it then may lie in: a factor
# of twenty.
WRONG_SHARE, WRONG_WIDTH = 0.03, 3.0
# Probability of that from which on it is told of: a size in feet then is in nine of ten frames of a known aircraft, the
# right size of a strange one in one of a hundred.
CONTRADICTED_FROM = 0.3


@dataclass(frozen=True)
class TargetSize:
    """What a data sheet tells of an aircraft."""

    wingspan_m: float
    length_m: float


class Depth(NamedTuple):
    """A normal distribution of log Z."""

    log_z: float
    variance: float


class Combined(NamedTuple):
    """Log Z by appearance and size together."""

    depth: Depth
    contradicted: bool  # the aircraft may well not be of the given size


def depth_by_size(
    size: TargetSize, R_cam_target: Array, plane_xy: Array, sides: Array, sigma_rotation_rad: Array
) -> Depth:
    """Log Z of the aircraft at `plane_xy` [2] = (x/z, y/z) whose upright box has `sides` [2], both in units of Z.

    The variance includes the shape's and that of the rotation, of `sigma_rotation_rad` [3] about the axes of cam.
    """
    extents_m = EXTENTS * [size.length_m, size.wingspan_m, size.length_m]

    def log_sides_m(R: Array) -> Array:
        # A point x of the body appears at R x / Z, less what its own depth moves it towards the image's centre.
        axes = R[:2] - np.outer(plane_xy, R[2])
        return np.asarray(np.log(np.sum(np.abs(axes * extents_m) ** ROUNDNESS, axis=1)) / ROUNDNESS)

    log_m = log_sides_m(R_cam_target)
    # The longer side tells more: the shorter one depends on what no data sheet tells.
    shares = np.exp(2.0 * log_m) / np.sum(np.exp(2.0 * log_m))
    turns = np.minimum(sigma_rotation_rad, TURN_MAX_RAD)
    moved = [
        [shares @ (log_sides_m(so3.exp(sign * turn * axis) @ R_cam_target) - log_m) for sign in (-1.0, 1.0)]
        for turn, axis in zip(turns, np.eye(3), strict=True)
    ]
    variance = SHAPE_SIGMA**2 + float(np.mean(np.square(moved), axis=1).sum())
    return Depth(float(shares @ (log_m - np.log(sides))), variance)


def combined(appearance: Depth, by_size: Depth) -> Combined:
    """Mean and variance over the three cases: the network knows the aircraft, it does not, the given size is wrong."""
    sigma = np.sqrt(appearance.variance)
    known = 1.0 / (1.0 + (sigma / EVEN_SIGMA) ** STEEPNESS)
    variances = np.array([max(KNOWN_SHARE * sigma, KNOWN_SIGMA_MIN), max(sigma, STRANGE_SIGMA)]) ** 2
    apart = variances + by_size.variance
    off2 = (appearance.log_z - by_size.log_z) ** 2
    likely = np.array([known, 1.0 - known]) * np.exp(-0.5 * off2 / apart) / np.sqrt(2.0 * np.pi * apart)
    weights = np.array([*((1.0 - WRONG_SHARE) * likely), WRONG_SHARE / WRONG_WIDTH])
    weights /= weights.sum()
    fused = (appearance.log_z * by_size.variance + by_size.log_z * variances) / apart
    means = np.array([*fused, appearance.log_z])
    spread = np.array([*(variances * by_size.variance / apart), appearance.variance])
    mean = float(weights @ means)
    return Combined(Depth(mean, float(weights @ (spread + (means - mean) ** 2))), bool(weights[2] > CONTRADICTED_FROM))
