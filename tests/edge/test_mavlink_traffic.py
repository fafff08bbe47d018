"""What targets are told as traffic claims no more than is known of them."""

from __future__ import annotations

import numpy as np
import pytest

from edge.links.mavlink_traffic import VELOCITY_KNOWN, VELOCITY_STD_MAX_MPS, adsb_vehicle, follow_target
from msgs.mavlink import dialect

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
