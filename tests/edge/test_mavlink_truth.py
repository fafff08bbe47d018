"""What is sent over MAVLink says of a target what is known of it: each figure is that of the field it stands in."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links import mavlink_messages as words
from edge.links.mavlink_station import Station
from edge.links.mavlink_traffic import adsb_vehicle, follow_target
from edge.links.outgoing import sendable
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, OwnShip, TrackState
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, on_the_wire
from .reports import (
    BOX_XYXY_PX,
    ORIGIN,
    R_CAM_TARGET,
    R_NED_CAM,
    SIZE_WH,
    T_CAM_TARGET_M,
    K,
    make_report,
    make_track,
)

NOW_NS = 5_000_000_000
VARIANCES_NED = np.array([4.0, 9.0, 16.0, 1.0, 4.0, 2.0, 0.01, 0.02, 0.09])


def test_the_heading_on_the_globe_comes_with_the_heading_s_own_accuracy() -> None:
    level = Rotation.from_euler("ZYX", [2.5, 0.0, 0.4]).as_matrix()
    track = make_track(NOW_NS, R_ned_target=level, covariance_ned=np.diag(VARIANCES_NED))
    geo = words.geo_status(make_report(track, now_ns=NOW_NS), track)
    assert geo is not None
    assert geo.hdg_acc == pytest.approx(0.3)
    assert geo.v_acc == pytest.approx(4.0)
    assert geo.vel_acc == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("pitch_deg", "told"), [(-90.0, False), (-86.0, False), (-60.0, True), (60.0, True), (88.0, False)]
)
def test_a_target_that_points_straight_up_or_down_has_no_heading(pitch_deg: float, told: bool) -> None:
    steep = Rotation.from_euler("ZYX", [2.0, np.deg2rad(pitch_deg), 0.7])
    covariance = np.diag(VARIANCES_NED)
    track = make_track(NOW_NS, R_ned_target=steep.as_matrix(), covariance_ned=covariance)
    geo = words.geo_status(make_report(track, now_ns=NOW_NS), track)
    assert geo is not None
    turns = np.random.default_rng(5).multivariate_normal(np.zeros(3), covariance[6:, 6:], 20_000)
    noses = (Rotation.from_rotvec(turns) * steep).apply([1.0, 0.0, 0.0])
    off_rad = (np.arctan2(noses[:, 1], noses[:, 0]) - 2.0 + np.pi) % (2.0 * np.pi) - np.pi
    assert (float(np.sqrt(np.mean(off_rad**2))) < 0.7) == told
    assert np.isfinite([geo.hdg, geo.hdg_acc]).tolist() == [told, told]


@pytest.mark.parametrize("pitch_deg", [-45.0, -20.0, 0.0, 30.0, 50.0])
def test_a_slope_makes_the_heading_less_sure_by_as_much_as_tilts_turn_it(pitch_deg: float) -> None:
    nose_on = Rotation.from_euler("ZYX", [2.0, np.deg2rad(pitch_deg), 0.7])
    P = 0.01 * np.array([[4.0, 1.0, 0.5], [1.0, 9.0, -2.0], [0.5, -2.0, 3.0]])
    track = make_track(NOW_NS, R_ned_target=nose_on.as_matrix(), covariance_ned=linalg.block_diag(np.eye(6), P))
    geo = words.geo_status(make_report(track, now_ns=NOW_NS), track)
    assert geo is not None
    small = 0.1  # of the deviations, so that what is linear shows
    turns = np.random.default_rng(5).multivariate_normal(np.zeros(3), small**2 * P, 50_000)
    noses = (Rotation.from_rotvec(turns) * nose_on).apply([1.0, 0.0, 0.0])
    off_rad = np.arctan2(noses[:, 1], noses[:, 0]) - 2.0
    assert geo.hdg_acc == pytest.approx(float(np.std(off_rad)) / small, rel=0.03)


def test_a_velocity_against_the_own_ship_is_not_told_as_one_over_ground() -> None:
    track = make_track(NOW_NS)
    report = make_report(track, now_ns=NOW_NS)
    assert report.own_ship is not None
    nowhere = replace(report.own_ship, t_ned_body_m=None, v_ned_body_mps=None)
    geo = words.geo_status(replace(report, own_ship=nowhere), track)
    assert geo is not None
    assert all(map(math.isnan, (geo.vel_n, geo.vel_e, geo.vel_d, geo.vel_acc)))


def test_a_place_on_the_globe_is_no_surer_than_the_own_one_whichever_message_tells_that() -> None:
    """Without a local position the own ship is where GLOBAL_POSITION_INT says, which is off by as much."""
    told = {}
    for own_m in (np.zeros(3), None):
        own_v = None if own_m is None else np.zeros(3)
        tracker = Tracker(1, Mount(R_NED_CAM, np.zeros(3)))
        for k in range(3):
            own = OwnShip(NOW_NS + k, np.eye(3), own_m, own_v, ORIGIN)
            near = Estimate(0.9, BOX_XYXY_PX, R_CAM_TARGET, 0.1 * T_CAM_TARGET_M, 1e-4 * np.eye(6), "track")
            (track,) = tracker.update(own.time_ns, [near], own, K, SIZE_WH)
        told[own_m is None] = words.geo_status(replace(make_report(track, now_ns=NOW_NS), own_ship=own), track)
    by_local, by_global = told[False], told[True]
    assert by_local is not None
    assert by_global is not None
    assert by_local.v_acc > 1.5
    assert (by_global.h_acc, by_global.v_acc) == pytest.approx((by_local.h_acc, by_local.v_acc), rel=0.01)


def test_the_attitude_s_uncertainty_is_that_of_all_its_axes() -> None:
    track = make_track(NOW_NS, covariance=np.diag([0.09, 0.16, 144.0, 0.01, 0.02, 0.03]))
    message = words.target_relative(track, 1)
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
        {"R_ned_target": np.full((3, 3), np.nan)},
        {"t_cam_target_m": np.array([1.0, 0.0, -200.0])},
        {"box_xyxy_px": np.array([np.nan, 480.0, 1080.0, 500.0])},
    ],
    ids=["covariance in ned", "place in ned", "velocity in ned", "attitude in ned", "behind the camera", "box"],
)
def test_a_track_that_cannot_be_is_not_sent(spoilt: dict[str, Any]) -> None:
    whole, broken = make_track(NOW_NS), make_track(NOW_NS, track_id=1, **spoilt)
    assert sendable(make_report(whole, broken, now_ns=NOW_NS), NOW_NS, 500.0) == [whole]


def test_what_is_hardly_a_target_is_not_sent_unless_the_operator_selected_it() -> None:
    likely, doubtful = make_track(NOW_NS), make_track(NOW_NS, track_id=1, score=0.7)
    report = make_report(likely, doubtful, now_ns=NOW_NS)
    assert sendable(report, NOW_NS, 500.0) == [likely]
    assert sendable(replace(report, chosen_id=1), NOW_NS, 500.0) == [likely, doubtful]
    assert sendable(replace(report, doubtful_below=0.0), NOW_NS, 500.0) == [likely, doubtful]


@pytest.mark.parametrize("variance", [-1e-9, -4.0])
def test_a_covariance_in_ned_that_is_none_costs_what_is_told_in_ned_alone(variance: float) -> None:
    station = Station(MavlinkSettings(follow_target=True), OwnShipBuffer(), CAMERA, RequestQueue())
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3)
    station.take(FrameReader(datagram=True).feed(beat.pack(MAVLink(None, srcSystem=1, srcComponent=1))), 0, NOW_NS)
    spoilt = VARIANCES_NED.copy()
    spoilt[8] = variance
    broken = make_track(NOW_NS, track_id=0, covariance_ned=np.diag(spoilt))
    report = make_report(broken, make_track(NOW_NS, track_id=1), now_ns=NOW_NS)
    told = on_the_wire(station.report(report, NOW_NS))
    poses = {message.id: list(message.q_sensor) for message in told if message.get_type() == "TARGET_RELATIVE"}
    assert set(poses) == {0, 1}
    assert (any(poses[0]), any(poses[1])) == (False, True), "how the camera is turned was told by the same filter"
    assert "CAMERA_TRACKING_IMAGE_STATUS" in {message.get_type() for message in told}
    assert not {"CAMERA_TRACKING_GEO_STATUS", "FOLLOW_TARGET"} & {message.get_type() for message in told}


@pytest.mark.parametrize(
    "box_xyxy_px", [(1950, 500, 1990, 520), (-90, 500, -20, 520), (900, -60, 950, -9), (900, 1090, 950, 1150)]
)
def test_a_predicted_box_outside_the_picture_is_no_rectangle_in_it(box_xyxy_px: tuple[float, ...]) -> None:
    box = np.array(box_xyxy_px, dtype=np.float64)
    coasting = make_track(NOW_NS, state=TrackState.COASTING, box_xyxy_px=box)
    status = words.image_status(make_report(coasting, now_ns=NOW_NS), coasting)
    assert status.tracking_status == dialect.CAMERA_TRACKING_STATUS_FLAGS_COASTING
    assert status.target_data == 0, "no data in the status"
    corners = (status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y)
    assert all(map(math.isnan, (*corners, status.point_x, status.point_y)))


def test_a_predicted_box_that_the_picture_s_edge_cuts_ends_there() -> None:
    coasting = make_track(NOW_NS, state=TrackState.COASTING, box_xyxy_px=np.array([1900.0, 500.0, 1990.0, 520.0]))
    status = words.image_status(make_report(coasting, now_ns=NOW_NS), coasting)
    assert (status.rec_top_x, status.rec_bottom_x) == pytest.approx((1900.5 / 1920, 1.0))


# Spaces stand in where a piece ends before a character that it has no room for.
@given(st.text(st.characters(codec="utf-8", exclude_characters="\0 "), max_size=120))
def test_each_piece_of_a_text_can_be_read_by_itself(text: str) -> None:
    pieces = [bytes(message._text_raw) for message in words.statustexts(4, text, 1)]
    assert "".join(piece.decode() for piece in pieces).replace(" ", "") == text
    assert all(len(piece) == 50 and b"\0" not in piece for piece in pieces[:-1]), "a null would end the text"
    assert len(pieces) == 1 or len(pieces[-1]) < 50
