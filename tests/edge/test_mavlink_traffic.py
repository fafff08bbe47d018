"""What targets are told as traffic claims no more than is known of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.links.mavlink_packing import Letter
from edge.links.mavlink_traffic import VELOCITY_KNOWN, VELOCITY_STD_MAX_MPS, adsb_vehicle, follow_target
from msgs.mavlink import dialect

from .mavlink_peer import on_the_wire
from .reports import make_report, make_track

MOVING = (
    dialect.ADSB_FLAGS_VALID_HEADING
    | dialect.ADSB_FLAGS_VALID_VELOCITY
    | dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
)  # fmt: skip
ALWAYS = (
    dialect.ADSB_FLAGS_VALID_COORDS
    | dialect.ADSB_FLAGS_VALID_ALTITUDE
    | dialect.ADSB_FLAGS_VALID_CALLSIGN
)  # fmt: skip
NOW_NS = 5_000_000_000


@pytest.mark.parametrize(("worst_mps", "told"), [(0.9 * VELOCITY_STD_MAX_MPS, True), (60.0, False)])
def test_a_velocity_is_told_once_it_is_known(worst_mps: float, told: bool) -> None:
    turned = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    covariance = np.diag([4.0, 9.0, 16.0, 1.0, 1.0, 1.0, 0.01, 0.02, 0.09])
    covariance[3:6, 3:6] = turned @ np.diag([1.0, 4.0, worst_mps**2]) @ turned.T
    track = make_track(NOW_NS, covariance_ned=covariance)
    report = make_report(track, now_ns=NOW_NS)
    follow, traffic = follow_target(report, track), adsb_vehicle(report, track, 0xF00000, NOW_NS)
    assert (follow is not None) is told, "ArduPilot would take the zeros for a velocity"
    assert traffic.flags == (ALWAYS | MOVING if told else ALWAYS)
    if follow is not None:
        assert follow.est_capabilities & VELOCITY_KNOWN
        assert any(follow.vel)
        assert not any([*follow.acc, *follow.rates, follow.custom_state]), "none of these is estimated"
    assert (traffic.hor_velocity > 0) is told


def test_a_velocity_against_the_own_ship_is_none_over_ground() -> None:
    """Where the own ship is known by the globe alone, the track's velocity is relative to it."""
    track = make_track(NOW_NS)
    report = make_report(track, now_ns=NOW_NS)
    assert report.own_ship is not None
    report = replace(report, own_ship=replace(report.own_ship, t_ned_body_m=None, v_ned_body_mps=None))
    traffic = adsb_vehicle(report, track, 0xF00000, NOW_NS)
    assert follow_target(report, track) is None
    assert (traffic.flags, traffic.hor_velocity, traffic.ver_velocity, traffic.heading) == (ALWAYS, 0, 0, 0)


def test_traffic_faster_than_its_message_can_tell_is_told_as_fast_as_it_can() -> None:
    track = make_track(NOW_NS, v_ned_target_mps=np.array([300.0, 400.0, -400.0]))
    traffic = adsb_vehicle(make_report(track, now_ns=NOW_NS), track, 0xF00000, NOW_NS)
    (received,) = on_the_wire([Letter(traffic, 1, 191)])
    assert (received.hor_velocity, received.ver_velocity) == (32_767, 32_767)
    assert received.heading == pytest.approx(5_313, abs=1)
