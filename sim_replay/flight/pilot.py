"""Flies a manoeuvre: a pilot with stick, pedals and throttle, or the autopilot that JSBSim includes for an aircraft."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from sim_replay.flight.aircraft import Dynamics
from sim_replay.flight.manoeuvre import Manoeuvre

GRAVITY_MPS2 = 9.80665
GLIDE_RAD = -0.05  # a sailplane's path angle at its cruise speed
GLIDE_PER_MPS = 0.04  # rad of path angle per m/s of excess speed: a sailplane exchanges height for speed
PATH_BANDWIDTH = 0.7  # rad/s, of the control of the flight path angle
QUARTER_RAD = math.pi / 2.0
ROLL_BANDWIDTH = 1.6  # rad/s, of the control of the bank angle


@dataclass(frozen=True)
class Seen:
    """Instrument readings of the pilot."""

    bank_rad: float
    pitch_rad: float
    p_radps: float
    q_radps: float
    r_radps: float
    slip_rad: float  # sideslip; positive with the wind from the right
    speed_mps: float  # airspeed
    path_rad: float  # flight path above the horizon
    heading_rad: float
    height_m: float


@dataclass(frozen=True)
class Controls:
    """Commands, -1 to 1, throttle 0 to 1; JSBSim's signs: right roll, nose down, nose left are positive."""

    aileron: float
    elevator: float
    rudder: float
    throttle: float
    autopilot: Setpoints | None = None  # what JSBSim's own autopilot is to hold in addition to the stick


@dataclass(frozen=True)
class Setpoints:
    """Set points of an autopilot with heading and height hold."""

    heading_rad: float
    height_m: float


@dataclass
class Pilot:
    """Holds bank, flight path and speed; gains follow from the aircraft's derivatives, scaled by dynamic pressure."""

    dynamics: Dynamics
    manoeuvre: Manoeuvre
    speed_mps: float
    roll_rate_limit_radps: float
    trim: Controls
    step_s: float
    _sums: dict[str, float] = field(default_factory=lambda: {"bank": 0.0, "pitch": 0.0, "slip": 0.0, "speed": 0.0})

    def fly(self, t_s: float, seen: Seen) -> Controls:
        """The controls for the next step."""
        bank_rad, path_rad = self.manoeuvre.bank_rad(t_s), self.manoeuvre.path_rad(t_s)
        pressure = (seen.speed_mps / self.dynamics.speed_mps) ** 2
        return Controls(
            self._aileron(bank_rad, seen, pressure),
            self._elevator(path_rad, seen, pressure),
            self._rudder(seen, pressure),
            self._throttle(path_rad, seen),
        )

    def _aileron(self, bank_rad: float, seen: Seen, pressure: float) -> float:
        error = bank_rad - seen.bank_rad
        limit = self.roll_rate_limit_radps
        wanted = min(max(ROLL_BANDWIDTH * error, -limit), limit)
        self._sum("bank", error, 0.15)
        damping = self.dynamics.roll_damping * seen.speed_mps / self.dynamics.speed_mps
        moment = damping * wanted + 2.0 * (wanted - seen.p_radps) + 1.5 * self._sums["bank"]
        return _clip(self.trim.aileron + moment / (self.dynamics.roll_control * pressure))

    def _elevator(self, path_rad: float, seen: Seen, pressure: float) -> float:
        if self.dynamics.thrust == 0.0:
            path_rad = GLIDE_RAD + GLIDE_PER_MPS * (seen.speed_mps - self.speed_mps)
        turn = GRAVITY_MPS2 / seen.speed_mps * math.sin(seen.bank_rad) * math.tan(seen.bank_rad)
        wanted = turn + PATH_BANDWIDTH * (path_rad - seen.path_rad)
        error = wanted - seen.q_radps
        self._sum("pitch", error, 0.6)
        d, faster = self.dynamics, seen.speed_mps / self.dynamics.speed_mps
        # The additional angle of attack of a turn must be held against the aircraft's static stability.
        incidence_rad = (1.0 / math.cos(seen.bank_rad) - 1.0) * GRAVITY_MPS2 / (seen.speed_mps * d.lift_slope)
        held = d.pitch_stiffness * incidence_rad * pressure / faster + d.pitch_damping * wanted * faster
        moment = held + 2.5 * error + 6.0 * self._sums["pitch"]
        return _clip(self.trim.elevator - moment / (self.dynamics.pitch_control * pressure))

    def _rudder(self, seen: Seen, pressure: float) -> float:
        turn = GRAVITY_MPS2 / seen.speed_mps * math.sin(seen.bank_rad) * math.cos(seen.pitch_rad)
        self._sum("slip", seen.slip_rad, 0.3)
        moment = 1.0 * (turn - seen.r_radps) + 2.0 * seen.slip_rad + 1.5 * self._sums["slip"]
        return _clip(self.trim.rudder - moment / (self.dynamics.yaw_control * pressure))

    def _throttle(self, path_rad: float, seen: Seen) -> float:
        if self.dynamics.thrust == 0.0:
            return 0.0
        error = self.speed_mps - seen.speed_mps
        self._sum("speed", error, 8.0)
        pull = GRAVITY_MPS2 * math.sin(path_rad) + 0.5 * error + 0.1 * self._sums["speed"]
        return min(max(self.trim.throttle + pull / self.dynamics.thrust, 0.0), 1.0)

    def _sum(self, name: str, error: float, limit: float) -> None:
        total = self._sums[name] + error * self.step_s
        self._sums[name] = min(max(total, -limit), limit)


@dataclass
class AutopilotOperator:
    """Operates JSBSim's autopilot, which chooses its own bank; the pilot keeps rudder and throttle."""

    pilot: Pilot
    _heading_rad: float | None = None
    _height_m: float | None = None
    _bank_rad: float | None = None

    def fly(self, t_s: float, seen: Seen) -> Controls:
        """The controls for the next step: a turn is a heading a quarter circle ahead, a climb an increasing height."""
        bank_rad, path_rad = self.pilot.manoeuvre.bank_rad(t_s), self.pilot.manoeuvre.path_rad(t_s)
        if self._heading_rad is None or bank_rad != self._bank_rad:
            self._heading_rad = seen.heading_rad + math.copysign(QUARTER_RAD, bank_rad) * (bank_rad != 0.0)
            self._bank_rad = bank_rad
        height_m = seen.height_m if self._height_m is None else self._height_m
        self._height_m = height_m + self.pilot.speed_mps * math.sin(path_rad) * self.pilot.step_s
        trim = self.pilot.trim
        by_hand = self.pilot.fly(t_s, seen)
        setpoints = Setpoints(self._heading_rad, self._height_m)
        return replace(by_hand, aileron=trim.aileron, elevator=trim.elevator, autopilot=setpoints)


def _clip(value: float) -> float:
    return min(max(value, -1.0), 1.0)
