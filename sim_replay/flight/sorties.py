"""Sorties drawn from a seed: aircraft, speed, manoeuvre and gusts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim_replay.flight.aircraft import FlightClass
from sim_replay.flight.jsbsim_flight import SAMPLE_S, Gust, Sortie
from sim_replay.flight.manoeuvre import draw_manoeuvre
from sim_replay.flight.track import Array

LEAD_S = 1.2  # of track before the first frame and after the last
FLOWN_AT_M = (900.0, 1300.0)  # all JSBSim aircraft trim here; the encounter is moved to its own height afterwards
STEEPEST_PATH_RAD = 0.07
OWN_CLASSES = (
    FlightClass("J3Cub", 29.0, 0.6, 0.7),
    FlightClass("c172x", 46.0, 0.6, 0.5),
    FlightClass("c182", 56.0, 0.5, 0.45),
    FlightClass("DHC6", 66.0, 0.45, 0.35),
    FlightClass("t6texan2", 92.0, 0.7, 0.9),
    FlightClass("T37", 115.0, 0.7, 0.9),
    FlightClass("A4", 150.0, 0.7, 0.9),
)


@dataclass(frozen=True)
class Clock:
    """The times of one encounter, seconds from the first frame's mid exposure."""

    frame_t_s: Array  # [F]

    @property
    def start_s(self) -> float:
        """Start of the tracks."""
        return -LEAD_S

    @property
    def end_s(self) -> float:
        """End of the tracks: a whole number of samples later."""
        return self.start_s + float(np.ceil((self.frame_t_s[-1] + 2.0 * LEAD_S) / SAMPLE_S)) * SAMPLE_S

    @property
    def middle_s(self) -> float:
        """Mid sequence."""
        return float(self.frame_t_s[-1]) / 2.0

    @property
    def checked_s(self) -> Array:
        """Times [N] at which an encounter is checked, slightly beyond the frames; N is odd and includes the middle."""
        return np.linspace(-0.1, 2.0 * self.middle_s + 0.1, 29)

    @property
    def all_s(self) -> Array:
        """As `checked_s`, at least 25 times a second."""
        return np.linspace(-0.1, 2.0 * self.middle_s + 0.1, 2 * int(np.ceil((self.middle_s + 0.1) * 25.0)) + 1)


def draw_sortie(rng: np.random.Generator, clock: Clock, how: FlightClass, gust: Gust) -> Sortie:
    """A flight of that class near its cruise, with a manoeuvre that is visible within the frames."""
    speed_mps = how.speed_mps * float(rng.uniform(0.9, 1.1))
    manoeuvre = draw_manoeuvre(rng, max(2.0 * clock.middle_s, 1.0), how.bank_limit_rad, STEEPEST_PATH_RAD)
    return Sortie(
        how.dynamics,
        min(max(speed_mps, how.dynamics.slowest_mps), how.dynamics.fastest_mps),
        float(rng.uniform(*FLOWN_AT_M)),
        manoeuvre,
        how.roll_rate_limit_radps,
        gust,
        int(rng.integers(1, 2**30)),
        autopilot=bool(rng.random() < 0.5) and how.dynamics.autopilot,
    )


def draw_own_class(rng: np.random.Generator, target_speed_mps: float, clock: Clock) -> FlightClass:
    """An own ship that stays near: almost any for a short encounter, one as fast as the target for a long one."""
    spare_mps = 120.0 / max(clock.middle_s, 1.0)
    close = [c for c in OWN_CLASSES if abs(c.speed_mps - target_speed_mps) <= spare_mps]
    nearest = min(OWN_CLASSES, key=lambda c: abs(c.speed_mps - target_speed_mps))
    return close[int(rng.integers(len(close)))] if close else nearest
