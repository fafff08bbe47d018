"""Where the own ship is: positions between samples, and on the globe."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.tracking.geodesy import lat_lon_alt_from_ned, radii_m
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import Array

MS = 1_000_000


def ned_from_lat_lon_alt(origin_deg_m: tuple[float, float, float], point_deg_m: tuple[float, float, float]) -> Array:
    """A point's offset [3] in the north-east-down axes at the origin: the inverse of lat_lon_alt_from_ned."""
    per_lat, per_lon = radii_m(origin_deg_m[0], origin_deg_m[2])
    d_lon = (point_deg_m[1] - origin_deg_m[1] + 180.0) % 360.0 - 180.0
    d_lat = point_deg_m[0] - origin_deg_m[0]
    return np.array([np.deg2rad(d_lat) * per_lat, np.deg2rad(d_lon) * per_lon, origin_deg_m[2] - point_deg_m[2]])


def test_of_frequent_positions_some_may_be_lost() -> None:
    """Three a second, of which the two before the last do not come."""
    told_ms = [*range(0, 9_000, 333)]
    del told_ms[-3:-1]
    for time_ms in (told_ms[-1] + 10, told_ms[-1] + 300):
        assert placed(told_ms, time_ms) is not None


def test_position_is_interpolated_extrapolated_and_then_unknown_while_attitude_stays() -> None:
    buffer = OwnShipBuffer()
    for k in range(100):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
    for k in range(11):
        buffer.add_position(k * 100 * MS, [2.5 * k, 0, -100], [25, 0, 0])
    between, after, long_after = buffer.at(450 * MS), buffer.at(1_200 * MS), buffer.at(1_800 * MS)
    assert between is not None
    assert after is not None
    assert long_after is not None
    np.testing.assert_allclose(between.t_ned_body_m, [11.25, 0, -100])
    np.testing.assert_allclose(after.t_ned_body_m, [30.0, 0, -100])
    assert long_after.t_ned_body_m is None
    assert long_after.v_ned_body_mps is None


def test_a_velocity_between_two_positions_lies_between_theirs_and_after_the_last_it_stays() -> None:
    buffer = OwnShipBuffer()
    for k in range(40):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
    buffer.add_position(0, np.zeros(3), [20.0, 0.0, 4.0])
    buffer.add_position(400 * MS, [9.0, 1.0, 0.0], [25.0, 10.0, -4.0])
    for time_ms, share in ((0, 0.0), (100, 0.25), (300, 0.75), (400, 1.0), (700, 1.0)):
        own_ship = buffer.at(time_ms * MS)
        assert own_ship is not None
        assert own_ship.v_ned_body_mps is not None
        np.testing.assert_allclose(own_ship.v_ned_body_mps, [20.0 + 5.0 * share, 10.0 * share, 4.0 - 8.0 * share])


def placed(positions_ms: list[int], time_ms: int) -> np.ndarray | None:
    """Where a ship is, which flies a circle at 25 m/s and 0.4 rad/s and tells its position at these times."""
    buffer = OwnShipBuffer()
    for k in range(time_ms // 20 + 1):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
    for told_ms in positions_ms:
        buffer.add_position(told_ms * MS, *circling(told_ms))
    own_ship = buffer.at(time_ms * MS)
    assert own_ship is not None
    return own_ship.t_ned_body_m


def circling(time_ms: int) -> tuple[np.ndarray, np.ndarray]:
    angle = 0.4 * time_ms / 1e3
    return 62.5 * np.array([np.sin(angle), 1 - np.cos(angle), 0]), 25 * np.array([np.cos(angle), np.sin(angle), 0])


def test_a_position_between_two_far_apart_cuts_no_corner() -> None:
    for time_ms in range(1_000, 2_601, 100):
        t_ned_m = placed([*range(0, 1_001, 50), *range(2_600, 4_001, 50)], time_ms)
        np.testing.assert_allclose(t_ned_m, circling(time_ms)[0], atol=0.05)


def test_in_a_hole_of_seconds_no_position_is_made_up() -> None:
    told_ms = [*range(0, 1_001, 50), *range(6_000, 7_001, 50)]
    assert placed(told_ms, 3_500) is None
    np.testing.assert_allclose(placed(told_ms, 6_500), circling(6_500)[0], atol=0.05)


@pytest.mark.parametrize(("gap_ms", "serve"), [(333, True), (1_000, False)])
def test_a_stream_of_positions_serves_every_picture_or_none(gap_ms: int, serve: bool) -> None:
    """A track changes its frame with each picture that has one and the next that has none."""
    told_ms = list(range(0, 12_000, gap_ms))
    for late_ms in range(0, gap_ms, 37):
        heard = [time_ms for time_ms in told_ms if time_ms <= 10_000 + late_ms]
        assert (placed(heard, heard[-1] + late_ms % 333) is not None) == serve


def ecef_m(lat_deg: float, lon_deg: float, alt_m: float) -> np.ndarray:
    lat, lon = np.deg2rad([lat_deg, lon_deg])
    a, e2 = 6378137.0, 6.69437999014e-3
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array(
        [
            (n + alt_m) * np.cos(lat) * np.cos(lon),
            (n + alt_m) * np.cos(lat) * np.sin(lon),
            (n * (1 - e2) + alt_m) * np.sin(lat),
        ]
    )


@given(
    lat=st.floats(-75, 75),
    lon=st.floats(-180, 180),
    alt=st.floats(-100, 5000),
    ned=st.tuples(st.floats(-1500, 1500), st.floats(-1500, 1500), st.floats(-500, 500)),
)
def test_offsets_on_the_globe_agree_with_earth_centred_coordinates(
    lat: float, lon: float, alt: float, ned: tuple[float, float, float]
) -> None:
    origin = (lat, lon, alt)
    phi, lam = np.deg2rad([lat, lon])
    R_ecef_ned = np.array(
        [
            [-np.sin(phi) * np.cos(lam), -np.sin(lam), -np.cos(phi) * np.cos(lam)],
            [-np.sin(phi) * np.sin(lam), np.cos(lam), -np.cos(phi) * np.sin(lam)],
            [np.cos(phi), 0.0, -np.sin(phi)],
        ]
    )
    expected_m = ecef_m(*origin) + R_ecef_ned @ np.array(ned)
    point = lat_lon_alt_from_ned(origin, ned)
    # Two kilometres of flat earth: its curvature alone is 0.35 m there, meridians converge by up to a few metres.
    assert np.linalg.norm(ecef_m(*point) - expected_m) < 3.0
    np.testing.assert_allclose(ned_from_lat_lon_alt(origin, point), ned, atol=1e-5)


def test_the_origin_on_the_globe_is_where_local_and_global_position_meet() -> None:
    origin = (47.0, 8.0, 400.0)
    buffer = OwnShipBuffer()
    for k in range(20):
        t_ned_m = np.array([30.0 * k, -10.0 * k, -50.0 - k])
        buffer.add_attitude(k * 100 * MS, [1, 0, 0, 0], np.zeros(3))
        buffer.add_position(k * 100 * MS, t_ned_m, [300, -100, -10])
        buffer.add_global(k * 100 * MS, lat_lon_alt_from_ned(origin, t_ned_m), (300.0, -100.0, -10.0))
    own_ship = buffer.at(1_850 * MS)
    assert own_ship is not None
    assert own_ship.lat_lon_alt is not None
    np.testing.assert_allclose(ned_from_lat_lon_alt(origin, own_ship.lat_lon_alt), 0.0, atol=0.1)


@pytest.mark.parametrize("lat", [-60.0, 47.0])
def test_far_from_the_origin_a_target_lies_where_it_is_beside_the_own_ship(lat: float) -> None:
    """Own place as the globe has it, local position as an autopilot tells it, 10 km north and east of its origin."""
    own, buffer = (lat, 8.0, 100.0), OwnShipBuffer()
    for k in range(3):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
        buffer.add_position(k * 20 * MS, [10_000.0, 10_000.0, -100.0], np.zeros(3))
    buffer.add_global(20 * MS, own, (0.0, 0.0, 0.0))
    own_ship = buffer.at(40 * MS)
    assert own_ship is not None
    assert own_ship.lat_lon_alt is not None
    told = lat_lon_alt_from_ned(own_ship.lat_lon_alt, [10_300.0, 9_800.0, -150.0])
    np.testing.assert_allclose(ned_from_lat_lon_alt(own, told), [300.0, -200.0, -50.0], atol=1.0)


@pytest.mark.parametrize("local", [False, True])
@pytest.mark.parametrize("lat", [84.9, 85.1, -85.1, 89.9999999, -90.0])
def test_by_a_pole_no_place_on_the_globe_is_told(lat: float, local: bool) -> None:
    buffer = OwnShipBuffer()
    for k in range(3):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
        if local:
            buffer.add_position(k * 20 * MS, [2_000.0, 0.0, -100.0], np.zeros(3))
    buffer.add_global(20 * MS, (lat, 8.0, 100.0), (0.0, 0.0, 0.0))
    own_ship = buffer.at(40 * MS)
    assert own_ship is not None
    assert (own_ship.t_ned_body_m is not None) == local
    assert (own_ship.lat_lon_alt is None) == (abs(lat) > 85.0)


def test_a_place_on_the_globe_is_not_told_by_one_of_long_ago() -> None:
    buffer = OwnShipBuffer()
    buffer.add_global(0, (47.0, 8.0, 400.0), (0.0, 0.0, 0.0))
    for time_ms in range(0, 7_001, 20):
        buffer.add_attitude(time_ms * MS, [1, 0, 0, 0], np.zeros(3))
        buffer.add_position(time_ms * MS, np.zeros(3), np.zeros(3))
    soon, later = buffer.at(4_900 * MS), buffer.at(5_200 * MS)
    assert soon is not None
    assert later is not None
    assert soon.lat_lon_alt is not None
    assert later.lat_lon_alt is None


def test_without_local_position_the_own_ship_is_where_it_has_flown_to_and_soon_nowhere() -> None:
    fix = (-17.0, 179.9999, 400.0)  # beside the antimeridian
    buffer = OwnShipBuffer()
    for k in range(100):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3))
    buffer.add_global(1_000 * MS, fix, (0.0, 50.0, -5.0))
    soon, later = buffer.at(1_400 * MS), buffer.at(1_600 * MS)
    assert soon is not None
    assert soon.lat_lon_alt is not None
    np.testing.assert_allclose(ned_from_lat_lon_alt(fix, soon.lat_lon_alt), [0.0, 20.0, -2.0], atol=1e-6)
    assert -180.0 <= soon.lat_lon_alt[1] < -179.99, "a longitude beyond 180 degrees is none"
    assert later is not None
    assert later.lat_lon_alt is None, "25 m of unknown flight are no place to tell"


@pytest.mark.parametrize(("gap_ms", "lost_ms", "nowhere_from_ms"), [(50, 3_000, 3_500), (1_000, 3_000, 4_600)])
def test_a_place_that_stands_still_after_the_local_position_has_ended_is_not_told(
    gap_ms: int, lost_ms: int, nowhere_from_ms: int
) -> None:
    """ArduPilot that has lost its position goes on with GLOBAL_POSITION_INT: the last place, at no speed."""
    buffer = OwnShipBuffer()
    places: dict[int, tuple[float, float, float] | None] = {}
    for time_ms in range(0, 20_000, 20):
        flown_m = np.array([25.0 * min(time_ms, lost_ms) / 1e3, 0.0, -100.0])
        buffer.add_attitude(time_ms * MS, [1, 0, 0, 0], np.zeros(3))
        if time_ms % gap_ms < 20 and time_ms < lost_ms:
            buffer.add_position(time_ms * MS, flown_m, [25.0, 0.0, 0.0])
        if time_ms % 200 == 0:
            speed_mps = 25.0 if time_ms < lost_ms else 0.0
            buffer.add_global(time_ms * MS, lat_lon_alt_from_ned((47.0, 8.0, 400.0), flown_m), (speed_mps, 0.0, 0.0))
        own_ship = buffer.at(time_ms * MS)
        assert own_ship is not None
        places[time_ms] = own_ship.lat_lon_alt
    assert all(place is not None for time_ms, place in places.items() if gap_ms + 400 <= time_ms < lost_ms)
    assert {place for time_ms, place in places.items() if time_ms > nowhere_from_ms} == {None}


def test_a_filter_that_jumps_and_then_knows_no_position_leaves_no_place_either() -> None:
    for same_autopilot in (True, False):
        buffer = OwnShipBuffer()
        buffer.add_position(0, np.zeros(3), np.zeros(3))
        buffer.clear(same_autopilot=same_autopilot)
        buffer.add_attitude(990 * MS, [1, 0, 0, 0], np.zeros(3))
        buffer.add_global(980 * MS, (47.0, 8.0, 400.0), (0.0, 0.0, 0.0))
        own_ship = buffer.at(1_000 * MS)
        assert own_ship is not None
        assert (own_ship.lat_lon_alt is None) == same_autopilot, "another one may tell the globe alone"
