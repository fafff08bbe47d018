"""Rotation of one target: a filter on SO(3) with two hypotheses, one the depth reversal of the other.

Both have the same outline. Of a measured rotation and its reversal, the one nearer to the held hypothesis updates it,
so every frame contributes; log-odds state the confidence in the held hypothesis. They are the sum of a remembered part,
from the network's choices, and a part computed anew from the target's flight (`heading.py`). The held hypothesis is
switched only after the odds were against it for a while, so that the output does not flicker; the covariance always
includes the other one with its probability. Measurements that fit neither are rejected and counted.

If the target flies as its tail points in both, the network may have confused nose and tail, for which it has no word:
the covariance then includes that too.

Rotation errors are on the left: R = exp(theta) R_hat. Everything here is pure.

Frames of the same view have similar errors, so a share of the network's variance is never averaged out: it is modelled
as a constant error, included in the covariance but not estimated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge.tracking import so3
from edge.tracking.heading import Flight, flown_odds, network_opinion, reversal, reversed_covariance
from edge.tracking.motion import SOFT_GATE, STALE_ATTITUDE_RADPS, symmetric
from edge.tracking.view import View
from edge.types import Array, Estimate
from msgs.geometry import nearest_rotation

ROTATION_WALK = np.array([0.5, 0.2, 0.2])  # rad/s^0.5 about the target's roll, pitch and yaw axes: it rolls fastest
COMMON_SHARE = 0.6  # of the network's variance: the same error in all frames of the same view
MEMORY_S = 1.0  # time constant for the network's choices and its variance
NETWORK_WEIGHT = 2.0  # number of remembered frames whose choices count as independent
NETWORK_LOG_ODDS_MAX = 3.0  # limit of the network's part, so that the evidence of flight can outweigh it

SWITCH_LOG_ODDS = 1.0  # against the held rotation
SWITCH_AFTER_S = 0.2

TAIL_FIRST_PRIOR = 3.0  # log-odds against a network that confuses nose and tail

GATE_RAD = float(np.deg2rad(60.0))
ODD_FRAMES = 6  # in a row that fit neither hypothesis ("odd"): the last one is accepted
ODD_MEMORY = 30  # frames over which the share of odd ones is averaged


@dataclass(frozen=True)
class Attitude:
    """The filter's state, in the frame of the target's Motion."""

    R_frame_target: Array  # [3, 3], the held hypothesis
    P: Array  # [3, 3], assuming that it is the right one
    common: Array  # [3, 3], covariance of the error that all frames share
    picked: float = 0.0  # log-odds for the held rotation from the network's choices
    log_odds: float = 0.0  # from all evidence
    against_s: float = 0.0  # how long the odds have been against the held one
    tail_first: float = 0.0  # probability that nose and tail are confused
    odd_in_a_row: int = 0
    odd_share: float = 0.0  # exponentially averaged share of frames that fitted neither
    odd_w_target_rad: Array | None = None  # [3] from the held rotation to the last odd one, target axes


def begin(estimate: Estimate, view: View) -> Attitude:
    """The state after a first measurement."""
    along = unit(estimate.t_cam_target_m)
    log_odds, noise = network_opinion(estimate, along)
    R = view.R_frame_cam
    P = symmetric(R @ noise @ R.T)
    return Attitude(R @ estimate.R_cam_target, P, COMMON_SHARE * P, picked=min(log_odds, NETWORK_LOG_ODDS_MAX))


def propagate(attitude: Attitude, turn: Array, dt_s: float) -> Attitude:
    """The state dt_s later, after the target has turned by `turn` [3, 3] in the frame."""
    R = turn @ attitude.R_frame_target
    P = turn @ attitude.P @ turn.T + (R * (ROTATION_WALK**2 * dt_s)) @ R.T
    return replace(attitude, R_frame_target=R, P=symmetric(P))


def reframe(attitude: Attitude, R_new_old: Array, attitude_age_s: float) -> Attitude:
    """Transform to other axes, linked by an attitude that was measured `attitude_age_s` ago."""
    P = R_new_old @ attitude.P @ R_new_old.T + (STALE_ATTITUDE_RADPS * attitude_age_s) ** 2 * so3.IDENTITY
    common = R_new_old @ attitude.common @ R_new_old.T
    return replace(attitude, R_frame_target=R_new_old @ attitude.R_frame_target, P=symmetric(P), common=common)


def correct(attitude: Attitude, estimate: Estimate, view: View, dt_s: float) -> Attitude:
    """The state after a measurement, dt_s after the one before."""
    along = unit(estimate.t_cam_target_m)
    log_odds, noise = network_opinion(estimate, along)
    held_cam = view.R_frame_cam.T @ attitude.R_frame_target
    picked_cam, other_cam = estimate.R_cam_target, reversal(estimate.R_cam_target, along)
    # The cosine of the angle between two rotations increases with their elementwise inner product.
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
    """Squared Mahalanobis distance, 3 degrees of freedom, of the held rotation to a measured one or its reversal."""
    along = unit(estimate.t_cam_target_m)
    _, noise = network_opinion(estimate, along)
    held_cam = view.R_frame_cam.T @ attitude.R_frame_target
    S = view.R_frame_cam.T @ (attitude.P + attitude.common) @ view.R_frame_cam + noise
    both = (estimate.R_cam_target, reversal(estimate.R_cam_target, along))
    away = [so3.log(one @ held_cam.T) for one in both]
    return min(float(w @ np.linalg.solve(S, w)) for w in away)


def weighed(attitude: Attitude, along: Array, flight: Flight | None, dt_s: float, settled: bool) -> Attitude:
    """The state with its odds recomputed, switched to the other hypothesis if that is clearly better.

    `along` [3] is the unit line of sight in the frame; flight: None if nothing is known of the target's motion.
    Before a track is `settled` nothing of it was published, so the better hypothesis is taken at once.
    """
    other = reversal(attitude.R_frame_target, along)
    P = attitude.P + attitude.common
    log_odds, tail_first = attitude.picked, 0.0
    if flight is not None:
        flown, confused = flown_odds(attitude.R_frame_target, other, P, flight)
        log_odds, tail_first = log_odds + flown, _probability_confused(confused)
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
            tail_first=tail_first,
        )
    return replace(attitude, log_odds=log_odds, against_s=against_s, tail_first=tail_first)


def covariance(attitude: Attitude, along: Array) -> Array:
    """[3, 3], rad^2 in the frame, about the held rotation, including its reversal, the half turn that confuses nose and
    tail, and recent odd measurements.

    If another rotation, w away, is the true one with probability p, it adds p w w^T.
    """
    P = attitude.P + attitude.common
    w = so3.log(reversal(attitude.R_frame_target, along) @ attitude.R_frame_target.T)
    P += np.outer(w, w) / (1.0 + np.exp(np.clip(attitude.log_odds, -30.0, 30.0)))
    half_turn = np.pi * attitude.R_frame_target[:, 2]
    P += attitude.tail_first * np.outer(half_turn, half_turn)
    if attitude.odd_w_target_rad is not None:
        # As if two frames had to agree: a few odd frames count for little, a large majority almost fully.
        share = attitude.odd_share**2 / (attitude.odd_share**2 + (1.0 - attitude.odd_share) ** 2)
        odd = attitude.R_frame_target @ attitude.odd_w_target_rad
        P += share * np.outer(odd, odd)
    return symmetric(P)


def _probability_confused(log_odds: float) -> float:
    """That nose and tail are confused: none unless the flight speaks for it, as at the prior alone every target whose
    velocity is unknown would turn by as much as is left in doubt."""
    evidence = max(np.expm1(log_odds), 0.0)
    return float(evidence / (evidence + np.exp(TAIL_FIRST_PRIOR)))


def _odd(attitude: Attitude, w_target: Array, estimate: Estimate, view: View) -> Attitude:
    """The state after a rotation that fits neither, w_target [3] away: the last of ODD_FRAMES in a row is accepted."""
    in_a_row = attitude.odd_in_a_row + 1
    share = attitude.odd_share + (1.0 - attitude.odd_share) / ODD_MEMORY
    if in_a_row < ODD_FRAMES:
        return replace(attitude, odd_in_a_row=in_a_row, odd_share=share, odd_w_target_rad=w_target)
    return replace(begin(estimate, view), odd_share=min(1.0 - share, 0.5), odd_w_target_rad=-w_target)


def _corrected(attitude: Attitude, w: Array, noise: Array) -> Attitude:
    """The state after a rotation measured w [3] away with covariance `noise` [3, 3], part of it common to frames."""
    white = (1.0 - COMMON_SHARE) * noise
    S = attitude.P + white
    white = white * max(1.0, float(w @ np.linalg.solve(S, w)) / SOFT_GATE)
    gain = np.linalg.solve(attitude.P + white, attitude.P).T
    keep = so3.IDENTITY - gain
    P = symmetric(keep @ attitude.P @ keep.T + gain @ white @ gain.T)
    return replace(attitude, R_frame_target=nearest_rotation(so3.exp(gain @ w) @ attitude.R_frame_target), P=P)


def unit(vector: Array) -> Array:
    """The vector [3] scaled to length one."""
    return vector / np.linalg.norm(vector)
