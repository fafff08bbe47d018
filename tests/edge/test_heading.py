"""Towards or away: outlines leave two answers; the network's doubt and how aircraft fly weigh them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from scipy.stats import t as student_t

from edge.tracking.heading import Flight, flown_odds, network_opinion, reversal, reversed_covariance
from edge.types import Estimate

# A symmetric aircraft: nose, tail, wing tips, fin.
POINTS_M = np.array([[4.0, 0, 0], [-4, 0, 0], [0, 6, 0.2], [0, -6, 0.2], [-3.5, 0, -1.5]])
finite = st.floats(-1.0, 1.0)
NORTH = np.array([1.0, 0.0, 0.0])
EXACT = 1e-4 * np.eye(3)


def attitude(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()


def flight(v_mps: list[float], std_mps: float = 2.0, turn_rate_radps: float = 0.0) -> Flight:
    return Flight(np.array(v_mps), std_mps**2 * np.eye(3), turn_rate_radps, 0.01**2, None)


def odds(R: np.ndarray, along: np.ndarray, way: Flight) -> float:
    return flown_odds(R, reversal(R, along), EXACT, way)[0]


@settings(deadline=None, max_examples=50)
@given(st.tuples(finite, finite, finite, finite), st.tuples(finite, finite))
def test_the_reversal_has_the_same_outline(q: tuple[float, ...], side: tuple[float, float]) -> None:
    """Far away, each point's image is that of the point mirrored left to right; doing it twice gives the first back."""
    R = Rotation.from_quat([q[0], q[1], q[2], q[3] + 3.0]).as_matrix()
    t_m = 1e6 * np.array([0.3 * side[0], 0.3 * side[1], 1.0])
    along = t_m / np.linalg.norm(t_m)
    other = reversal(R, along)
    np.testing.assert_allclose(other @ other.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(other) > 0
    project = lambda R, points: ((p := points @ R.T + t_m)[:, :2] / p[:, 2:]) * 1e6  # noqa: E731
    np.testing.assert_allclose(project(other, POINTS_M * [1, -1, 1]), project(R, POINTS_M), atol=1e-3)
    np.testing.assert_allclose(reversal(other, along), R, atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(st.tuples(finite, finite, finite))
def test_a_covariance_turns_with_the_reversal(w: tuple[float, float, float]) -> None:
    """A small error of a rotation becomes, in the reversal, the error that its covariance tells of."""
    R, along = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix(), np.array([0.6, 0.0, 0.8])
    error = 1e-3 * np.array(w)
    disturbed = Rotation.from_rotvec(error).as_matrix() @ R
    moved = Rotation.from_matrix(reversal(disturbed, along) @ reversal(R, along).T).as_rotvec()
    told = reversed_covariance(np.outer(error, error), along)
    np.testing.assert_allclose(told, np.outer(moved, moved), atol=1e-12)


def test_the_nose_lies_where_the_target_flies() -> None:
    away, towards = attitude(0, 3, 20), attitude(0, 3, 160)
    assert odds(away, NORTH, flight([25.0, 9.0, 0.0])) > 3.0
    assert odds(towards, NORTH, flight([25.0, 9.0, 0.0])) < -3.0
    assert odds(towards, NORTH, flight([-25.0, 9.0, 0.0])) > 3.0


def test_however_plainly_it_flies_that_way_a_chance_remains_that_it_is_the_other() -> None:
    """One to e^5: flying as it points, banked into its turn and level, seen from 30 degrees above, it may yet glide."""
    down_30 = np.array([np.cos(np.deg2rad(30)), 0.0, np.sin(np.deg2rad(30))])
    plain = flight([28.0, 0.0, 0.0], std_mps=0.5, turn_rate_radps=0.2)
    R = attitude(30, 0, 0)
    assert odds(R, down_30, plain) == pytest.approx(5.0)
    assert odds(reversal(R, down_30), down_30, plain) == pytest.approx(-5.0)


def test_an_unsure_velocity_and_a_nose_across_the_sight_line_say_little() -> None:
    assert abs(odds(attitude(0, 0, 20), NORTH, flight([25.0, 9.0, 0.0], std_mps=60.0))) < 0.7
    assert abs(odds(attitude(0, 0, 88), NORTH, flight([2.0, 25.0, 0.0]))) < 0.5


@pytest.mark.parametrize("yaw_deg", [60.0, 100.0])
def test_a_target_that_flies_as_its_tail_points_shows_that_both_are_confused(yaw_deg: float) -> None:
    """Nose and reversed nose point east of north and of south; a velocity hardly known says nothing."""
    R = attitude(0, 0, yaw_deg)

    def confused(speed_mps: float, std_mps: float = 2.0) -> float:
        way = flight([float(v) for v in speed_mps * R[:, 0]], std_mps)
        return flown_odds(R, reversal(R, NORTH), EXACT, way)[1]

    assert confused(-25.0) > 3.0
    assert confused(25.0) < -3.0
    assert abs(confused(-25.0, std_mps=100.0)) < 0.5


def test_an_aircraft_seen_from_above_flies_level_not_steeply() -> None:
    """From 20 degrees above, the reversal of a level aircraft points its nose 40 degrees up or down."""
    down_20 = np.array([np.cos(np.deg2rad(20)), 0.0, np.sin(np.deg2rad(20))])
    unknown = flight([0.0, 0.0, 0.0], std_mps=40.0)
    assert odds(attitude(0, 0, 0), down_20, unknown) > 0.7
    assert odds(attitude(0, 0, 180), down_20, unknown) > 0.7


def test_a_bank_leans_into_its_turn() -> None:
    """Level sight line: the reversal has the opposite bank, and the velocity is too unsure to tell the way."""
    turning_right = flight([0.0, 20.0, 0.0], std_mps=8.0, turn_rate_radps=0.25)
    assert odds(attitude(30, 0, 80), NORTH, turning_right) > 1.0
    assert odds(attitude(-30, 0, 80), NORTH, turning_right) < -1.0


@pytest.mark.parametrize("other_deg", [-27, 0, 12, 42, 60, 85])
def test_the_likeliest_bank_is_that_of_a_coordinated_turn(other_deg: float) -> None:
    """At 25 m/s and 0.2 rad/s, tan(bank) = v w / g = 25 * 0.2 / 9.81: 27 degrees."""
    turning = flight([0.0, 25.0, 0.0], turn_rate_radps=0.2)
    assert flown_odds(attitude(27, 0, 90), attitude(other_deg, 0, 90), EXACT, turning)[0] > 0.15


@pytest.mark.parametrize("other_deg", [-14, 0, 30])
def test_the_likeliest_pitch_is_the_climb(other_deg: float) -> None:
    """6 m/s up at 24 m/s over ground: 14 degrees."""
    climbing = flight([0.0, 24.0, -6.0])
    assert flown_odds(attitude(0, 14, 90), attitude(0, other_deg, 90), EXACT, climbing)[0] > 0.5


def log_density(R: np.ndarray, P: np.ndarray, way: Flight) -> float:
    """Of the flight and the attitude R [3, 3] of an aircraft: Student's t of four degrees of freedom throughout, by
    SciPy. It flies at 28 m/s, give or take 15, within 5 degrees of its nose, in wind of 5 m/s; it pitches within 8
    degrees of its climb and banks within 15 of a coordinated turn, or, where these are unknown, within 12 and 30."""
    nose, rotation = R[:, 0], np.trace(P) / 3.0
    along = np.outer(nose, nose)
    S = way.P_v + 5.0**2 * np.eye(3) + 15.0**2 * along
    S += 28.0**2 * (np.deg2rad(5.0) ** 2 + rotation) * (np.eye(3) - along)
    v = way.v_mps
    if way.own_nose_ned is not None:  # relative to an own ship at 20 m/s, give or take 10, along its own nose
        v, S = v + 20.0 * way.own_nose_ned, S + 10.0**2 * np.outer(way.own_nose_ned, way.own_nose_ned)
    _, pitch, bank = Rotation.from_matrix(R).as_euler("ZYX")
    climb, turned, climb_var, turned_var, pitch_std, bank_std = 0.0, 0.0, 0.0, 0.0, np.deg2rad(12.0), np.deg2rad(30.0)
    if way.turn_rate_radps is not None:
        speed = np.clip(np.sqrt(way.v_mps @ way.v_mps + np.trace(way.P_v) / 3.0), 12.0, 60.0)
        pitch_std, bank_std = np.deg2rad(8.0), np.deg2rad(15.0)
        # Between level flight and the climb that was seen, as either is sure.
        share = 1.0 / (1.0 + way.P_v[2, 2] / speed**2 / pitch_std**2)
        climb, climb_var = share * np.clip(-way.v_mps[2] / speed, -0.5, 0.5), share * way.P_v[2, 2] / speed**2
        step = 1e-6
        lower, turned, upper = np.arctan(speed * (way.turn_rate_radps + step * np.array([-1.0, 0.0, 1.0])) / 9.81)
        turned_var = ((upper - lower) / (2.0 * step)) ** 2 * way.turn_rate_variance
    density = multivariate_t.logpdf(v, loc=28.0 * nose, shape=S, df=4)
    density += student_t.logpdf(pitch, 4, climb, np.sqrt(pitch_std**2 + climb_var + rotation))
    return float(density + student_t.logpdf(bank, 4, turned, np.sqrt(bank_std**2 + turned_var + rotation)))


@pytest.mark.parametrize("relative", [False, True])
def test_the_odds_are_those_of_the_densities_of_how_aircraft_fly(relative: bool) -> None:
    rng = np.random.default_rng(3)
    within = np.zeros(2)
    for _ in range(100):
        along = rng.normal(size=3) * [1.0, 1.0, 0.4]
        along /= np.linalg.norm(along)
        R = attitude(*rng.normal(size=3) * [25.0, 12.0, 90.0])
        root_v, root = rng.normal(size=(3, 3)) * rng.uniform(1.0, 20.0), rng.normal(scale=0.15, size=(3, 3))
        v_mps, P_v, P = rng.normal(size=3) * [20.0, 20.0, 8.0], root_v @ root_v.T, root @ root.T
        rate = rng.normal(scale=0.3)
        way = Flight(v_mps, P_v, None, 0.0, NORTH) if relative else Flight(v_mps, P_v, rate, 0.1**2, None)
        both = [log_density(one, P, way) for one in (R, reversal(R, along))]
        half_turn = Rotation.from_euler("Z", 180, degrees=True).as_matrix()
        confused = [log_density(one @ half_turn, P, way) for one in (R, reversal(R, along))]
        expected = np.array([both[0] - both[1], max(confused) - max(both)])
        odds = flown_odds(R, reversal(R, along), P, way)
        assert odds == pytest.approx(np.clip(expected, -5.0, 5.0), abs=1e-5)
        within += np.abs(expected) < 5.0
    assert np.all(within > 50)


def test_relative_motion_counts_with_the_own_ships_nose() -> None:
    """Flying north behind a target that neither opens nor closes: it flies north too."""
    way = Flight(np.zeros(3), 9.0 * np.eye(3), None, 0.0, NORTH)
    assert odds(attitude(0, 0, 10), NORTH, way) > 2.0
    assert odds(attitude(0, 0, 170), NORTH, way) < -2.0


@pytest.mark.parametrize("p", [0.02, 0.2, 0.5])
def test_the_networks_sigma_is_taken_apart_into_its_doubt_and_the_rest(p: float) -> None:
    """Told as one sigma for each axis: 6 degrees about the right rotation, and the chance p of the reversal."""
    R, along = attitude(5, 3, 25), np.array([0.0, 0.0, 1.0])
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) @ R  # ned to cam, looking north
    w = Rotation.from_matrix(reversal(R, along) @ R.T).as_rotvec()
    covariance = np.eye(6)
    covariance[3:, 3:] = np.diag(np.deg2rad(6.0) ** 2 + p * w**2)
    log_odds, about_it = network_opinion(
        Estimate(0.9, np.zeros(4), R, np.array([0.0, 0.0, 200.0]), covariance, "track"), along
    )
    assert log_odds == pytest.approx(np.log((1 - p) / p), abs=0.35)
    assert np.all(np.sqrt(np.diag(about_it)) < np.deg2rad(9.0))
