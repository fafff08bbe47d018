"""JSBSim aircraft that represent the airframes: which one for each airframe, its speed, and its control derivatives."""

from __future__ import annotations

from dataclasses import dataclass

from sim_replay.airframes import airframe_id, airframe_of


@dataclass(frozen=True)
class Dynamics:
    """A JSBSim aircraft with its derivatives at a reference speed, 1,000 m up.

    They come from jsbsim.FGLinearization at its trim; the sailplane's, which it cannot trim, from differences.

    Moments are divided by inertia: rad/s² for full control, 1/s for a rate, 1/s² for an angle of attack.
    """

    jsbsim_name: str
    speed_mps: float  # at which the derivatives hold
    slowest_mps: float
    fastest_mps: float
    roll_damping: float
    roll_control: float
    pitch_damping: float
    pitch_stiffness: float
    pitch_control: float
    lift_slope: float  # 1/s: rate of the flight path for an angle of attack
    yaw_control: float
    thrust: float  # m/s² for full throttle; 0 for a sailplane
    autopilot: bool = False  # JSBSim includes one for it that holds heading and height


DYNAMICS = {
    d.jsbsim_name: d
    for d in (
        Dynamics("J3Cub", 30.0, 24.0, 35.0, 11.17, 12.95, 11.83, 7.54, 4.61, 3.03, 2.66, 2.31),
        Dynamics("SGS", 25.0, 26.0, 28.0, 6.13, 3.01, 1.42, 2.52, 1.98, 2.25, 0.58, 0.0),
        Dynamics("c172x", 52.0, 38.0, 60.0, 4.67, 6.51, 4.41, 22.05, 8.81, 4.11, 0.74, 4.23, autopilot=True),
        Dynamics("c182", 60.0, 45.0, 68.0, 5.54, 4.90, 6.08, 15.74, 6.01, 2.86, 1.54, 3.25),
        Dynamics("DHC6", 70.0, 58.0, 74.0, 5.75, 3.71, 3.65, 5.68, 2.38, 1.16, 1.51, 3.74),
        Dynamics("t6texan2", 95.0, 75.0, 125.0, 3.52, 11.32, 2.26, 22.37, 7.75, 1.70, 1.45, 3.22),
        Dynamics("T37", 110.0, 85.0, 140.0, 2.25, 5.99, 10.04, 12.85, 6.63, 2.34, 0.99, 4.96),
        Dynamics("A4", 150.0, 120.0, 200.0, 3.61, 10.60, 1.12, 9.56, 3.79, 1.19, 3.25, 5.97),
        Dynamics("global5000", 140.0, 115.0, 170.0, 3.68, 3.18, 1.19, 2.84, 1.57, 0.89, 0.82, 3.54),
    )
}


@dataclass(frozen=True)
class FlightClass:
    """How an airframe flies: the JSBSim aircraft that represents it, its cruise speed and how briskly it banks."""

    jsbsim_name: str
    speed_mps: float
    bank_limit_rad: float
    roll_rate_limit_radps: float

    @property
    def dynamics(self) -> Dynamics:
        """The derivatives of that JSBSim aircraft."""
        return DYNAMICS[self.jsbsim_name]


_CLASSES = {
    "male_v_tail": FlightClass("DHC6", 68.0, 0.5, 0.3),
    "twin_boom_inverted_v": FlightClass("c172x", 42.0, 0.5, 0.4),
    "tactical_inverted_v": FlightClass("J3Cub", 34.0, 0.7, 0.7),
    "light_aircraft": FlightClass("c172x", 55.0, 0.6, 0.5),
    "loitering_delta": FlightClass("c172x", 52.0, 0.7, 0.8),
    "glider": FlightClass("SGS", 27.0, 0.45, 0.3),
    "tailless_swept": FlightClass("J3Cub", 28.0, 0.7, 0.8),
    "twin_boom_h_tail": FlightClass("c182", 52.0, 0.5, 0.35),
    "male_inverted_v": FlightClass("DHC6", 66.0, 0.5, 0.3),
    "low_wing_tourer": FlightClass("c182", 60.0, 0.6, 0.55),
    "biplane": FlightClass("c172x", 45.0, 0.8, 0.8),
    "canard_pusher": FlightClass("c182", 64.0, 0.7, 0.8),
    "ultralight_pusher": FlightClass("J3Cub", 26.0, 0.6, 0.5),
    "floatplane": FlightClass("c182", 55.0, 0.5, 0.35),
    "business_turboprop": FlightClass("t6texan2", 105.0, 0.6, 0.5),
    "twin_turboprop": FlightClass("DHC6", 70.0, 0.5, 0.3),
    "jet_trainer": FlightClass("T37", 120.0, 0.9, 1.2),
    "jet_target_drone": FlightClass("A4", 160.0, 1.0, 1.5),
    "flying_wing_jet": FlightClass("global5000", 135.0, 0.6, 0.4),
    "hybrid_quadplane": FlightClass("J3Cub", 27.0, 0.6, 0.6),
    "hand_launched": FlightClass("J3Cub", 25.0, 0.7, 0.8),
}
_BY_SPAN = (
    (4.5, FlightClass("J3Cub", 29.0, 0.7, 0.8)),
    (9.0, FlightClass("c172x", 45.0, 0.6, 0.6)),
    (14.0, FlightClass("c182", 55.0, 0.55, 0.45)),
    (float("inf"), FlightClass("DHC6", 68.0, 0.5, 0.3)),
)


def flight_class(airframe: str) -> FlightClass:
    """How the named airframe flies: by name, otherwise by its span. Raises ValueError."""
    span_m = airframe_of(airframe_id(airframe)).span_m
    return _CLASSES.get(airframe) or next(c for limit_m, c in _BY_SPAN if span_m <= limit_m)
