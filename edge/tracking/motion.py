"""Where one target is and how it moves: an EKF over position, velocity, turn rate and range bias. Pure.

The state lives in one of three frames, by what is known of the own ship:
    ned           attitude and position: coordinated turn about the vertical
    ned_relative  attitude only: ned axes, origin at the own ship; constant relative velocity
    cam           neither: camera axes; the sight line turns, and range changes, at constant rates
Measurements are always compared in `cam`, where their covariance is given. The rotation has a filter of its own
(`rotation.py`): while it may be the depth reversal of the true one, nothing of it may reach the turn rate.

Noise. A network that misjudges range in one frame misjudges it alike in the next, so range noise is split: a share is
a bias b, t_measured = (1 + b) t, first-order Gauss-Markov; only the rest is white. The variance of range therefore does
not shrink with the number of frames, as it would if each were independent. The constants below are tuning choices for
fixed-wing aircraft at 100-500 m, not measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge.tracking import so3
from edge.tracking.view import NS_PER_S, FrameKind, View
from edge.types import Array, Estimate

POSITION, VELOCITY = slice(0, 3), slice(3, 6)
TURN_RATE, RANGE_BIAS = 6, 7
DIMENSION = 8

# Process noise, square roots of spectral densities.
ACCELERATION = {"ned": 3.0, "ned_relative": 6.0}  # m/s^1.5; relative: the own ship manoeuvres too
VERTICAL_SHARE = 0.5  # of that, up and down
APPARENT_ACCELERATION = 0.3  # rad/s^1.5 times range: the camera's own turning, which `cam` cannot tell apart
TURN_RATE_WALK = 0.1  # rad/s^1.5
BIAS_TIME_S = 4.0  # correlation time of the range bias
BIAS_SHARE = 0.8  # of the network's log-range variance

# Initial uncertainty of what one measurement does not tell.
SPEED_STD_MPS = 40.0
CLIMB_STD_MPS = 6.0
APPARENT_RATE_STD = 0.5  # rad/s times range
TURN_RATE_STD = 0.2  # rad/s
TURN_RATE_MAX = 1.0  # rad/s

# Added to each measurement: what a network's own sigma does not know of.
MODEL_BEARING_PX = 1.0
MODEL_LOG_RANGE = 0.01

# A change of frame uses the last attitude known, this uncertain for each second since.
STALE_ATTITUDE_RADPS = 0.5

SOFT_GATE = 11.34  # chi-square, 3 degrees of freedom, 99 %: beyond it a measurement's noise is raised to meet it


@dataclass(frozen=True)
class Motion:
    """The filter's state at one instant, in the frame `kind`."""

    kind: FrameKind
    time_ns: int
    t_m: Array  # [3] target origin in the frame
    v_mps: Array  # [3]
    turn_rate_radps: float  # about ned's down axis, right turns positive; 0 outside `ned`
    range_bias: float  # measured range / range - 1
    bias_variance: float  # stationary
    P: Array  # [8, 8], order (t, v, turn rate, range bias)


@dataclass(frozen=True)
class Innovation:
    """What a measured position says beyond the prediction, in `cam`."""

    residual_m: Array  # [3]
    H: Array  # [3, 8]
    noise: Array  # [3, 3] white part
    bias_variance: float
    d2: float  # squared Mahalanobis distance, 3 degrees of freedom


def measurement_noise(estimate: Estimate, K: Array, view: View) -> tuple[Array, float]:
    """The white covariance [3, 3] in `cam` of an estimate's position, and the variance of its log-range bias."""
    t = estimate.t_cam_target_m
    bearing_variance = (MODEL_BEARING_PX / float(K[0, 0])) ** 2 + view.attitude_variance
    C = symmetric(estimate.covariance[:3, :3])
    C += bearing_variance * (t @ t) * so3.IDENTITY + MODEL_LOG_RANGE**2 * np.outer(t, t)
    # Marginal along the ray with all else held: taking a share of it away leaves C positive semi-definite.
    bias_variance = BIAS_SHARE / float(t @ np.linalg.solve(C, t))
    return C - bias_variance * np.outer(t, t), bias_variance


def begin(estimate: Estimate, K: Array, view: View) -> Motion:
    """The state after a first measurement."""
    noise, bias_variance = measurement_noise(estimate, K, view)
    R = view.R_frame_cam
    ray = R @ estimate.t_cam_target_m
    P = np.zeros((DIMENSION, DIMENSION))
    P[POSITION, POSITION] = R @ noise @ R.T + bias_variance * np.outer(ray, ray)
    P[POSITION, RANGE_BIAS] = P[RANGE_BIAS, POSITION] = -bias_variance * ray
    P[VELOCITY, VELOCITY] = _first_velocity(view.kind, float(np.linalg.norm(ray)))
    P[TURN_RATE, TURN_RATE] = TURN_RATE_STD**2 if view.kind == "ned" else 0.0
    P[RANGE_BIAS, RANGE_BIAS] = bias_variance
    t_m = view.t_frame_cam_m + ray
    return Motion(view.kind, view.time_ns, t_m, np.zeros(3), 0.0, 0.0, bias_variance, symmetric(P))


def turning(motion: Motion, time_ns: int) -> Array:
    """[3, 3], what turns the target from the motion's time to a later one."""
    return so3.exp((time_ns - motion.time_ns) / NS_PER_S * _turning_radps(motion))


def propagate(motion: Motion, time_ns: int) -> Motion:
    """The state at a later time; an earlier one changes nothing."""
    dt = (time_ns - motion.time_ns) / NS_PER_S
    if dt <= 0.0:
        return motion
    turn = turning(motion, time_ns)
    v = turn @ motion.v_mps
    decay = float(np.exp(-dt / BIAS_TIME_S))

    F = np.eye(DIMENSION)
    F[POSITION, VELOCITY] = 0.5 * dt * (so3.IDENTITY + turn)
    F[VELOCITY, VELOCITY] = turn
    if motion.kind == "ned":
        v_by_turn = dt * np.array([-v[1], v[0], 0.0])
        F[VELOCITY, TURN_RATE] = v_by_turn
        F[POSITION, TURN_RATE] = 0.5 * dt * v_by_turn
    F[RANGE_BIAS, RANGE_BIAS] = decay

    Q = np.zeros((DIMENSION, DIMENSION))
    density = _acceleration_density(motion)
    Q[POSITION, POSITION] = dt**3 / 3.0 * density
    Q[POSITION, VELOCITY] = Q[VELOCITY, POSITION] = dt**2 / 2.0 * density
    Q[VELOCITY, VELOCITY] = dt * density
    Q[TURN_RATE, TURN_RATE] = TURN_RATE_WALK**2 * dt if motion.kind == "ned" else 0.0
    Q[RANGE_BIAS, RANGE_BIAS] = (1.0 - decay**2) * motion.bias_variance
    return replace(
        motion,
        time_ns=time_ns,
        t_m=motion.t_m + 0.5 * dt * (motion.v_mps + v),
        v_mps=v,
        range_bias=decay * motion.range_bias,
        P=symmetric(F @ motion.P @ F.T + Q),
    )


def reframe(motion: Motion, old: View, new: View, attitude_age_s: float) -> Motion:
    """The same target in the frame of `new`; `old` is the camera in the motion's frame, both at the motion's time.

    `attitude_age_s`: how long ago the attitude that links the frames was measured.
    """
    through_cam = "cam" in (old.kind, new.kind)
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


def between(old: View, new: View) -> Array:
    """R_new_old [3, 3] between the frames of two views of one instant; ned's axes are those of ned_relative."""
    if "cam" in (old.kind, new.kind):
        return new.R_frame_cam @ old.R_frame_cam.T
    return so3.IDENTITY


def innovation(motion: Motion, estimate: Estimate, K: Array, view: View) -> Innovation:
    """Compare an estimate with the prediction; `motion` is in the frame and at the time of `view`."""
    R_cam_frame = view.R_frame_cam.T
    t_cam = R_cam_frame @ (motion.t_m - view.t_frame_cam_m)
    H = np.zeros((3, DIMENSION))
    H[:, POSITION] = (1.0 + motion.range_bias) * R_cam_frame
    H[:, RANGE_BIAS] = t_cam
    noise, bias_variance = measurement_noise(estimate, K, view)
    residual_m = estimate.t_cam_target_m - (1.0 + motion.range_bias) * t_cam
    d2 = float(residual_m @ np.linalg.solve(H @ motion.P @ H.T + noise, residual_m))
    return Innovation(residual_m, H, noise, bias_variance, d2)


def correct(motion: Motion, seen: Innovation) -> Motion:
    """The state after a measurement."""
    H = seen.H
    noise = seen.noise * max(1.0, seen.d2 / SOFT_GATE)
    gain = np.linalg.solve(H @ motion.P @ H.T + noise, H @ motion.P).T
    change = gain @ seen.residual_m
    # Joseph's form keeps P positive semi-definite whatever the gain.
    keep = np.eye(DIMENSION) - gain @ H
    P = symmetric(keep @ motion.P @ keep.T + gain @ noise @ gain.T)
    if motion.kind == "cam":
        P = _follow_sight_line(P, motion.t_m, change)
    turn_rate = float(np.clip(motion.turn_rate_radps + change[TURN_RATE], -TURN_RATE_MAX, TURN_RATE_MAX))
    return replace(
        motion,
        t_m=motion.t_m + change[POSITION],
        v_mps=motion.v_mps + change[VELOCITY],
        turn_rate_radps=turn_rate,
        range_bias=motion.range_bias + float(change[RANGE_BIAS]),
        bias_variance=seen.bias_variance,
        P=P,
    )


def t_in_cam(motion: Motion, view: View) -> Array:
    """t_cam_target_m [3]."""
    return view.R_frame_cam.T @ (motion.t_m - view.t_frame_cam_m)


def covariance_in_cam(motion: Motion, view: View) -> Array:
    """[3, 3] of t_in_cam, m^2: with how far this frame's own attitude may be off what the track was made with."""
    R = view.R_frame_cam.T
    across = so3.skew(t_in_cam(motion, view))
    return symmetric(R @ motion.P[POSITION, POSITION] @ R.T + view.attitude_variance * across @ across.T)


def symmetric(P: Array) -> Array:
    """P without the rounding that makes it differ from its transpose."""
    return 0.5 * (P + P.T)


def _turning_radps(motion: Motion) -> Array:
    """[3], what turns the velocity: the target's turn in `ned`; in `cam` the sight line's, mostly the camera's own."""
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
    return ACCELERATION["ned_relative"] ** 2 * along + across


def _follow_sight_line(P: Array, t_m: Array, change: Array) -> Array:
    """P after a correction in `cam`: errors of range move with the sight line and scale its rate.

    What turns the sight line there is mostly the camera, so a change across it must not be read as parallax, from
    which a filter in Cartesian coordinates would infer range.
    """
    range_m = float(np.linalg.norm(t_m))
    along = t_m / range_m
    T = np.eye(DIMENSION)
    for part in (POSITION, VELOCITY):
        across = change[part] - (change[part] @ along) * along
        T[part, POSITION] += np.outer(across, along) / range_m
    return symmetric(T @ P @ T.T)


def _first_velocity(kind: FrameKind, range_m: float) -> Array:
    """Covariance [3, 3] of a velocity that nothing is known of: aircraft fly more or less level."""
    if kind == "cam":
        return max(SPEED_STD_MPS, APPARENT_RATE_STD * range_m) ** 2 * so3.IDENTITY
    return np.diag([SPEED_STD_MPS, SPEED_STD_MPS, CLIMB_STD_MPS]) ** 2
