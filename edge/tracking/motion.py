"""The filter of one target: an error-state EKF over position, velocity, rotation, turn rate and range bias.

The state lives in one of three frames, by what is known of the own ship:
    ned           attitude and position: coordinated turn about the vertical
    ned_relative  attitude only: ned axes, origin at the own ship; constant relative velocity
    cam           neither: camera axes; the sight line turns, and range changes, at constant rates
Measurements are always compared in `cam`, where their covariance is given. Errors of a rotation stand on the left:
R = exp(theta) R_hat. Everything here is pure.

Noise. A network that misjudges range in one frame misjudges it alike in the next, so range noise is split: a share is
a bias b, t_measured = (1 + b) t, first-order Gauss-Markov; only the rest is white. The variance of range therefore does
not shrink with the number of frames, as it would if each were independent. The constants below are tuning choices for
fixed-wing aircraft at 100-500 m, not measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from edge.types import Array, Estimate, Mount, OwnShip
from msgs.geometry import rotation_angle, skew, so3_exp, so3_log

FrameKind = Literal["ned", "ned_relative", "cam"]

POSITION, VELOCITY, ROTATION = slice(0, 3), slice(3, 6), slice(6, 9)
TURN_RATE, RANGE_BIAS = 9, 10
DIMENSION = 11
POSE_BLOCK = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])

NS_PER_S = 1e9

# Process noise, square roots of spectral densities.
ACCELERATION = {"ned": 3.0, "ned_relative": 6.0}  # m/s^1.5; relative: the own ship manoeuvres too
APPARENT_ACCELERATION = 0.3  # rad/s^1.5 times range: the camera's own turning, which `cam` cannot tell apart
ROTATION_WALK = np.array([0.5, 0.2, 0.2])  # rad/s^0.5 about the target's roll, pitch and yaw axes: it rolls fastest
TURN_RATE_WALK = 0.1  # rad/s^1.5
BIAS_TIME_S = 2.0  # correlation time of the range bias
BIAS_SHARE = 0.7  # of the network's log-range variance

# Initial uncertainty of what one measurement does not tell.
SPEED_STD_MPS = 40.0
APPARENT_RATE_STD = 0.5  # rad/s times range
TURN_RATE_STD = 0.2  # rad/s
TURN_RATE_MAX = 1.0  # rad/s

# Added to each measurement: what a network's own sigma does not know of.
MODEL_BEARING_PX = 1.0
MODEL_LOG_RANGE = 0.01
MODEL_ROTATION_RAD = np.deg2rad(1.0)
ATTITUDE_JITTER_RAD = 1e-3  # own attitude and its timing, in the ned frames

# A change of frame uses the last attitude known, this uncertain for each second since.
STALE_ATTITUDE_RADPS = 0.5

SOFT_GATE = 11.34  # chi-square, 3 degrees of freedom, 99 %: beyond it a measurement's noise is raised to meet it
ROTATION_GATE_RAD = np.deg2rad(60.0)


@dataclass(frozen=True)
class View:
    """The camera in a frame at one instant."""

    kind: FrameKind
    time_ns: int
    R_frame_cam: Array  # [3, 3]
    t_frame_cam_m: Array  # [3]
    v_frame_cam_mps: Array | None  # [3]; zero in the frames that move with the own ship, None: not known

    @classmethod
    def of(cls, time_ns: int, own_ship: OwnShip | None, mount: Mount) -> View:
        if own_ship is None:
            return cls("cam", time_ns, np.eye(3), np.zeros(3), np.zeros(3))
        camera = own_ship.camera(mount)
        R_ned_cam = own_ship.R_ned_body @ camera.R_body_cam
        lever_ned_m = own_ship.R_ned_body @ camera.t_body_cam_m
        if own_ship.t_ned_body_m is None:
            return cls("ned_relative", time_ns, R_ned_cam, lever_ned_m, np.zeros(3))
        return cls("ned", time_ns, R_ned_cam, own_ship.t_ned_body_m + lever_ned_m, own_ship.v_ned_body_mps)

    def moved_to(self, time_ns: int) -> View:
        """The same camera later, at constant velocity and attitude."""
        if self.v_frame_cam_mps is None:
            return replace(self, time_ns=time_ns)
        dt_s = (time_ns - self.time_ns) / NS_PER_S
        return replace(self, time_ns=time_ns, t_frame_cam_m=self.t_frame_cam_m + dt_s * self.v_frame_cam_mps)


@dataclass(frozen=True)
class Motion:
    """The filter's state at one instant, in the frame `kind`."""

    kind: FrameKind
    time_ns: int
    t_m: Array  # [3] target origin in the frame
    v_mps: Array  # [3]
    R_frame_target: Array  # [3, 3]
    turn_rate_radps: float  # about ned's down axis, right turns positive; 0 outside `ned`
    range_bias: float  # measured range / range - 1
    bias_variance: float  # stationary
    P: Array  # [11, 11], order (t, v, theta, turn rate, range bias)


@dataclass(frozen=True)
class Innovation:
    """What a measurement says beyond the prediction, in `cam`."""

    residual: Array  # [6] (m, rad)
    H: Array  # [6, 11]
    noise: Array  # [6, 6] white part
    bias_variance: float
    position_d2: float  # squared Mahalanobis distance of the position, 3 degrees of freedom
    rotation_rad: float  # angle between measured and predicted rotation


def measurement_noise(estimate: Estimate, K: Array, kind: FrameKind) -> tuple[Array, float]:
    """The white covariance [6, 6] in `cam` of an estimate, and the variance of its log-range bias."""
    t = estimate.t_cam_target_m
    bearing_std_rad = MODEL_BEARING_PX / float(K[0, 0])
    if kind != "cam":
        bearing_std_rad = float(np.hypot(bearing_std_rad, ATTITUDE_JITTER_RAD))
    C = _symmetric(estimate.covariance)
    C[:3, :3] += bearing_std_rad**2 * (t @ t) * np.eye(3) + MODEL_LOG_RANGE**2 * np.outer(t, t)
    C[3:, 3:] += MODEL_ROTATION_RAD**2 * np.eye(3)
    along = np.concatenate([t, np.zeros(3)])
    # Marginal along the ray with all else held: taking a share of it away leaves C positive semi-definite.
    bias_variance = BIAS_SHARE / float(along @ np.linalg.solve(C, along))
    return C - bias_variance * np.outer(along, along), bias_variance


def begin(estimate: Estimate, K: Array, view: View) -> Motion:
    """The state after a first measurement."""
    noise, bias_variance = measurement_noise(estimate, K, view.kind)
    R = view.R_frame_cam
    t_cam = estimate.t_cam_target_m
    P = np.zeros((DIMENSION, DIMENSION))
    block = _twice(R)
    placed = block @ noise @ block.T
    ray = R @ t_cam
    P[POSITION, POSITION] = placed[:3, :3] + bias_variance * np.outer(ray, ray)
    P[POSITION, ROTATION] = placed[:3, 3:]
    P[ROTATION, POSITION] = placed[3:, :3]
    P[ROTATION, ROTATION] = placed[3:, 3:]
    P[POSITION, RANGE_BIAS] = P[RANGE_BIAS, POSITION] = -bias_variance * ray
    P[VELOCITY, VELOCITY] = _speed_variance(view.kind, float(np.linalg.norm(t_cam))) * np.eye(3)
    P[TURN_RATE, TURN_RATE] = TURN_RATE_STD**2 if view.kind == "ned" else 0.0
    P[RANGE_BIAS, RANGE_BIAS] = bias_variance
    return Motion(
        kind=view.kind,
        time_ns=view.time_ns,
        t_m=view.t_frame_cam_m + ray,
        v_mps=np.zeros(3),
        R_frame_target=R @ estimate.R_cam_target,
        turn_rate_radps=0.0,
        range_bias=0.0,
        bias_variance=bias_variance,
        P=_symmetric(P),
    )


def propagate(motion: Motion, time_ns: int) -> Motion:
    """The state at a later time; an earlier one changes nothing."""
    dt = (time_ns - motion.time_ns) / NS_PER_S
    if dt <= 0.0:
        return motion
    turn = so3_exp(dt * _turning_radps(motion))
    v = turn @ motion.v_mps
    R = turn @ motion.R_frame_target
    decay = float(np.exp(-dt / BIAS_TIME_S))

    F = np.eye(DIMENSION)
    F[POSITION, VELOCITY] = 0.5 * dt * (np.eye(3) + turn)
    F[VELOCITY, VELOCITY] = F[ROTATION, ROTATION] = turn
    if motion.kind == "ned":
        v_by_turn = dt * np.array([-v[1], v[0], 0.0])
        F[VELOCITY, TURN_RATE] = v_by_turn
        F[POSITION, TURN_RATE] = 0.5 * dt * v_by_turn
        F[8, TURN_RATE] = dt
    F[RANGE_BIAS, RANGE_BIAS] = decay

    Q = np.zeros((DIMENSION, DIMENSION))
    density = _acceleration_density(motion)
    Q[POSITION, POSITION] = dt**3 / 3.0 * density
    Q[POSITION, VELOCITY] = Q[VELOCITY, POSITION] = dt**2 / 2.0 * density
    Q[VELOCITY, VELOCITY] = dt * density
    Q[ROTATION, ROTATION] = (R * (ROTATION_WALK**2 * dt)) @ R.T
    Q[TURN_RATE, TURN_RATE] = TURN_RATE_WALK**2 * dt if motion.kind == "ned" else 0.0
    Q[RANGE_BIAS, RANGE_BIAS] = (1.0 - decay**2) * motion.bias_variance
    return replace(
        motion,
        time_ns=time_ns,
        t_m=motion.t_m + 0.5 * dt * (motion.v_mps + v),
        v_mps=v,
        R_frame_target=R,
        range_bias=decay * motion.range_bias,
        P=_symmetric(F @ motion.P @ F.T + Q),
    )


def reframe(motion: Motion, old: View, new: View, attitude_age_s: float) -> Motion:
    """The same target in the frame of `new`; `old` is the camera in the motion's frame, both at the motion's time.

    `attitude_age_s`: how long ago the attitude that links the frames was measured.
    """
    through_cam = "cam" in (old.kind, new.kind)
    R_new_old = new.R_frame_cam @ old.R_frame_cam.T if through_cam else np.eye(3)
    relative_m = R_new_old @ (motion.t_m - old.t_frame_cam_m)
    zero = np.zeros(3)
    v_old = zero if old.v_frame_cam_mps is None else old.v_frame_cam_mps
    v_new = zero if new.v_frame_cam_mps is None else new.v_frame_cam_mps

    T = np.eye(DIMENSION)
    T[POSITION, POSITION] = T[VELOCITY, VELOCITY] = T[ROTATION, ROTATION] = R_new_old
    T[TURN_RATE, TURN_RATE] = 0.0
    P = T @ motion.P @ T.T
    P[TURN_RATE, TURN_RATE] = TURN_RATE_STD**2 if new.kind == "ned" else 0.0
    if through_cam or old.v_frame_cam_mps is None or new.v_frame_cam_mps is None:
        P[VELOCITY, VELOCITY] += _speed_variance("cam", float(np.linalg.norm(relative_m))) * np.eye(3)
    if through_cam:
        tilt = np.zeros((DIMENSION, 3))
        tilt[POSITION], tilt[ROTATION] = -skew(relative_m), np.eye(3)
        P += (STALE_ATTITUDE_RADPS * attitude_age_s) ** 2 * tilt @ tilt.T
    return replace(
        motion,
        kind=new.kind,
        t_m=relative_m + new.t_frame_cam_m,
        v_mps=R_new_old @ (motion.v_mps - v_old) + v_new,
        R_frame_target=R_new_old @ motion.R_frame_target,
        turn_rate_radps=0.0,
        P=_symmetric(P),
    )


def innovation(motion: Motion, estimate: Estimate, K: Array, view: View) -> Innovation:
    """Compare an estimate with the prediction; `motion` is in the frame and at the time of `view`."""
    R_cam_frame = view.R_frame_cam.T
    t_cam = R_cam_frame @ (motion.t_m - view.t_frame_cam_m)
    R_cam_target = R_cam_frame @ motion.R_frame_target
    H = np.zeros((6, DIMENSION))
    H[:3, POSITION] = (1.0 + motion.range_bias) * R_cam_frame
    H[:3, RANGE_BIAS] = t_cam
    H[3:, ROTATION] = R_cam_frame
    noise, bias_variance = measurement_noise(estimate, K, motion.kind)
    residual = np.concatenate(
        [
            estimate.t_cam_target_m - (1.0 + motion.range_bias) * t_cam,
            so3_log(estimate.R_cam_target @ R_cam_target.T),
        ]
    )
    S = H @ motion.P @ H.T + noise
    d2 = float(residual[:3] @ np.linalg.solve(S[:3, :3], residual[:3]))
    angle = float(rotation_angle(R_cam_target, estimate.R_cam_target))
    return Innovation(residual, H, noise, bias_variance, d2, angle)


def correct(motion: Motion, seen: Innovation) -> Motion:
    """The state after a measurement; a rotation further off than ROTATION_GATE_RAD leaves the rotation alone."""
    rows = 3 if seen.rotation_rad > ROTATION_GATE_RAD else 6
    H, residual = seen.H[:rows], seen.residual[:rows]
    S_prior = H @ motion.P @ H.T
    scale = np.ones(rows)
    for part in (slice(0, 3), slice(3, 6))[: rows // 3]:
        S = S_prior[part, part] + seen.noise[part, part]
        d2 = float(residual[part] @ np.linalg.solve(S, residual[part]))
        scale[part] = np.sqrt(max(1.0, d2 / SOFT_GATE))
    noise = scale[:, None] * seen.noise[:rows, :rows] * scale
    gain = np.linalg.solve(S_prior + noise, H @ motion.P).T
    change = gain @ residual
    # Joseph's form keeps P positive semi-definite whatever the gain.
    keep = np.eye(DIMENSION) - gain @ H
    P = _symmetric(keep @ motion.P @ keep.T + gain @ noise @ gain.T)
    if motion.kind == "cam":
        P = _follow_sight_line(P, motion.t_m, change)
    turn_rate = float(np.clip(motion.turn_rate_radps + change[TURN_RATE], -TURN_RATE_MAX, TURN_RATE_MAX))
    return replace(
        motion,
        t_m=motion.t_m + change[POSITION],
        v_mps=motion.v_mps + change[VELOCITY],
        R_frame_target=_orthonormal(so3_exp(change[ROTATION]) @ motion.R_frame_target),
        turn_rate_radps=turn_rate,
        range_bias=motion.range_bias + float(change[RANGE_BIAS]),
        bias_variance=seen.bias_variance,
        P=P,
    )


def with_rotation_of(motion: Motion, estimate: Estimate, K: Array, view: View) -> Motion:
    """The state with its rotation thrown away for the measured one."""
    noise, _ = measurement_noise(estimate, K, motion.kind)
    R = view.R_frame_cam
    P = motion.P.copy()
    P[ROTATION, :] = 0.0
    P[:, ROTATION] = 0.0
    P[ROTATION, ROTATION] = R @ noise[3:, 3:] @ R.T
    return replace(motion, R_frame_target=R @ estimate.R_cam_target, P=_symmetric(P))


def in_cam(motion: Motion, view: View) -> tuple[Array, Array, Array]:
    """(t_cam_target_m [3], R_cam_target [3, 3], covariance [6, 6]) in `cam`."""
    R = view.R_frame_cam.T
    block = _twice(R)
    covariance = _symmetric(block @ motion.P[POSE_BLOCK] @ block.T)
    return t_in_cam(motion, view), R @ motion.R_frame_target, covariance


def t_in_cam(motion: Motion, view: View) -> Array:
    """t_cam_target_m [3]."""
    return view.R_frame_cam.T @ (motion.t_m - view.t_frame_cam_m)


def _turning_radps(motion: Motion) -> Array:
    """[3], what turns the velocity: the target's turn in `ned`; in `cam` the sight line's, mostly the camera's own."""
    if motion.kind == "cam":
        return np.cross(motion.t_m, motion.v_mps) / max(float(motion.t_m @ motion.t_m), 1.0)
    return np.array([0.0, 0.0, motion.turn_rate_radps])


def _acceleration_density(motion: Motion) -> Array:
    """[3, 3], m2/s3."""
    if motion.kind != "cam":
        return ACCELERATION[motion.kind] ** 2 * np.eye(3)
    range_m = float(np.linalg.norm(motion.t_m))
    along = np.outer(motion.t_m, motion.t_m) / max(range_m**2, 1.0)
    across = (APPARENT_ACCELERATION * range_m) ** 2 * (np.eye(3) - along)
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
    return _symmetric(T @ P @ T.T)


def _speed_variance(kind: FrameKind, range_m: float) -> float:
    return max(SPEED_STD_MPS, APPARENT_RATE_STD * range_m if kind == "cam" else 0.0) ** 2


def _twice(R: Array) -> Array:
    """[3, 3] to the [6, 6] that turns position and rotation alike."""
    block = np.zeros((6, 6))
    block[:3, :3] = block[3:, 3:] = R
    return block


def _symmetric(P: Array) -> Array:
    return 0.5 * (P + P.T)


def _orthonormal(R: Array) -> Array:
    u, _, vt = np.linalg.svd(R)
    return u @ vt
