"""The autopilot repeats what it said last, with new timestamps: no target is placed by it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from edge.types import OwnShip
from msgs.mavlink import dialect

from .test_own_ship_jumps import BEGIN_NS, MS, V_NED_MPS, Autopilot


def own_at(autopilot: Autopilot, k_ms: int) -> OwnShip | None:
    return autopilot.own_ship.at(BEGIN_NS + k_ms * MS)


def yaw_rad(own: OwnShip) -> float:
    return float(np.arctan2(own.R_ned_body[1, 0], own.R_ned_body[0, 0]))


@pytest.mark.parametrize("rate_radps", [0.08, 0.3, -1.0])
def test_an_attitude_that_stands_still_while_its_rates_turn_is_not_used(rate_radps: float) -> None:
    autopilot, told = Autopilot(), []
    for k_ms in range(6000):
        turned_ms = 2000 if 2000 <= k_ms < 5000 else k_ms
        autopilot.turn(k_ms, V_NED_MPS * k_ms / 1000, V_NED_MPS, rate_radps * turned_ms / 1000, rate_radps)
        told += autopilot.station.news(BEGIN_NS + k_ms * MS)
        own, true_rad = own_at(autopilot, k_ms), rate_radps * k_ms / 1000
        if own is not None:
            off_rad = abs(np.arctan2(np.sin(yaw_rad(own) - true_rad), np.cos(yaw_rad(own) - true_rad)))
            assert off_rad < max(0.1, 0.25 * abs(rate_radps)), f"{off_rad:.2f} rad off at {k_ms} ms"
        if 3500 <= k_ms < 5000:
            assert own is None, f"used at {k_ms} ms"
    assert own is not None, "used again"
    assert told == ["the autopilot's attitude stands still while its turn rate says that it moves: it is not used"]
    assert autopilot.station.refused["standstill"] > 60


def rests(k_ms: int) -> tuple[float, float]:
    """Yaw and its rate: at rest, with the error of a gyroscope."""
    return 0.4, 0.02


def repeats(k_ms: int) -> tuple[float, float]:
    """Estimated five times a second, sent fifty times."""
    return 0.3 * (k_ms // 200 * 200) / 1000, 0.3


@pytest.mark.parametrize("yaw_and_rate", [rests, repeats])
def test_an_attitude_of_a_vehicle_at_rest_or_estimated_rarely_is_used(
    yaw_and_rate: Callable[[int], tuple[float, float]],
) -> None:
    autopilot = Autopilot()
    for k_ms in range(8000):
        autopilot.turn(k_ms, np.zeros(3), np.zeros(3), *yaw_and_rate(k_ms))
        assert k_ms < 100 or own_at(autopilot, k_ms) is not None, f"unknown at {k_ms} ms"
    assert autopilot.station.refused["standstill"] == 0


@pytest.mark.parametrize("in_local_ned", [True, False])
def test_a_position_that_stands_still_while_its_velocity_flies_is_not_used(in_local_ned: bool) -> None:
    autopilot, told, placed_m = Autopilot(), [], []
    for k_ms in range(4000):
        now_ns, north_m = BEGIN_NS + k_ms * MS, 20.0 * min(k_ms, 2000) / 1000
        if in_local_ned:
            autopilot.turn(k_ms, np.array([north_m, 0.0, -300.0]), V_NED_MPS)
        else:
            autopilot.attitude(k_ms)
            if k_ms % 100 == 9:
                place = (round((47.0 + north_m / 111_175.0) * 1e7), 80_000_000, 700_000, 300_000, 2000, 0, 0, 0)
                autopilot.tell(dialect.MAVLink_global_position_int_message(now_ns // MS, *place), now_ns)
        told += autopilot.station.news(now_ns)
        own = own_at(autopilot, k_ms)
        if own is not None and in_local_ned and own.t_ned_body_m is not None:
            placed_m.append((k_ms, own.t_ned_body_m[0] - 20.0 * k_ms / 1000))
        elif own is not None and own.lat_lon_alt is not None:
            placed_m.append((k_ms, (own.lat_lon_alt[0] - 47.0) * 111_175.0 - 20.0 * k_ms / 1000))
    assert own is not None, "the attitude stays"
    assert max(abs(off_m) for _, off_m in placed_m) < 20.0
    assert 1900 < placed_m[-1][0] < 3000
    which = "position" if in_local_ned else "global position"
    assert told == [f"the autopilot's {which} stands still while its velocity says that it moves: it is not used"]
