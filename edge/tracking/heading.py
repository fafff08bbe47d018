"""Towards the camera or away from it: evidence as log-odds.

At long range perspective is weak, so an aircraft that is symmetric left to right has the same outline as its depth
reversal, which heads away instead of towards the camera. A single image favours one of them only slightly. Each
function here evaluates one kind of evidence, as log-odds of a rotation against its reversal: the network's choice, the
direction of flight, and that aircraft fly upright and bank into their turns. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.tracking import so3
from edge.types import Array, Estimate

MIRRORED_WINGS = np.diag([1.0, -1.0, 1.0])
TAIL_FIRST = np.diag([-1.0, -1.0, 1.0])
NETWORK_STD_FLOOR_RAD = float(np.deg2rad(4.0))
GRAVITY_MPS2 = 9.81

# Relative to the air, an aircraft flies along its nose at about this speed.
AIRSPEED_MPS, AIRSPEED_STD_MPS = 28.0, 15.0
OWN_AIRSPEED_MPS, OWN_AIRSPEED_STD_MPS = 20.0, 10.0
WIND_STD_MPS = 5.0  # of each component, over ground
SLIP_STD_RAD = float(np.deg2rad(5.0))  # angle between the nose and the velocity relative to the air

BANK_STD_RAD = float(np.deg2rad(15.0))  # about that of a coordinated turn
PITCH_STD_RAD = float(np.deg2rad(8.0))  # about the climb angle
UNKNOWN_BANK_STD_RAD = float(np.deg2rad(30.0))  # if the turn rate is unknown
UNKNOWN_PITCH_STD_RAD = float(np.deg2rad(12.0))
TAIL_DOF = 4.0  # Student's t: aircraft do loop and slip occasionally
SPEED_MIN_MPS, SPEED_MAX_MPS = 12.0, 60.0
LOG_ODDS_MAX = 5.0  # limit for one kind of evidence


@dataclass(frozen=True)
class Flight:
    """What is known of a target's motion, in ned axes."""

    v_mps: Array  # [3], over ground, or relative to the own ship
    P_v: Array  # [3, 3]
    turn_rate_radps: float | None  # None: unknown, and so is the climb
    turn_rate_variance: float
    own_nose_ned: Array | None  # [3] if v_mps is relative to the own ship, which also flies along its nose


def reversal(R: Array, along: Array) -> Array:
    """The other rotation with the same outline: mirrored in depth (`along`: unit line of sight [3]) and left to right.

    R [3, 3] transforms target axes into those of `along`. The function is its own inverse.
    """
    return (so3.IDENTITY - 2.0 * np.outer(along, along)) @ R @ MIRRORED_WINGS


def reversed_covariance(P: Array, along: Array) -> Array:
    """Covariance [3, 3] of the reversal's error: as R' = M exp(w) R B = exp(-M w) M R B, it is mirrored by M."""
    mirror = so3.IDENTITY - 2.0 * np.outer(along, along)
    return mirror @ P @ mirror.T


def network_opinion(estimate: Estimate, along: Array) -> tuple[float, Array]:
    """(log-odds of the estimated rotation against its reversal, covariance [3, 3] in `cam` if it is the right one).

    The network, trained by likelihood, gives one sigma for both: with probability p of the reversal, w away, its
    variances are those about the right rotation plus p w w^T. p is the least-squares fit to its variances, at most 0.5.
    """
    variances = np.diag(estimate.covariance)[3:]
    spread = np.square(so3.log(reversal(estimate.R_cam_target, along) @ estimate.R_cam_target.T))
    p = float(np.clip((variances @ spread) / max(float(spread @ spread), 1e-9), np.exp(-LOG_ODDS_MAX), 0.5))
    about_it = np.maximum(variances - p * spread, NETWORK_STD_FLOOR_RAD**2)
    return float(np.log((1.0 - p) / p)), np.diag(about_it)


def flown_odds(R: Array, R_reversed: Array, P: Array, flight: Flight) -> tuple[float, float]:
    """Log-odds from the target's flight, of R and of a confusion; both [3, 3] into ned axes, P [3, 3] of either.

    The first are those of R against its reversal. The second are those of nose and tail being confused in both, the
    likelier of the two on each side: a network that has never seen a canard takes its foreplane for a tail.
    """
    both = np.stack([R, R_reversed])
    it, other, *confused = _log_flown(np.concatenate([both, both @ TAIL_FIRST]), P, flight)
    return _limited(it - other), _limited(max(confused) - max(it, other))


def _log_flown(R: Array, P: Array, flight: Flight) -> list[float]:
    """Log densities of the target's flight for each rotation of R [N, 3, 3] into ned axes, of covariance P [3, 3]."""
    along_nose, upright = _log_along_nose(R[..., 0], P, flight), _log_upright(R, P, flight)
    return [float(one) for one in along_nose + upright]


def _log_along_nose(nose: Array, P: Array, flight: Flight) -> Array:
    """Log densities [N] of the velocity if the target flies along its nose [N, 3]; speed and wind are marginalised."""
    v = flight.v_mps.copy()
    along = nose[:, :, None] * nose[:, None, :]
    slip = SLIP_STD_RAD**2 + float(np.trace(P)) / 3.0
    S = flight.P_v + WIND_STD_MPS**2 * so3.IDENTITY + AIRSPEED_STD_MPS**2 * along
    S += AIRSPEED_MPS**2 * slip * (so3.IDENTITY - along)
    if flight.own_nose_ned is not None:
        v += OWN_AIRSPEED_MPS * flight.own_nose_ned
        S += OWN_AIRSPEED_STD_MPS**2 * np.outer(flight.own_nose_ned, flight.own_nose_ned)
    residual = v - AIRSPEED_MPS * nose
    d2 = np.einsum("ni,ni->n", residual, np.linalg.solve(S, residual[..., None])[..., 0])
    return _log_tailed(d2, 3.0) - 0.5 * np.log(np.linalg.det(S))


def _log_upright(R: Array, P: Array, flight: Flight) -> Array:
    """Log densities [N], up to a constant, of bank and pitch of R [N, 3, 3] in ned axes."""
    pitch, bank = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0)), np.arctan2(R[:, 2, 1], R[:, 2, 2])
    rotation_variance = float(np.trace(P)) / 3.0
    if flight.turn_rate_radps is None:
        climb, turned = 0.0, 0.0
        pitch_variance, bank_variance = UNKNOWN_PITCH_STD_RAD**2, UNKNOWN_BANK_STD_RAD**2
    else:
        known = float(flight.v_mps @ flight.v_mps)
        # An unknown velocity must not be taken for slow flight.
        speed = min(max(math.sqrt(known + np.trace(flight.P_v) / 3.0), SPEED_MIN_MPS), SPEED_MAX_MPS)
        climb_variance = float(flight.P_v[2, 2]) / speed**2
        believed = PITCH_STD_RAD**2 / (PITCH_STD_RAD**2 + climb_variance)
        climb = -believed * min(max(float(flight.v_mps[2]) / speed, -0.5), 0.5)
        per_rate = speed / GRAVITY_MPS2
        turned = math.atan(per_rate * flight.turn_rate_radps)
        slope = per_rate / (1.0 + (per_rate * flight.turn_rate_radps) ** 2)
        pitch_variance = PITCH_STD_RAD**2 + believed * climb_variance
        bank_variance = BANK_STD_RAD**2 + slope**2 * flight.turn_rate_variance
    d2_pitch = (pitch - climb) ** 2 / (pitch_variance + rotation_variance)
    d2_bank = (bank - turned) ** 2 / (bank_variance + rotation_variance)
    return _log_tailed(d2_pitch, 1.0) + _log_tailed(d2_bank, 1.0)


def _log_tailed(d2: Array, dimensions: float) -> Array:
    return -0.5 * (TAIL_DOF + dimensions) * np.log1p(d2 / TAIL_DOF)


def _limited(log_odds: float) -> float:
    return min(max(log_odds, -LOG_ODDS_MAX), LOG_ODDS_MAX)
