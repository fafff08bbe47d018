"""What is sent over MAVLink says of a target what is known of it: each figure is that of the field it stands in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge.links import mavlink_messages as words
from edge.links.mavlink_traffic import adsb_vehicle, follow_target
from edge.links.outgoing import sendable
from msgs.mavlink import FrameReader, MAVLink

from .reports import make_report, make_track

NOW_NS = 5_000_000_000
VARIANCES_NED = np.array([4.0, 9.0, 16.0, 1.0, 4.0, 2.0, 0.01, 0.02, 0.09])


def test_the_heading_on_the_globe_comes_with_the_heading_s_own_accuracy() -> None:
    track = make_track(NOW_NS, covariance_ned=np.diag(VARIANCES_NED))
    geo = words.geo_status(make_report(track, now_ns=NOW_NS), track)
    assert geo is not None
    assert geo.hdg_acc == pytest.approx(0.3)
    assert geo.v_acc == pytest.approx(4.0)
    assert geo.vel_acc == pytest.approx(2.0)


def test_a_velocity_against_the_own_ship_is_not_told_as_one_over_ground() -> None:
    track = make_track(NOW_NS)
    report = make_report(track, now_ns=NOW_NS)
    assert report.own_ship is not None
    nowhere = replace(report.own_ship, t_ned_body_m=None, v_ned_body_mps=None)
    geo = words.geo_status(replace(report, own_ship=nowhere), track)
    assert geo is not None
    assert all(map(math.isnan, (geo.vel_n, geo.vel_e, geo.vel_d, geo.vel_acc)))


def test_the_attitude_s_uncertainty_is_that_of_all_its_axes() -> None:
    track = make_track(NOW_NS, covariance=np.diag([0.09, 0.16, 144.0, 0.01, 0.02, 0.03]))
    (message,) = FrameReader(datagram=True).feed(words.target_relative(MAVLink(None), track, 1))
    assert message.yaw_std == pytest.approx(math.sqrt(0.02))


def test_traffic_s_age_is_that_of_its_last_sighting() -> None:
    coasting = make_track(NOW_NS, measured_ns=NOW_NS - 1_500_000_000)
    traffic = adsb_vehicle(make_report(coasting, now_ns=NOW_NS), coasting, 1, NOW_NS)
    assert traffic is not None
    assert traffic.tslc == 1


def test_a_target_to_follow_is_as_sure_across_and_in_height_as_its_track() -> None:
    track = make_track(NOW_NS, covariance_ned=np.diag(VARIANCES_NED))
    follow = follow_target(make_report(track, now_ns=NOW_NS), track)
    assert follow is not None
    assert list(follow.position_cov) == pytest.approx([3.0, 4.0, 0.0])


@pytest.mark.parametrize(
    "spoilt",
    [
        {"covariance_ned": np.full((9, 9), np.nan)},
        {"t_ned_target_m": np.array([np.nan, 0.0, 0.0])},
        {"v_ned_target_mps": np.full(3, np.inf)},
        {"t_cam_target_m": np.array([1.0, 0.0, -200.0])},
    ],
    ids=["covariance in ned", "place in ned", "velocity in ned", "behind the camera"],
)
def test_a_track_that_cannot_be_is_not_sent(spoilt: dict[str, Any]) -> None:
    whole, broken = make_track(NOW_NS), make_track(NOW_NS, track_id=1, **spoilt)
    assert sendable(make_report(whole, broken, now_ns=NOW_NS), NOW_NS, 500.0) == [whole]
