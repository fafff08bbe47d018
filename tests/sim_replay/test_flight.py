"""Flight by JSBSim: tracks that agree with themselves, and pilots that fly what they are told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs.geometry import R_from_euler, euler_from_R, so3_log
from sim_replay.airframes import AIRFRAMES
from sim_replay.flight.aircraft import DYNAMICS, FlightClass, flight_class
from sim_replay.flight.jsbsim_flight import FlightError, Gust, Sortie, fly
from sim_replay.flight.manoeuvre import Manoeuvre
from sim_replay.flight.track import Array, Track

GRAVITY_MPS2 = 9.80665
STRAIGHT = Manoeuvre("straight", (0.0,), (0.0,), (0.0,))


def sortie(how: FlightClass, manoeuvre: Manoeuvre, gust: Gust = "calm", autopilot: bool = False) -> Sortie:
    speed_mps = min(max(how.speed_mps, how.dynamics.slowest_mps), how.dynamics.fastest_mps)
    rate = how.roll_rate_limit_radps
    return Sortie(how.dynamics, speed_mps, 1000.0, manoeuvre, rate, gust, gust_seed=5, autopilot=autopilot)


def angles_deg(track: Track) -> tuple[Array, Array, Array]:
    roll, pitch, yaw = euler_from_R(track.R_ned_body)
    return np.degrees(roll), np.degrees(pitch), np.degrees(np.unwrap(yaw))


@pytest.mark.parametrize("gust", ["calm", "moderate"])
def test_position_velocity_attitude_and_rates_are_one_motion(gust: Gust) -> None:
    s_turn = Manoeuvre("s_turn", (0.0, 2.0), (0.5, -0.5), (0.03, 0.03))
    track = fly(sortie(flight_class("light_aircraft"), s_turn, gust), -1.0, 7.0)
    step_s = np.diff(track.t_s)[:, None]
    v, w = track.v_ned_body_mps, track.rates_body_radps
    travelled = np.diff(track.t_ned_body_m, axis=0) / step_s
    np.testing.assert_allclose(travelled, 0.5 * (v[1:] + v[:-1]), atol=0.02)
    turned = so3_log(np.swapaxes(track.R_ned_body[:-1], -1, -2) @ track.R_ned_body[1:]) / step_s
    np.testing.assert_allclose(turned, 0.5 * (w[1:] + w[:-1]), atol=0.004)
    assert np.ptp(angles_deg(track)[0]) > 45.0  # it did roll from one side to the other


@pytest.mark.parametrize("airframe", [a.name for a in AIRFRAMES])
def test_every_airframe_turns_steadily_without_slip(airframe: str) -> None:
    how = flight_class(airframe)
    bank_rad = 0.7 * how.bank_limit_rad
    track = fly(sortie(how, Manoeuvre("turn", (0.0,), (bank_rad,), (0.0,))), 4.0, 9.0)
    roll_deg, _, yaw_deg = angles_deg(track)
    level_mps = np.linalg.norm(track.v_ned_body_mps[:, :2], axis=1)
    course = np.unwrap(np.arctan2(track.v_ned_body_mps[:, 1], track.v_ned_body_mps[:, 0]))
    turn_radps = (course[-1] - course[0]) / (track.t_s[-1] - track.t_s[0])
    balanced_deg = np.degrees(np.arctan(level_mps.mean() * turn_radps / GRAVITY_MPS2))
    assert abs(roll_deg.mean() - np.degrees(bank_rad)) < 4.0
    assert abs(balanced_deg - roll_deg.mean()) < 3.0
    sideways = np.einsum("nij,ni->nj", track.R_ned_body, track.v_ned_body_mps)[:, 1]
    assert np.abs(np.degrees(np.arcsin(sideways / np.linalg.norm(track.v_ned_body_mps, axis=1)))).mean() < 3.0
    assert np.all(np.diff(yaw_deg) > 0.0)


@pytest.mark.parametrize("name", sorted(set(DYNAMICS) - {"SGS"}))
def test_each_stand_in_flies_straight_at_its_speed_and_height(name: str) -> None:
    how = FlightClass(name, DYNAMICS[name].speed_mps, 0.5, 0.5)
    track = fly(sortie(how, STRAIGHT), 0.0, 8.0)
    roll_deg, _, yaw_deg = angles_deg(track)
    speed_mps = np.linalg.norm(track.v_ned_body_mps, axis=1)
    assert np.abs(roll_deg).max() < 3.0
    assert np.abs(yaw_deg - yaw_deg[0]).max() < 3.0
    assert np.abs(speed_mps - how.speed_mps).max() < 0.05 * how.speed_mps
    assert np.ptp(track.t_ned_body_m[:, 2]) < 5.0


def test_a_climb_climbs_and_the_sailplane_sinks() -> None:
    climb = Manoeuvre("climb", (-2.0,), (0.0,), (0.06,))
    powered = fly(sortie(flight_class("tactical_inverted_v"), climb), 2.0, 8.0)
    sailplane = fly(sortie(flight_class("glider"), STRAIGHT), 0.0, 8.0)

    def path_rad(track: Track) -> float:
        change = track.t_ned_body_m[-1] - track.t_ned_body_m[0]
        return float(np.arctan2(-change[2], np.hypot(change[0], change[1])))

    assert path_rad(powered) == pytest.approx(0.06, abs=0.015)
    assert -0.08 < path_rad(sailplane) < -0.02


def test_the_shipped_autopilot_turns_a_quarter_circle_and_rolls_out() -> None:
    quarter = Manoeuvre("roll_in", (-20.0, -4.0), (0.0, 0.5), (0.0, 0.0))
    track = fly(sortie(flight_class("light_aircraft"), quarter, autopilot=True), -7.0, 22.0)
    roll_deg, _, yaw_deg = angles_deg(track)
    assert 20.0 < roll_deg.max() < 35.0
    assert abs(yaw_deg[-1] - 90.0) < 8.0
    assert abs(roll_deg[-1]) < 8.0


def test_gusts_shake_more_the_stronger_they_are_and_follow_their_seed() -> None:
    def shaken(gust: Gust, seed: int = 5) -> Array:
        base = sortie(flight_class("tailless_swept"), STRAIGHT, gust)
        return fly(Sortie(**{**vars(base), "gust_seed": seed}), 0.0, 6.0).rates_body_radps

    calm, light, moderate = (float(np.std(shaken(gust))) for gust in ("calm", "light", "moderate"))
    assert calm < 0.2 * light < light < moderate
    np.testing.assert_array_equal(shaken("light"), shaken("light"))
    assert np.abs(shaken("light") - shaken("light", seed=6)).max() > 0.01


def test_a_sortie_that_cannot_be_trimmed_says_which_aircraft() -> None:
    too_fast = Sortie(DYNAMICS["J3Cub"], 95.0, 1000.0, STRAIGHT, 0.5, "calm", 1)
    with pytest.raises(FlightError, match="J3Cub"):
        fly(too_fast, 0.0, 1.0)


@settings(deadline=None, max_examples=40)
@given(
    st.floats(-0.8, 0.8),
    st.floats(-0.4, 0.4),
    st.floats(-3.1, 3.1),
    st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    st.lists(st.floats(-9.0, 9.0), min_size=6, max_size=6),
)
def test_between_samples_a_track_follows_any_steady_rotation_and_any_cubic(
    roll: float, pitch: float, yaw: float, rates: list[float], cubic: list[float]
) -> None:
    from scipy.spatial.transform import Rotation

    a, b = np.array(cubic[:3]), np.array(cubic[3:])
    start = R_from_euler(roll, pitch, yaw)

    def path(t: Array) -> tuple[Array, Array, Array]:
        t = t[:, None]
        R = start @ Rotation.from_rotvec(t * np.array(rates)).as_matrix()
        return R, 50.0 * t + a * t**2 + b * t**3, 50.0 + 2 * a * t + 3 * b * t**2

    grid = np.arange(0.0, 1.01, 0.1)
    R, p, v = path(grid)
    track = Track(grid, R, p, v, np.tile(rates, (len(grid), 1)))
    between = np.array([0.0, 0.033, 0.5, 0.777, 1.0])
    got, (R_true, p_true, v_true) = track.at(between), path(between)
    np.testing.assert_allclose(got.R_ned_body, R_true, atol=1e-9)
    np.testing.assert_allclose(got.t_ned_body_m, p_true, atol=1e-9)
    np.testing.assert_allclose(got.v_ned_body_mps, v_true, atol=1e-8)
    with pytest.raises(ValueError, match="the track holds"):
        track.at(np.array([1.2]))
