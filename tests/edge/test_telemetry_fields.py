"""Which field of the autopilot's messages becomes what of the own ship."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.clock import UtcClock
from edge.links.mavlink_telemetry import Telemetry, uptime_ms
from edge.tracking.clock import TimesyncEstimator
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import OwnShip
from msgs.mavlink import dialect

MS = 1_000_000
ROLL, PITCH, YAW = -0.2, 0.1, 0.4
RATES_RADPS = np.array([0.3, -0.2, 0.1])


def attitude(boot_ms: int) -> Any:
    return dialect.MAVLink_attitude_message(boot_ms, ROLL, PITCH, YAW, *RATES_RADPS)


def told(messages: list[Any], time_ms: int) -> OwnShip:
    """The own ship at a time, by messages that arrive as they are stamped."""
    own_ship = OwnShipBuffer()
    telemetry = Telemetry(own_ship, TimesyncEstimator(), UtcClock(), None)
    for message in messages:
        assert telemetry.take(message, message.time_boot_ms * MS) is None
    now = own_ship.at(time_ms * MS)
    assert now is not None
    return now


def test_an_attitude_in_angles_is_rolled_pitched_and_yawed_and_goes_on_by_its_rates() -> None:
    messages = [attitude(boot_ms) for boot_ms in (1_000, 1_020, 1_040)]
    turned = Rotation.from_euler("ZYX", [YAW, PITCH, ROLL])
    np.testing.assert_allclose(told(messages, 1_040).R_ned_body, turned.as_matrix(), atol=1e-6)
    later = turned * Rotation.from_rotvec(0.04 * RATES_RADPS)
    np.testing.assert_allclose(told(messages, 1_080).R_ned_body, later.as_matrix(), atol=1e-6)


def test_an_attitude_without_rates_goes_on_as_it_turned_last() -> None:
    """As some autopilots send it: ten a second, all rates zero."""
    turned = [
        Rotation.from_euler("ZYX", [YAW, PITCH, ROLL]) * Rotation.from_rotvec(0.1 * k * RATES_RADPS) for k in range(5)
    ]
    messages = [
        dialect.MAVLink_attitude_message(1_000 + 100 * k, *one.as_euler("ZYX")[::-1], 0.0, 0.0, 0.0)
        for k, one in enumerate(turned[:4])
    ]
    np.testing.assert_allclose(told(messages, 1_400).R_ned_body, turned[4].as_matrix(), atol=1e-6)


def test_the_place_on_the_globe_is_above_mean_sea_level_and_climbs_as_told() -> None:
    """Above home it is 37 m, which is no place on the globe; the vertical speed is told in cm/s, down."""
    place = dialect.MAVLink_global_position_int_message(
        1_040, 470_000_000, 80_000_000, 412_000, 37_000, 2_000, -300, -150, 0
    )
    messages = [attitude(boot_ms) for boot_ms in (1_000, 1_020, 1_040)] + [place]
    assert told(messages, 1_040).lat_lon_alt == pytest.approx((47.0, 8.0, 412.0))
    later = told(messages, 1_080).lat_lon_alt
    assert later is not None
    lat, lon, alt = later
    assert (lat - 47.0) * 111_175.0 == pytest.approx(0.04 * 20.0, rel=0.01)
    assert (lon - 8.0) * 76_057.0 == pytest.approx(0.04 * -3.0, rel=0.01)
    assert alt - 412.0 == pytest.approx(0.04 * 1.5)


def test_without_a_fix_there_is_no_place_on_the_globe() -> None:
    """Until then ArduPilot sends zeros, which are a place in the Gulf of Guinea."""
    unplaced = dialect.MAVLink_global_position_int_message(1_040, 0, 0, 412_000, 0, 0, 0, 0, 0)
    assert told([*map(attitude, (1_000, 1_020, 1_040)), unplaced], 1_040).lat_lon_alt is None


def test_the_local_position_is_north_east_down_and_goes_on_as_told() -> None:
    place = dialect.MAVLink_local_position_ned_message(1_040, 100.0, 50.0, -120.0, 20.0, -3.0, -1.5)
    own = told([*map(attitude, (1_000, 1_020, 1_040)), place], 1_080)
    assert own.t_ned_body_m is not None
    np.testing.assert_allclose(own.t_ned_body_m, [100.8, 49.88, -120.06], atol=1e-6)
    assert own.v_ned_body_mps is not None
    np.testing.assert_allclose(own.v_ned_body_mps, [20.0, -3.0, -1.5], atol=1e-6)


def test_a_timesync_in_utc_does_not_unwrap_the_time_since_boot() -> None:
    now_ns, boot_ms = 9_000 * MS, 5_000
    assert uptime_ms(boot_ms, 1_700_000_000_000 * MS, now_ns) == boot_ms
    assert uptime_ms(boot_ms, 2**32 * MS - 4_000 * MS, now_ns) == 2**32 + boot_ms, "up for 49.7 days, by its own clock"
