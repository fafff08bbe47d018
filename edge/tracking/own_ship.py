"""Attitude and position of the camera's vehicle at a frame's exposure time."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from edge.tracking.geodesy import LATITUDE_MAX_DEG, lat_lon_alt_from_ned, origin_of_ned
from edge.types import Array, OwnShip
from msgs.geometry import R_from_euler, R_from_q_wxyz, euler_from_R, slerp, so3_exp

KEPT = 1024  # samples of each kind: 10 s at 100 Hz
ATTITUDE_GAP_MAX_NS = 500_000_000  # no interpolation between samples further apart
# How long an attitude is extrapolated with its rates beyond the time when the next one is usually due: enough for a
# link that delays messages, or loses one. If they usually come more rarely than this, they are not used at all: rather
# none than for some frames only.
ATTITUDE_AHEAD_MAX_NS = 150_000_000
USUAL_OF = 5  # samples that give the usual interval: a single lost or late one does not change it
ANGULAR_ACCELERATION_STD_RADPS2 = 1.5  # of a fixed-wing aircraft that begins or ends a turn
GIMBAL_ACCELERATION_STD_RADPS2 = 5.0  # of a gimbal that begins or ends a slew
# Least horizontal part of the unit nose vector for a defined heading: within 15 degrees of the vertical, small attitude
# errors turn the heading, and everything given relative to it, many times as far.
LEVEL_MIN = float(np.sin(np.deg2rad(15.0)))
GIMBAL_HELD_MAX_NS = 50_000_000  # how long a gimbal's attitude of unknown rate is taken to stay as it is
GIMBAL_STEP_MIN_NS = 5_000_000  # the difference of closer samples is mostly rounding and gives no rate
POSITION_GAP_MAX_NS = 2_000_000_000
POSITION_AHEAD_MAX_NS = 500_000_000
GLOBAL_AGE_MAX_NS = 5_000_000_000
LONG_AGO_NS = -(10**18)
NS_PER_S = 1e9


@dataclass(frozen=True)
class _Attitude:
    time_ns: int
    R_ned_body: Array
    rates_body_radps: Array
    clock_std_s: float


@dataclass(frozen=True)
class _Position:
    time_ns: int
    t_ned_m: Array
    v_ned_mps: Array


class GimbalFrame(Enum):
    """What a gimbal's attitude is relative to (GIMBAL_DEVICE_ATTITUDE_STATUS, MAVLink 285)."""

    EARTH = "earth"  # ned
    HEADING = "heading"  # level axes that turn only with the vehicle's heading


@dataclass(frozen=True)
class _Gimbal:
    time_ns: int
    R_frame_gimbal: Array
    frame: GimbalFrame
    clock_std_s: float


@dataclass(frozen=True)
class _Global:
    time_ns: int
    lat_lon_alt: tuple[float, float, float]
    v_ned_mps: Array


class OwnShipBuffer:
    """The last seconds of own attitude and position, on the monotonic clock. Thread-safe.

    Each kind must be added in order of time: a sample that is not later is rejected, and `add_*` returns False.
    """

    def __init__(self, gimballed: bool = False) -> None:
        """`gimballed`: the camera is on a gimbal; without the gimbal's attitude, that of the body is not used."""
        self.gimballed = gimballed
        self._lock = threading.Lock()
        self._gimbals: deque[_Gimbal] = deque(maxlen=KEPT)
        self._attitudes: deque[_Attitude] = deque(maxlen=KEPT)
        self._positions: deque[_Position] = deque(maxlen=KEPT)
        self._global: _Global | None = None
        self._in_local_ned = False  # whether this autopilot sends positions in its local ned frame
        self._axes_epoch = self._origin_epoch = 0
        self._refused_until_ns = LONG_AGO_NS

    def add_attitude(
        self, time_ns: int, q_ned_body_wxyz: ArrayLike, rates_body_radps: ArrayLike, clock_std_s: float = 0.0
    ) -> bool:
        """Attitude [4] and body rates [3] (FRD); `clock_std_s`: of `time_ns`. Raises ValueError on a zero q."""
        rates_radps = np.array(rates_body_radps, dtype=np.float64)
        sample = _Attitude(time_ns, R_from_q_wxyz(q_ned_body_wxyz), rates_radps, clock_std_s)
        with self._lock:
            return self._append(self._attitudes, sample)

    def add_gimbal(
        self, time_ns: int, q_frame_gimbal_wxyz: ArrayLike, frame: GimbalFrame, clock_std_s: float = 0.0
    ) -> bool:
        """Attitude [4] of the gimbal's axes (FRD when it points ahead); `clock_std_s`: of `time_ns`.

        Raises ValueError on a zero quaternion.
        """
        with self._lock:
            return self._append(self._gimbals, _Gimbal(time_ns, R_from_q_wxyz(q_frame_gimbal_wxyz), frame, clock_std_s))

    def add_position(self, time_ns: int, t_ned_m: ArrayLike, v_ned_mps: ArrayLike) -> bool:
        """Position and velocity [3] of the body origin in the local ned frame."""
        sample = _Position(time_ns, np.array(t_ned_m, dtype=np.float64), np.array(v_ned_mps, dtype=np.float64))
        with self._lock:
            self._in_local_ned = True
            return self._append(self._positions, sample)

    def add_global(
        self, time_ns: int, lat_lon_alt: tuple[float, float, float], v_ned_mps: tuple[float, float, float]
    ) -> bool:
        """Position (degrees, degrees, m above mean sea level) and velocity of the body origin, to locate ned's origin.

        If the autopilot also sends positions in local ned, this one is used only while those arrive: when ArduPilot
        loses its position it keeps sending the last global one, at rest, but stops sending the local one.
        """
        with self._lock:
            before_ns = self._refused_until_ns if self._global is None else self._global.time_ns
            if time_ns <= before_ns:
                return False
            self._global = _Global(time_ns, lat_lon_alt, np.array(v_ned_mps, dtype=np.float64))
            return True

    def clear(self, *, same_axes: bool = False, same_autopilot: bool = False, until_ns: int = LONG_AGO_NS) -> None:
        """Discard all samples: the autopilot or its estimator was reset, and its local origin with it.

        `same_axes`: attitudes keep their meaning and are kept: without one for a frame, the targets' velocities would
        be lost. Otherwise north, or the gimbal's zero, may have changed.
        `same_autopilot`: it sends the same kinds of position as before.
        `until_ns`: samples of that time or before, which may wait to be read, are rejected from now on.
        """
        with self._lock:
            self._refused_until_ns = max(self._refused_until_ns, until_ns)
            self._in_local_ned = self._in_local_ned and same_autopilot
            self._origin_epoch += 1
            if not same_axes:
                self._axes_epoch += 1
                self._attitudes.clear()
                self._gimbals.clear()
            self._positions.clear()
            self._global = None

    def at(self, time_ns: int) -> OwnShip | None:
        """The own ship at a time: slerp between samples, extrapolation with body rates until 150 ms after the next one
        was due.

        None without an attitude for that time (also of the gimbal, if any). Position and velocity are None if no
        position is available for it; the ned origin is then the own ship itself.
        """
        with self._lock:
            R_ned_body = _attitude_at(self._attitudes, time_ns)
            R_body_gimbal = None
            if R_ned_body is not None and self.gimballed:
                R_body_gimbal = _gimbal_at(self._gimbals, time_ns, R_ned_body)
            if R_ned_body is None or (self.gimballed and R_body_gimbal is None):
                return None
            position = _position_at(self._positions, time_ns)
            t_ned_m, v_ned_mps = position if position is not None else (None, None)
            origin = self._origin(time_ns, t_ned_m is not None)
            clock_std_s = self._of_body_and_gimbal(*(s[-1].clock_std_s if s else 0.0 for s in self._sources))
            attitude_std_rad = self._of_body_and_gimbal(
                _body_turned_rad(self._attitudes, time_ns), _gimbal_turned_rad(self._gimbals, time_ns)
            )
            return OwnShip(
                time_ns,
                R_ned_body,
                t_ned_m,
                v_ned_mps,
                origin,
                R_body_gimbal,
                clock_std_s,
                attitude_std_rad,
                self._axes_epoch,
                self._origin_epoch,
            )

    def _append(self, samples: deque, sample: _Attitude | _Gimbal | _Position) -> bool:
        if sample.time_ns <= (samples[-1].time_ns if samples else self._refused_until_ns):
            return False
        samples.append(sample)
        return True

    @property
    def _sources(self) -> tuple[deque[_Attitude], deque[_Gimbal]]:
        return self._attitudes, self._gimbals

    def _of_body_and_gimbal(self, body_std: float, gimbal_std: float) -> float:
        """A standard deviation of the camera's attitude from those of its sources: a gimbal attitude relative to earth
        alone gives the camera's attitude."""
        if not self.gimballed:
            return body_std
        earth = self._gimbals[-1].frame is GimbalFrame.EARTH
        return gimbal_std if earth else float(np.hypot(body_std, gimbal_std))

    def _origin(self, time_ns: int, in_local_ned: bool) -> tuple[float, float, float] | None:
        """Global position of the local ned origin, which is fixed, else of the own ship, extrapolated to `time_ns`."""
        if self._global is None:
            return None
        place, age_ns = self._global.lat_lon_alt, time_ns - self._global.time_ns
        if abs(place[0]) > LATITUDE_MAX_DEG:
            return None
        if not in_local_ned:
            if self._in_local_ned and not _goes_on(self._positions, time_ns):
                return None
            flown_m = self._global.v_ned_mps * (age_ns / NS_PER_S)
            return lat_lon_alt_from_ned(place, flown_m) if abs(age_ns) <= POSITION_AHEAD_MAX_NS else None
        then = _position_at(self._positions, self._global.time_ns)
        if then is None or abs(age_ns) > GLOBAL_AGE_MAX_NS:
            return None
        return origin_of_ned(place, then[0])


def _first_after(samples: deque, time_ns: int) -> int:
    """Index of the first sample later than a time; searched from the end, as it is usually near there."""
    index = len(samples)
    while index > 0 and samples[index - 1].time_ns > time_ns:
        index -= 1
    return index


def _attitude_at(samples: deque[_Attitude], time_ns: int) -> Array | None:
    after = _first_after(samples, time_ns)
    if after == 0:
        return None
    a = samples[after - 1]
    if _too_rare(samples):
        return None
    if after == len(samples):
        if time_ns - a.time_ns > ATTITUDE_AHEAD_MAX_NS + _usual_gap_ns(samples):
            return None
        return a.R_ned_body @ so3_exp(a.rates_body_radps * ((time_ns - a.time_ns) / NS_PER_S))
    b = samples[after]
    if b.time_ns - a.time_ns > ATTITUDE_GAP_MAX_NS:
        return None
    share = (time_ns - a.time_ns) / (b.time_ns - a.time_ns)
    return slerp(a.R_ned_body, b.R_ned_body, share)


def _body_turned_rad(samples: deque[_Attitude], time_ns: int) -> float:
    """Standard deviation of an interpolated or extrapolated attitude, from unknown angular acceleration."""
    since_s, until_s = _apart_s(samples, time_ns)
    return 0.5 * ANGULAR_ACCELERATION_STD_RADPS2 * since_s * (since_s if until_s is None else until_s)


def _gimbal_turned_rad(samples: deque[_Gimbal], time_ns: int) -> float:
    """The same of a gimbal, whose rate is that of the last two samples: half an interval old."""
    since_s, until_s = _apart_s(samples, time_ns)
    if until_s is None:
        between_s = (samples[-1].time_ns - samples[-2].time_ns) / NS_PER_S if len(samples) > 1 else 0.0
        until_s = since_s + between_s
    return 0.5 * GIMBAL_ACCELERATION_STD_RADPS2 * since_s * until_s


def _apart_s(samples: deque[_Attitude] | deque[_Gimbal], time_ns: int) -> tuple[float, float | None]:
    """Seconds since the last sample before a time, and until the next one (None: there is none yet)."""
    after = _first_after(samples, time_ns)
    if after == 0:
        return 0.0, 0.0
    since_s = (time_ns - samples[after - 1].time_ns) / NS_PER_S
    return since_s, None if after == len(samples) else (samples[after].time_ns - time_ns) / NS_PER_S


def _usual_gaps_ns(samples: deque) -> list[int]:
    """Intervals between the last few samples, shortest first."""
    times = [samples[i].time_ns for i in range(max(len(samples) - USUAL_OF, 0), len(samples))]
    return sorted(b - a for a, b in pairwise(times))


def _usual_gap_ns(samples: deque) -> int:
    """The median interval between the last few samples; 0 for a single one."""
    gaps_ns = _usual_gaps_ns(samples)
    return gaps_ns[len(gaps_ns) // 2] if gaps_ns else 0


def _too_rare(samples: deque[_Attitude] | deque[_Gimbal]) -> bool:
    """Whether samples usually lie too far apart to be used."""
    return _usual_gap_ns(samples) > ATTITUDE_AHEAD_MAX_NS


def _goes_on(samples: deque[_Position], time_ns: int) -> bool:
    """Whether positions still arrive, even if too rarely to be used themselves."""
    if not samples:
        return False
    due_ns = _usual_gap_ns(samples) * 3 // 2
    return time_ns - samples[-1].time_ns <= min(max(due_ns, POSITION_AHEAD_MAX_NS), POSITION_GAP_MAX_NS)


def _gimbal_at(samples: deque[_Gimbal], time_ns: int, R_ned_body: Array) -> Array | None:
    """R_body_gimbal: slerp between samples, extrapolation at the rate of the last two for at most 150 ms; None if given
    relative to a heading while the nose points nearly straight up or down."""
    after = _first_after(samples, time_ns)
    if after == 0 or _too_rare(samples):
        return None
    if after == len(samples) and time_ns - samples[-1].time_ns > ATTITUDE_AHEAD_MAX_NS:
        return None
    a, b = samples[max(min(after, len(samples) - 1) - 1, 0)], samples[min(after, len(samples) - 1)]
    least_ns = GIMBAL_STEP_MIN_NS if after == len(samples) else 1
    if a.frame is not b.frame or not least_ns <= b.time_ns - a.time_ns <= ATTITUDE_GAP_MAX_NS:
        if after < len(samples) or time_ns - b.time_ns > GIMBAL_HELD_MAX_NS:
            return None
        a, share = b, 0.0  # the last sample alone, without a rate
    else:
        share = (time_ns - a.time_ns) / (b.time_ns - a.time_ns)
    R = slerp(a.R_frame_gimbal, b.R_frame_gimbal, share)
    if b.frame is GimbalFrame.HEADING:
        if np.hypot(R_ned_body[0, 0], R_ned_body[1, 0]) < LEVEL_MIN:
            return None
        _, _, yaw_rad = euler_from_R(R_ned_body)
        R = R_from_euler(0.0, 0.0, float(yaw_rad)) @ R
    return R_ned_body.T @ R


def _position_at(samples: deque[_Position], time_ns: int) -> tuple[Array, Array] | None:
    after, gaps_ns = _first_after(samples, time_ns), _usual_gaps_ns(samples)
    # Rare positions would be available for some frames only. The shortest gap decides, as losses lengthen the others.
    if after == 0 or (gaps_ns and gaps_ns[0] > POSITION_AHEAD_MAX_NS):
        return None
    a = samples[after - 1]
    if after == len(samples):
        if time_ns - a.time_ns > POSITION_AHEAD_MAX_NS:
            return None
        return a.t_ned_m + a.v_ned_mps * ((time_ns - a.time_ns) / NS_PER_S), a.v_ned_mps
    b = samples[after]
    if b.time_ns - a.time_ns > POSITION_GAP_MAX_NS:
        return None
    apart_s = (b.time_ns - a.time_ns) / NS_PER_S
    share = (time_ns - a.time_ns) / (b.time_ns - a.time_ns)
    v_mps = a.v_ned_mps + share * (b.v_ned_mps - a.v_ned_mps)
    way_m = b.t_ned_m - a.t_ned_m
    # Cubic Hermite interpolation with the velocities at `a` and `b`: a straight line would cut corners in a turn.
    bent_m = (1.0 - share) * (a.v_ned_mps * apart_s - way_m) - share * (b.v_ned_mps * apart_s - way_m)
    return a.t_ned_m + share * way_m + share * (1.0 - share) * bent_m, v_mps
