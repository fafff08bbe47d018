"""Nose or tail towards us? Outlines cannot say; that a fixed-wing aircraft flies nose first can.

At long range perspective is weak, so an aircraft that is symmetric left to right has the same outline as its depth
reversal: the same turned about, heading away instead of towards. A single picture often leaves both open. Its track
does not: the nose lies on the side of the sight line that the aircraft flies to.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.types import Array, Estimate

WIND_MPS = 5.0  # a nose may point against the ground track's sight-line component by this much
SIGMAS = 2.0  # the component's sign must be this sure
ACROSS = float(np.sin(np.deg2rad(10.0)))  # a nose this near to across the sight line has no side
MIRRORED_WINGS = np.diag([1.0, -1.0, 1.0])


def flown_nose_first(estimate: Estimate, v_cam_mps: Array, v_covariance: Array) -> Estimate:
    """The estimate, or its depth reversal if only that flies where the track goes.

    v_cam_mps [3] is the target's velocity over ground in `cam`, v_covariance [3, 3] its covariance.
    """
    along = estimate.t_cam_target_m / np.linalg.norm(estimate.t_cam_target_m)
    opening_mps = float(along @ v_cam_mps)
    std_mps = float(np.sqrt(max(float(along @ v_covariance @ along), 0.0)))
    nose = float(along @ estimate.R_cam_target[:, 0])
    sure = abs(opening_mps) > WIND_MPS + SIGMAS * std_mps
    if not sure or abs(nose) < ACROSS or nose * opening_mps > 0.0:
        return estimate
    return depth_reversed(estimate, along)


def depth_reversed(estimate: Estimate, along: Array) -> Estimate:
    """The other rotation of the same outline: mirrored in depth, `along` the unit sight line [3], and left to right."""
    mirror = np.eye(3) - 2.0 * np.outer(along, along)
    R = mirror @ estimate.R_cam_target @ MIRRORED_WINGS
    # R' = mirror exp(w) R B = exp(-mirror w) mirror R B: errors turn with the mirror.
    turn = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), -mirror]])
    return replace(estimate, R_cam_target=R, covariance=turn @ estimate.covariance @ turn.T)
