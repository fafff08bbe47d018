"""Position and motion of one target: an EKF over position, velocity and turn rate. Pure.

The state is kept in one of three frames, depending on what is known of the own ship:
    ned           attitude and position: coordinated turn about the vertical
    ned_relative  attitude only: ned axes, origin at the own ship; constant relative velocity
    cam           neither: camera axes; the line of sight turns, and range changes, at constant rates
Innovations are always computed in `cam`, where the measurement covariance is given. The rotation has its own filter
(`rotation.py`): as it may be the depth reversal of the true one, it must not influence the turn rate.

The network misjudges the range of one target by nearly the same factor in all frames (`range_scale.py`), and averaging
frames does not reduce that error. The state holds ranges as measured, so P covers only the other errors; the variance
of the common factor is added on output (`covariance`). Range is compared and corrected by its logarithm: otherwise
frames that read short would weigh more than frames that read far. Directions are compared and corrected by angle. The
constants below are tuning choices for fixed-wing aircraft at 100-500 m, not measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge.tracking import so3
from edge.tracking.boxes import RANGE_MIN_M
from edge.tracking.range_scale import RangeScale, corrected, in_metres, rates_of
from edge.tracking.view import NS_PER_S, FrameKind, View, between
from edge.types import Array, Estimate

POSITION, VELOCITY = slice(0, 3), slice(3, 6)
TURN_RATE = 6
DIMENSION = 7

# Process noise, square roots of spectral densities.
ACCELERATION = {"ned": 3.0, "ned_relative": 6.0}  # m/s^1.5; relative: the own ship manoeuvres too
VERTICAL_SHARE = 0.5  # of that, for the vertical axis
APPARENT_ACCELERATION = 0.3  # rad/s^1.5 times range: the camera's own turning, not separable in `cam`
# In `cam`, along the line of sight: a target passing at this speed, not seen to pass if the camera follows it, has the
# range acceleration v^2 / range for about the time range / v.
PASSING_SPEED_MPS = 60.0
TURN_RATE_WALK = 0.1  # rad/s^1.5

# Initial uncertainty of what one measurement does not determine.
SPEED_STD_MPS = 80.0  # wide: a narrow one biases ranges towards those at which the target would be slow
CLIMB_STD_MPS = 12.0
APPARENT_RATE_STD = 0.5  # rad/s times range
TURN_RATE_STD = 0.2  # rad/s
TURN_RATE_MAX = 1.0  # rad/s

# Added to each measurement: errors that the network's sigma does not include.
MODEL_BEARING_PX = 1.0
MODEL_LOG_RANGE = 0.01
FIRST_SHARE = 0.2  # of the network's log-range variance, in P after a first frame

UNKNOWN_LOG_RANGE_STD = 1.0

# A change of frame uses the last known attitude; its standard deviation grows by this per second.
STALE_ATTITUDE_RADPS = 0.5

SHORTEST_S = 1e-3  # between measurements
SOFT_GATE = 11.34  # chi-square, 3 degrees of freedom, 99 %: beyond it a measurement's noise is inflated


@dataclass(frozen=True)
class Motion:
    """The filter's state at one instant, in the frame `kind`."""

    kind: FrameKind
    time_ns: int
    seen_ns: int  # of the last measurement
    t_m: Array  # [3] target origin in the frame
    v_mps: Array  # [3]
    turn_rate_radps: float  # about ned's down axis, right turns positive; 0 outside `ned`
    P: Array  # [7, 7], order (t, v, turn rate), without the range error that all frames share
    scale: RangeScale
    sight: Sight | None = None  # of a measurement at exactly this time


@dataclass(frozen=True)
class Sight:
    """The target in `cam` in the frame that detected it: more accurate than the state transformed into that frame, as
    that frame's attitude error does not enter."""

    t_cam_m: Array  # [3]
    covariance: Array  # [3, 3], without the range error that all frames share


@dataclass(frozen=True)
class Innovation:
    """Measured minus predicted position, in `cam`."""

    residual_m: Array  # [3], range times: along the ray the difference of log ranges, across it the angle
    predicted_m: Array  # [3]
    predicted_covariance: Array  # [3, 3], without the frame's attitude error
    attitude: Array  # [3, 3], covariance due to that error
    across: Array  # [3, 3], the measurement's covariance without that of its range
    log_range_variance: float  # the network's own


def begin(estimate: Estimate, K: Array, view: View) -> Motion:
    """The state after a first measurement."""
    across, log_range_variance = _measurement_noise(estimate, K)
    across += view.aim_covariance(estimate.t_cam_target_m)
    R = view.R_frame_cam
    ray = R @ estimate.t_cam_target_m
    scale = RangeScale.begin(view.time_ns, 0.5 * float(np.log(ray @ ray)), log_range_variance)
    P = np.zeros((DIMENSION, DIMENSION))
    P[POSITION, POSITION] = R @ across @ R.T + FIRST_SHARE * log_range_variance * np.outer(ray, ray)
    P = _unknown_velocity(P, view.kind, float(np.linalg.norm(ray)))
    t_m = view.t_frame_cam_m + ray
    return Motion(view.kind, view.time_ns, view.time_ns, t_m, np.zeros(3), 0.0, symmetric(P), scale)


def unknown_motion(motion: Motion, view: View) -> Motion:
    """The same position with unknown velocity and turn rate; `view` is in the motion's frame."""
    P = np.zeros((DIMENSION, DIMENSION))
    P[POSITION, POSITION] = motion.P[POSITION, POSITION]
    P = _unknown_velocity(P, motion.kind, float(np.linalg.norm(motion.t_m - view.t_frame_cam_m)))
    return replace(motion, v_mps=np.zeros(3), turn_rate_radps=0.0, P=P, scale=motion.scale.alone())


def unknown_range(motion: Motion, view: View) -> Motion:
    """The same direction at an unknown range; `view` is in the motion's frame."""
    ray = motion.t_m - view.t_frame_cam_m
    P = motion.P.copy()
    P[POSITION, POSITION] += UNKNOWN_LOG_RANGE_STD**2 * np.outer(ray, ray)
    return replace(motion, P=P, sight=None)


def turning(motion: Motion, time_ns: int) -> Array:
    """[3, 3], the rotation by which the target turns from the motion's time to a later one."""
    return so3.exp((time_ns - motion.time_ns) / NS_PER_S * _turning_radps(motion))


def propagate(motion: Motion, time_ns: int) -> Motion:
    """The state at a later time; for an earlier time it is returned unchanged."""
    dt = (time_ns - motion.time_ns) / NS_PER_S
    if dt <= 0.0:
        return motion
    turn = turning(motion, time_ns)
    v = turn @ motion.v_mps

    F = np.eye(DIMENSION)
    F[POSITION, VELOCITY] = 0.5 * dt * (so3.IDENTITY + turn)
    F[VELOCITY, VELOCITY] = turn
    if motion.kind == "ned":
        v_by_turn = dt * np.array([-v[1], v[0], 0.0])
        F[VELOCITY, TURN_RATE] = v_by_turn
        F[POSITION, TURN_RATE] = 0.5 * dt * v_by_turn

    Q = np.zeros((DIMENSION, DIMENSION))
    density = _acceleration_density(motion)
    Q[POSITION, POSITION] = dt**3 / 3.0 * density
    Q[POSITION, VELOCITY] = Q[VELOCITY, POSITION] = dt**2 / 2.0 * density
    Q[VELOCITY, VELOCITY] = dt * density
    Q[TURN_RATE, TURN_RATE] = TURN_RATE_WALK**2 * dt if motion.kind == "ned" else 0.0
    return replace(
        motion,
        time_ns=time_ns,
        t_m=motion.t_m + 0.5 * dt * (motion.v_mps + v),
        v_mps=v,
        P=symmetric(F @ motion.P @ F.T + Q),
        sight=None,
    )


def reframe(motion: Motion, old: View, new: View, attitude_age_s: float) -> Motion:
    """Transform to the frame of `new`; `old` is the camera in the motion's frame, both at the motion's time.

    `attitude_age_s`: age of the attitude that links the frames.
    """
    through_cam = old.linked_by_cam(new)
    R_new_old = between(old, new)
    relative_m = R_new_old @ (motion.t_m - old.t_frame_cam_m)
    zero = np.zeros(3)
    v_old = zero if old.v_frame_cam_mps is None else old.v_frame_cam_mps
    v_new = zero if new.v_frame_cam_mps is None else new.v_frame_cam_mps

    T = np.eye(DIMENSION)
    T[POSITION, POSITION] = T[VELOCITY, VELOCITY] = R_new_old
    T[TURN_RATE, TURN_RATE] = 0.0
    P = T @ motion.P @ T.T
    P[TURN_RATE, TURN_RATE] = TURN_RATE_STD**2 if new.kind == "ned" else 0.0
    if through_cam or old.v_frame_cam_mps is None or new.v_frame_cam_mps is None:
        P[VELOCITY, VELOCITY] += _first_velocity("cam", float(np.linalg.norm(relative_m)))
    if through_cam:
        across = so3.skew(relative_m)
        P[POSITION, POSITION] += (STALE_ATTITUDE_RADPS * attitude_age_s) ** 2 * across @ across.T
    return replace(
        motion,
        kind=new.kind,
        t_m=relative_m + new.t_frame_cam_m,
        v_mps=R_new_old @ (motion.v_mps - v_old) + v_new,
        turn_rate_radps=0.0,
        P=symmetric(P),
    )


def untangled(motion: Motion, view: View) -> Motion:
    """The state with range and range rate decorrelated from all else, so that bearings do not change the range.

    Parallax could give range, but needs the target's speed, own position to decimetres, and a filter that is linear
    over all possible ranges; a Cartesian one infers ranges from noise.
    """
    ray = motion.t_m - view.t_frame_cam_m
    along = ray / np.linalg.norm(ray)
    A = np.zeros((DIMENSION, DIMENSION))
    A[POSITION, POSITION] = A[VELOCITY, VELOCITY] = np.outer(along, along)
    B = np.eye(DIMENSION) - A
    return replace(motion, P=symmetric(A @ motion.P @ A + B @ motion.P @ B))


def innovation(motion: Motion, estimate: Estimate, K: Array, view: View) -> Innovation:
    """Compare an estimate with the prediction; `motion` is in the frame and at the time of `view`."""
    R_cam_frame = view.R_frame_cam.T
    predicted_m = R_cam_frame @ (motion.t_m - view.t_frame_cam_m)
    range_m, measured_m = float(np.linalg.norm(predicted_m)), float(np.linalg.norm(estimate.t_cam_target_m))
    turned = so3.turn(predicted_m, estimate.t_cam_target_m)
    residual_m = so3.skew(turned) @ predicted_m + float(np.log(measured_m / range_m)) * predicted_m
    across, log_range_variance = _measurement_noise(estimate, K)
    to_predicted = (range_m / measured_m) * so3.exp(-turned)
    across = symmetric(to_predicted @ across @ to_predicted.T)
    predicted_covariance = symmetric(R_cam_frame @ motion.P[POSITION, POSITION] @ R_cam_frame.T)
    attitude = view.aim_covariance(predicted_m)
    return Innovation(residual_m, predicted_m, predicted_covariance, attitude, across, log_range_variance)


def correct(motion: Motion, seen: Innovation, view: View) -> Motion:
    """The state after a measurement; `view` as for its innovation."""
    dt_s = max((motion.time_ns - motion.seen_ns) / NS_PER_S, SHORTEST_S)
    range_m2 = float(seen.predicted_m @ seen.predicted_m)
    log_residual = float(seen.residual_m @ seen.predicted_m) / range_m2
    log_variance = float(seen.predicted_m @ seen.predicted_covariance @ seen.predicted_m) / range_m2**2
    predicted = 0.5 * float(np.log(range_m2))
    rates = rates_of(_relative_velocity(motion, view) @ view.R_frame_cam, seen.predicted_m, motion.kind != "cam")
    scale = motion.scale.seen(motion.time_ns, predicted + log_residual, seen.log_range_variance, predicted, rates)
    away = scale.away(log_variance)
    if away:
        motion, seen = _rescaled(motion, away, view), _rescaled_innovation(seen, away)
    ray = seen.predicted_m
    noise = seen.across + scale.noise(dt_s) * np.outer(ray, ray)
    in_cam = seen.predicted_covariance + seen.attitude
    S = in_cam + noise
    d2 = float(seen.residual_m @ np.linalg.solve(S, seen.residual_m))
    if d2 > SOFT_GATE:
        noise = noise * (d2 / SOFT_GATE)
        S = in_cam + noise
    H = np.zeros((3, DIMENSION))
    H[:, POSITION] = view.R_frame_cam.T
    gain = np.linalg.solve(S, H @ motion.P).T
    change = gain @ seen.residual_m
    # Joseph's form keeps P positive semi-definite whatever the gain.
    keep = np.eye(DIMENSION) - gain @ H
    P = symmetric(keep @ motion.P @ keep.T + gain @ (noise + seen.attitude) @ gain.T)
    relative_m, turned, log_factor = corrected(motion.t_m - view.t_frame_cam_m, change[POSITION])
    v_mps = motion.v_mps + gain[VELOCITY] @ in_metres(seen.residual_m, ray, log_factor, motion.kind != "cam")
    if motion.kind == "cam":
        P, v_mps = _follow_sight_line(P, motion.t_m, change, turned), turned @ v_mps
    turn_rate = float(np.clip(motion.turn_rate_radps + change[TURN_RATE], -TURN_RATE_MAX, TURN_RATE_MAX))
    return replace(
        motion,
        seen_ns=motion.time_ns,
        t_m=view.t_frame_cam_m + relative_m,
        v_mps=v_mps,
        turn_rate_radps=turn_rate,
        P=_farther(P, log_factor),
        scale=scale,
        sight=None if motion.kind == "cam" else _sight(seen, in_cam, noise),
    )


def covariance(motion: Motion, view: View) -> Array:
    """[6, 6] of position and velocity in the frame, with the range error that all frames share.

    A relative error of range causes the same relative error of the relative velocity.
    """
    per_share = np.concatenate([motion.t_m - view.t_frame_cam_m, _relative_velocity(motion, view)])
    return symmetric(motion.P[:TURN_RATE, :TURN_RATE] + motion.scale.common_variance * np.outer(per_share, per_share))


def t_in_cam(motion: Motion, view: View) -> Array:
    """t_cam_target_m [3]."""
    if motion.sight is not None:
        return motion.sight.t_cam_m
    return view.R_frame_cam.T @ (motion.t_m - view.t_frame_cam_m)


def covariance_in_cam(motion: Motion, view: View) -> Array:
    """[3, 3] of t_in_cam, m^2; for a target not detected in this frame, with the frame's attitude error."""
    t_cam_m = t_in_cam(motion, view)
    if motion.sight is not None:
        return symmetric(motion.sight.covariance + motion.scale.common_variance * np.outer(t_cam_m, t_cam_m))
    R = view.R_frame_cam.T
    inside = covariance(motion, view)[POSITION, POSITION]
    return symmetric(R @ inside @ R.T + view.aim_covariance(t_cam_m))


def symmetric(P: Array) -> Array:
    """P made exactly symmetric: removes rounding errors."""
    return 0.5 * (P + P.T)


def _relative_velocity(motion: Motion, view: View) -> Array:
    """[3], of the target relative to the camera, or v_mps as it is if the camera's velocity is unknown."""
    return motion.v_mps if view.v_frame_cam_mps is None else motion.v_mps - view.v_frame_cam_mps


def _rescaled(motion: Motion, log_factor: float, view: View) -> Motion:
    """The target moved to exp(log_factor) times its range. The jump is no speed, but velocity is less sure after it."""
    relative_m = motion.t_m - view.t_frame_cam_m
    P = _farther(motion.P, log_factor)
    P[VELOCITY, VELOCITY] += log_factor**2 * _first_velocity(motion.kind, float(np.linalg.norm(relative_m)))
    return replace(motion, t_m=view.t_frame_cam_m + float(np.exp(log_factor)) * relative_m, P=P)


def _farther(P: Array, log_factor: float) -> Array:
    """P [7, 7] of a target moved to exp(log_factor) times its range: angles and relative range stay as sure."""
    factors = np.ones(DIMENSION)
    factors[POSITION] = np.exp(log_factor)
    return P * np.outer(factors, factors)


def _rescaled_innovation(seen: Innovation, log_factor: float) -> Innovation:
    """The same measurement against the rescaled target."""
    factor = float(np.exp(log_factor))
    return replace(
        seen,
        residual_m=factor * (seen.residual_m - log_factor * seen.predicted_m),
        predicted_m=factor * seen.predicted_m,
        predicted_covariance=factor**2 * seen.predicted_covariance,
        attitude=factor**2 * seen.attitude,
        across=factor**2 * seen.across,
    )


def _sight(seen: Innovation, in_cam: Array, noise: Array) -> Sight:
    """Prediction (covariance `in_cam`, the frame's attitude error included) and measurement combined in `cam`."""
    gain = np.linalg.solve(in_cam + noise, in_cam).T
    keep = so3.IDENTITY - gain
    t_cam_m, turned, log_factor = corrected(seen.predicted_m, gain @ seen.residual_m)
    covariance = np.exp(2.0 * log_factor) * turned @ (keep @ in_cam @ keep.T + gain @ noise @ gain.T) @ turned.T
    return Sight(t_cam_m, symmetric(covariance))


def _measurement_noise(estimate: Estimate, K: Array) -> tuple[Array, float]:
    """Covariance [3, 3] in `cam` of an estimate's position without its range, and the variance of its log range."""
    t = estimate.t_cam_target_m
    bearing_variance = (MODEL_BEARING_PX / float(K[0, 0])) ** 2
    C = symmetric(estimate.covariance[:3, :3])
    C += bearing_variance * (t @ t) * so3.IDENTITY + MODEL_LOG_RANGE**2 * np.outer(t, t)
    # Conditional variance along the ray, all else held: subtracting it leaves C positive semi-definite.
    log_range_variance = 1.0 / float(t @ np.linalg.solve(C, t))
    return C - log_range_variance * np.outer(t, t), log_range_variance


def _turning_radps(motion: Motion) -> Array:
    """[3], turn rate of the velocity: in `ned` the target's; in `cam` the line of sight's, mostly the camera's own."""
    if motion.kind == "cam":
        return np.cross(motion.t_m, motion.v_mps) / max(float(motion.t_m @ motion.t_m), 1.0)
    return np.array([0.0, 0.0, motion.turn_rate_radps])


def _acceleration_density(motion: Motion) -> Array:
    """[3, 3], m2/s3."""
    if motion.kind != "cam":
        return ACCELERATION[motion.kind] ** 2 * np.diag([1.0, 1.0, VERTICAL_SHARE**2])
    range_m = float(np.linalg.norm(motion.t_m))
    along = np.outer(motion.t_m, motion.t_m) / max(range_m**2, 1.0)
    across = (APPARENT_ACCELERATION * range_m) ** 2 * (so3.IDENTITY - along)
    passing = 2.0 * PASSING_SPEED_MPS**3 / max(range_m, RANGE_MIN_M)
    return (ACCELERATION["ned_relative"] ** 2 + passing) * along + across


def _follow_sight_line(P: Array, t_m: Array, change: Array, turned: Array) -> Array:
    """P after a correction in `cam` that turns the line of sight: errors turn with it, those of range scale its rate.

    The line of sight turns there mostly because the camera does, so a change across it must not be taken for parallax,
    from which a filter in Cartesian coordinates would infer range.
    """
    range_m = float(np.linalg.norm(t_m))
    along = t_m / range_m
    across = change[VELOCITY] - (change[VELOCITY] @ along) * along
    T = np.eye(DIMENSION)
    T[VELOCITY, POSITION] = turned @ np.outer(across, along) / range_m
    T[POSITION, POSITION] = T[VELOCITY, VELOCITY] = turned
    return symmetric(T @ P @ T.T)


def _unknown_velocity(P: Array, kind: FrameKind, range_m: float) -> Array:
    """P [7, 7] with the given position part and unknown velocity and turn rate."""
    P = P.copy()
    P[VELOCITY, VELOCITY] = _first_velocity(kind, range_m)
    P[TURN_RATE, TURN_RATE] = TURN_RATE_STD**2 if kind == "ned" else 0.0
    return P


def _first_velocity(kind: FrameKind, range_m: float) -> Array:
    """Covariance [3, 3] of an unknown velocity; less in the vertical, as aircraft fly more or less level."""
    if kind == "cam":
        return max(SPEED_STD_MPS, APPARENT_RATE_STD * range_m) ** 2 * so3.IDENTITY
    return np.diag([SPEED_STD_MPS, SPEED_STD_MPS, CLIMB_STD_MPS]) ** 2
