"""Which field of the autopilot's messages becomes what of the own ship."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.clock import UtcClock
from edge.links.mavlink_receive import Receiver
from edge.links.mavlink_telemetry import Telemetry, uptime_ms
from edge.tracking.clock import TimesyncEstimator
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import OwnShip
from msgs.mavlink import FrameReader, MAVLink, dialect

MS = 1_000_000
ROLL, PITCH, YAW = -0.2, 0.1, 0.4
RATES_RADPS = np.array([0.3, -0.2, 0.1])


def attitude(boot_ms: int) -> Any:
    return dialect.MAVLink_attitude_message(boot_ms, ROLL, PITCH, YAW, *RATES_RADPS)


def told(messages: list[Any], time_ms: int) -> OwnShip:
    """The own ship at a time, by messages that arrive as they are stamped."""
    own_ship = OwnShipBuffer()
    telemetry = Telemetry(own_ship, TimesyncEstimator(), UtcClock(), None)
    receiver, reader, autopilot = Receiver(Counter()), FrameReader(datagram=True), MAVLink(None, 1, 1)
    for message in messages:
        now_ns = message.time_boot_ms * MS
        (received,) = receiver.take(bytes(message.pack(autopilot)), reader, now_ns)
        assert telemetry.take(received, now_ns) is None
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


@pytest.mark.parametrize("place", [(47.0, 8.0, 412.0), (-33.0, -70.0, -12.0)], ids=["Alps", "south-west"])
def test_the_place_on_the_globe_is_above_mean_sea_level_and_climbs_as_told(place: tuple[float, float, float]) -> None:
    """Above home it is 37 m, which is no place on the globe; the vertical speed is told in cm/s, down."""
    lat, lon, alt = place
    message = dialect.MAVLink_global_position_int_message(
        1_040, round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 37_000, 2_000, -300, -150, 0
    )
    messages = [attitude(boot_ms) for boot_ms in (1_000, 1_020, 1_040)] + [message]
    assert told(messages, 1_040).lat_lon_alt == pytest.approx(place)
    later = told(messages, 1_080).lat_lon_alt
    assert later is not None
    assert (later[0] - lat) * 111_000.0 == pytest.approx(0.04 * 20.0, rel=0.01)
    assert (later[1] - lon) * 111_320.0 * np.cos(np.deg2rad(lat)) == pytest.approx(0.04 * -3.0, rel=0.01)
    assert later[2] - alt == pytest.approx(0.04 * 1.5)


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
