"""How one target is turned: a filter on SO(3) that keeps two rotations open, one the depth reversal of the other.

Both have the same outline, so a frame's rotation is taken for whichever of the two it is nearer to, or its reversal is:
the filter stays on one side and measures every frame, and log-odds say how sure that side is. They have a part that
remembers what the network picks, and a part read anew from how the target flies (`heading.py`). The sides change only
when the odds have stood against the held one for a while, so that what is told does not flicker; until then, and
wherever the odds stay low, the covariance holds the other rotation too. What fits neither is left out and counted.

Errors of a rotation stand on the left: R = exp(theta) R_hat. Everything here is pure.

Frames of one sight err alike, so a share of the network's variance is never averaged away: it is a constant error that
is told but not estimated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge.tracking import so3
from edge.tracking.heading import Flight, flown_odds, network_opinion, reversal, reversed_covariance
from edge.tracking.motion import STALE_ATTITUDE_RADPS, symmetric
from edge.tracking.view import View
from edge.types import Array, Estimate

ROTATION_WALK = np.array([0.5, 0.2, 0.2])  # rad/s^0.5 about the target's roll, pitch and yaw axes: it rolls fastest
COMMON_SHARE = 0.6  # of the network's variance: the same error in all frames of one sight
MEMORY_S = 1.0  # over which the network's picks and its variance are remembered
NETWORK_WEIGHT = 2.0  # frames whose picks count as independent, of those remembered
NETWORK_LOG_ODDS_MAX = 3.0  # of those: less than what is seen of the flight can outweigh

SWITCH_LOG_ODDS = 1.0  # against the held rotation
SWITCH_AFTER_S = 0.2

SOFT_GATE = 11.34  # chi-square, 3 degrees of freedom, 99 %: beyond it a measurement's noise is raised to meet it
GATE_RAD = float(np.deg2rad(60.0))
ODD_FRAMES = 6  # in a row that fit neither rotation: theirs is taken
ODD_MEMORY = 30  # frames over which the share of such is counted


@dataclass(frozen=True)
class Attitude:
    """The filter's state, in the frame of the target's Motion."""

    R_frame_target: Array  # [3, 3], the held rotation
    P: Array  # [3, 3], as if it were the right one
    common: Array  # [3, 3], variance that all frames share
    picked: float = 0.0  # log-odds for the held rotation by the network's picks
    log_odds: float = 0.0  # by all evidence
    against_s: float = 0.0  # how long it has stood against the held one
    odd_in_a_row: int = 0
    odd_share: float = 0.0  # of the last ODD_MEMORY frames, fading: those that fitted neither
    odd_w_target_rad: Array | None = None  # [3] from the held rotation to the last such, target axes


def begin(estimate: Estimate, view: View) -> Attitude:
    """The state after a first measurement."""
    along = unit(estimate.t_cam_target_m)
    log_odds, noise = network_opinion(estimate, along)
    R = view.R_frame_cam
    P = symmetric(R @ noise @ R.T)
    return Attitude(R @ estimate.R_cam_target, P, COMMON_SHARE * P, picked=min(log_odds, NETWORK_LOG_ODDS_MAX))


def propagate(attitude: Attitude, turn: Array, dt_s: float) -> Attitude:
    """The state dt_s later, when the target has turned by `turn` [3, 3] in the frame."""
    R = turn @ attitude.R_frame_target
    P = turn @ attitude.P @ turn.T + (R * (ROTATION_WALK**2 * dt_s)) @ R.T
    return replace(attitude, R_frame_target=R, P=symmetric(P))


def reframe(attitude: Attitude, R_new_old: Array, attitude_age_s: float) -> Attitude:
    """The same target in other axes, which an attitude links that was measured `attitude_age_s` ago."""
    P = R_new_old @ attitude.P @ R_new_old.T + (STALE_ATTITUDE_RADPS * attitude_age_s) ** 2 * so3.IDENTITY
    common = R_new_old @ attitude.common @ R_new_old.T
    return replace(attitude, R_frame_target=R_new_old @ attitude.R_frame_target, P=symmetric(P), common=common)


def correct(attitude: Attitude, estimate: Estimate, view: View, dt_s: float) -> Attitude:
    """The state after a measurement, dt_s after the one before."""
    along = unit(estimate.t_cam_target_m)
    log_odds, noise = network_opinion(estimate, along)
    held_cam = view.R_frame_cam.T @ attitude.R_frame_target
    picked_cam, other_cam = estimate.R_cam_target, reversal(estimate.R_cam_target, along)
    # The cosine of the angle between rotations rises with the sum of their products.
    agrees = bool(np.vdot(held_cam, picked_cam) >= np.vdot(held_cam, other_cam))
    fitting = picked_cam if agrees else other_cam
    w = so3.log(fitting @ held_cam.T)
    if np.linalg.norm(w) > GATE_RAD:
        return _odd(attitude, held_cam.T @ so3.log(picked_cam @ held_cam.T), estimate, view)
    noise = view.R_frame_cam @ (noise if agrees else reversed_covariance(noise, along)) @ view.R_frame_cam.T
    fade = float(np.exp(-dt_s / MEMORY_S))
    opinion = min(NETWORK_WEIGHT * log_odds, NETWORK_LOG_ODDS_MAX) * (1.0 if agrees else -1.0)
    return replace(
        _corrected(attitude, view.R_frame_cam @ w, noise),
        common=symmetric(fade * attitude.common + (1.0 - fade) * COMMON_SHARE * noise),
        picked=fade * attitude.picked + (1.0 - fade) * opinion,
        odd_in_a_row=0,
        odd_share=attitude.odd_share * (1.0 - 1.0 / ODD_MEMORY),
    )


def disagreement_d2(attitude: Attitude, estimate: Estimate, view: View) -> float:
    """Squared Mahalanobis distance, 3 degrees of freedom, of a measured rotation or its reversal from the held one."""
    along = unit(estimate.t_cam_target_m)
    _, noise = network_opinion(estimate, along)
    held_cam = view.R_frame_cam.T @ attitude.R_frame_target
    S = view.R_frame_cam.T @ (attitude.P + attitude.common) @ view.R_frame_cam + noise
    both = (estimate.R_cam_target, reversal(estimate.R_cam_target, along))
    away = [so3.log(one @ held_cam.T) for one in both]
    return min(float(w @ np.linalg.solve(S, w)) for w in away)


def weighed(attitude: Attitude, along: Array, flight: Flight | None, dt_s: float, settled: bool) -> Attitude:
    """The state with its odds read anew, held on the other side if that is clearly the better one.

    `along` [3] is the unit sight line in the frame; flight: None where nothing is known of the target's way.
    Before a track is `settled` nothing was told of it, and the better side is taken at once.
    """
    other = reversal(attitude.R_frame_target, along)
    P = attitude.P + attitude.common
    log_odds = attitude.picked
    if flight is not None:
        log_odds += flown_odds(attitude.R_frame_target, other, P, flight)
    against_s = attitude.against_s + dt_s if log_odds < -SWITCH_LOG_ODDS else 0.0
    if against_s > SWITCH_AFTER_S or (not settled and log_odds < 0.0):
        return replace(
            attitude,
            R_frame_target=other,
            P=symmetric(reversed_covariance(attitude.P, along)),
            common=symmetric(reversed_covariance(attitude.common, along)),
            picked=-attitude.picked,
            log_odds=-log_odds,
            against_s=0.0,
        )
    return replace(attitude, log_odds=log_odds, against_s=against_s)


def covariance(attitude: Attitude, along: Array) -> Array:
    """[3, 3], rad^2 in the frame, about the held rotation: with the chance of its reversal, and of others seen lately.

    If another rotation, w away, is the true one with probability p, the error spreads by p w w^T.
    """
    P = attitude.P + attitude.common
    w = so3.log(reversal(attitude.R_frame_target, along) @ attitude.R_frame_target.T)
    P += np.outer(w, w) / (1.0 + np.exp(np.clip(attitude.log_odds, -30.0, 30.0)))
    if attitude.odd_w_target_rad is not None:
        # As if two frames had to agree: one odd frame says little, as many as not say all.
        share = attitude.odd_share**2 / (attitude.odd_share**2 + (1.0 - attitude.odd_share) ** 2)
        odd = attitude.R_frame_target @ attitude.odd_w_target_rad
        P += share * np.outer(odd, odd)
    return symmetric(P)


def _odd(attitude: Attitude, w_target: Array, estimate: Estimate, view: View) -> Attitude:
    """The state after a rotation that fits neither, w_target [3] away: the last of ODD_FRAMES in a row is taken."""
    in_a_row = attitude.odd_in_a_row + 1
    share = attitude.odd_share + (1.0 - attitude.odd_share) / ODD_MEMORY
    if in_a_row < ODD_FRAMES:
        return replace(attitude, odd_in_a_row=in_a_row, odd_share=share, odd_w_target_rad=w_target)
    return replace(begin(estimate, view), odd_share=min(1.0 - share, 0.5), odd_w_target_rad=-w_target)


def _corrected(attitude: Attitude, w: Array, noise: Array) -> Attitude:
    """The state after a rotation measured w [3] away, with covariance `noise` [3, 3] of which a share is common."""
    white = (1.0 - COMMON_SHARE) * noise
    S = attitude.P + white
    white = white * max(1.0, float(w @ np.linalg.solve(S, w)) / SOFT_GATE)
    gain = np.linalg.solve(attitude.P + white, attitude.P).T
    keep = so3.IDENTITY - gain
    P = symmetric(keep @ attitude.P @ keep.T + gain @ white @ gain.T)
    return replace(attitude, R_frame_target=_orthonormal(so3.exp(gain @ w) @ attitude.R_frame_target), P=P)


def unit(vector: Array) -> Array:
    """Of length one [3]."""
    return vector / np.linalg.norm(vector)


def _orthonormal(R: Array) -> Array:
    u, _, vt = np.linalg.svd(R)
    return u @ vt
