"""One flight in JSBSim: load, trim, settle, fly a manoeuvre in turbulence, and record the integrated state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import jsbsim
import numpy as np

from msgs.geometry import Array, R_from_euler
from sim_replay.flight.aircraft import Dynamics
from sim_replay.flight.manoeuvre import Manoeuvre
from sim_replay.flight.pilot import GLIDE_RAD, AutopilotOperator, Controls, Pilot, Seen
from sim_replay.flight.track import Track

Gust = Literal["calm", "light", "moderate"]
FOOT_M = 0.3048
STEP_S = 0.01
STEPS_PER_SAMPLE = 2  # the track is at 50 Hz, and so is the pilot
SAMPLE_S = STEP_S * STEPS_PER_SAMPLE
SETTLE_S = 6.0
LEAST_AHEAD = math.cos(math.radians(25.0))  # of the flight path along the nose: at larger angles, it stalls or spins
SAILPLANE_INCIDENCE_DEG = 2.0
# MIL-F-8785C: wind at 20 ft above the ground, ft/s, and severity index (probability of exceedance).
TURBULENCE: dict[Gust, tuple[float, int]] = {"light": (25.0, 3), "moderate": (50.0, 4)}
_SEEN = (
    *("attitude/phi-rad", "attitude/theta-rad", "velocities/p-rad_sec", "velocities/q-rad_sec", "velocities/r-rad_sec"),
    *("aero/beta-rad", "velocities/vt-fps", "velocities/h-dot-fps", "velocities/ned-velocity-mag-fps"),
    *("attitude/psi-rad", "position/h-sl-ft"),
)
_RECORDED = (
    *("position/ecef-x-ft", "position/ecef-y-ft", "position/ecef-z-ft"),
    *("velocities/ecef-x-fps", "velocities/ecef-y-fps", "velocities/ecef-z-fps"),
    *("velocities/p-rad_sec", "velocities/q-rad_sec", "velocities/r-rad_sec"),
    *("attitude/phi-rad", "attitude/theta-rad", "attitude/psi-rad"),
    *("position/lat-geod-rad", "position/long-gc-rad"),
)


@dataclass(frozen=True)
class Sortie:
    """A flight to be flown; the same sortie gives the same track, bit for bit."""

    dynamics: Dynamics
    speed_mps: float
    height_m: float  # where it starts, above the ground
    manoeuvre: Manoeuvre
    roll_rate_limit_radps: float
    gust: Gust
    gust_seed: int
    autopilot: bool = False  # flown by the autopilot that JSBSim includes for the aircraft


class FlightError(RuntimeError):
    """An impossible flight; the text names it."""


class _Aircraft:
    """A trimmed JSBSim aircraft in flight."""

    def __init__(self, sortie: Sortie) -> None:
        self._fdm = _trimmed(sortie)
        self._seen = [self._node(name) for name in _SEEN]
        self._recorded = [self._node(name) for name in _RECORDED]
        self._stick = [self._node(f"fcs/{name}-cmd-norm") for name in ("aileron", "elevator", "rudder")]
        engines = self._fdm.get_propulsion().get_num_engines()
        self._throttles = [self._node(f"fcs/throttle-cmd-norm[{k}]") for k in range(engines)]

    def _node(self, name: str) -> jsbsim.FGPropertyNode:
        node = self._fdm.get_property_manager().get_node(name)
        if node is None:
            raise FlightError(f"{self._fdm.get_model_name()} has no property {name}")
        return node

    def controls(self) -> Controls:
        aileron, elevator, rudder = (n.get_double_value() for n in self._stick)
        return Controls(aileron, elevator, rudder, self._throttles[0].get_double_value() if self._throttles else 0.0)

    def step(self, controls: Controls) -> None:
        for node, value in zip(self._stick, (controls.aileron, controls.elevator, controls.rudder), strict=True):
            node.set_double_value(value)
        for node in self._throttles:
            node.set_double_value(controls.throttle)
        if controls.autopilot is not None:
            self._fdm["ap/heading_setpoint"] = math.degrees(controls.autopilot.heading_rad) % 360.0
            self._fdm["ap/altitude_setpoint"] = controls.autopilot.height_m / FOOT_M
            self._fdm["ap/heading_hold"] = self._fdm["ap/altitude_hold"] = 1.0
        for _ in range(STEPS_PER_SAMPLE):
            self._fdm.run()

    def seen(self) -> Seen:
        v = [n.get_double_value() for n in self._seen]
        path_rad = math.asin(max(-1.0, min(1.0, v[7] / max(v[8], 1.0))))
        return Seen(v[0], v[1], v[2], v[3], v[4], v[5], v[6] * FOOT_M, path_rad, v[9], v[10] * FOOT_M)

    def state(self) -> list[float]:
        return [n.get_double_value() for n in self._recorded]

    def height_m(self) -> float:
        return self._node("position/h-agl-ft").get_double_value() * FOOT_M


def fly(sortie: Sortie, start_s: float, end_s: float) -> Track:
    """The flight from `start_s` to `end_s` at 50 Hz, in the flat NED axes at its first sample; the ground is z = 0.

    The aircraft is trimmed heading north SETTLE_S before. Raises FlightError if it cannot be trimmed or departs.
    """
    aircraft = _Aircraft(sortie)
    by_hand = Pilot(
        sortie.dynamics,
        sortie.manoeuvre,
        sortie.speed_mps,
        sortie.roll_rate_limit_radps,
        aircraft.controls(),
        SAMPLE_S,
    )
    pilot = AutopilotOperator(by_hand) if sortie.autopilot else by_hand
    settling, samples = round(SETTLE_S / SAMPLE_S), round((end_s - start_s) / SAMPLE_S) + 1
    for k in range(-settling, 0):
        aircraft.step(pilot.fly(start_s + k * SAMPLE_S, aircraft.seen()))
    values, height_m = np.empty((samples, len(_RECORDED))), aircraft.height_m()
    for k in range(samples):
        values[k] = aircraft.state()
        aircraft.step(pilot.fly(start_s + k * SAMPLE_S, aircraft.seen()))
    R_ecef_here = _R_ecef_ned(values[:, 12], values[:, 13])
    R_ned_ecef = R_ecef_here[0].T
    R_ned_body: Array = R_ned_ecef @ R_ecef_here @ R_from_euler(values[:, 9], values[:, 10], values[:, 11])
    position = (values[:, :3] - values[0, :3]) @ R_ned_ecef.T * FOOT_M - np.array([0.0, 0.0, height_m])
    velocity = values[:, 3:6] @ R_ned_ecef.T * FOOT_M
    ahead = np.einsum("ni,ni->n", R_ned_body[:, :, 0], velocity) / np.maximum(np.linalg.norm(velocity, axis=1), 1.0)
    if not np.isfinite(values).all() or R_ned_body[:, 2, 2].min() < 0.2 or ahead.min() < LEAST_AHEAD:
        raise FlightError(f"{sortie.dynamics.jsbsim_name} departed from controlled flight")
    t_s: Array = start_s + np.arange(samples, dtype=np.float64) * SAMPLE_S
    return Track(t_s, R_ned_body, position, velocity, values[:, 6:9])


def _R_ecef_ned(lat_rad: Array, lon_rad: Array) -> Array:
    """Axes [N, 3, 3] of north, east and down in ECEF at geodetic latitudes and longitudes [N]."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat_rad), np.cos(lat_rad), np.sin(lon_rad), np.cos(lon_rad)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lon_rad)], axis=-1)
    return np.stack([north, east, np.cross(north, east)], axis=-1)


def _trimmed(sortie: Sortie) -> jsbsim.FGFDMExec:
    jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))
    fdm = jsbsim.FGFDMExec(jsbsim.get_default_root_dir())
    fdm.set_debug_level(0)
    if not fdm.load_model(sortie.dynamics.jsbsim_name):
        raise FlightError(f"JSBSim has no aircraft named {sortie.dynamics.jsbsim_name}")
    fdm.set_dt(STEP_S)
    fdm["simulation/randomseed"] = sortie.gust_seed
    # Adams-Bashforth: JSBSim's default, Euler, leaves the attitude half a step behind the rates that it reports.
    fdm["simulation/integrator/position/rotational"] = 3
    fdm["ic/h-sl-ft"] = sortie.height_m / FOOT_M
    fdm["ic/vt-fps"] = sortie.speed_mps / FOOT_M
    fdm["ic/lat-geod-deg"], fdm["ic/long-gc-deg"] = 47.0, 8.0
    if fdm.get_property_manager().hasNode("gear/gear-cmd-norm"):
        fdm["gear/gear-cmd-norm"] = 0.0
    if sortie.dynamics.thrust == 0.0:
        fdm["ic/gamma-deg"] = math.degrees(GLIDE_RAD)
        fdm["ic/alpha-deg"] = SAILPLANE_INCIDENCE_DEG
    fdm.run_ic()
    if sortie.dynamics.thrust > 0.0:
        fdm.get_propulsion().init_running(-1)
        if not jsbsim.FGTrim(fdm, jsbsim.TrimMode.FULL).do_trim():
            raise FlightError(f"{sortie.dynamics.jsbsim_name} cannot be trimmed at {sortie.speed_mps:.0f} m/s")
    if sortie.gust != "calm":
        wind_fps, severity = TURBULENCE[sortie.gust]
        fdm["atmosphere/turb-type"] = 3  # MIL-F-8785C
        fdm["atmosphere/turbulence/milspec/windspeed_at_20ft_AGL-fps"] = wind_fps
        fdm["atmosphere/turbulence/milspec/severity"] = severity
    return fdm
