"""What the MAVLink link sends, as an autopilot on loopback sees it."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge import clock
from edge.config import MavlinkSettings
from edge.health import Activity, Condition, HealthState, Reason
from edge.links.mavlink_link import HELD_UP_MAX_NS, MavlinkLink
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import TrackState
from msgs.mavlink import FrameReader, MAVLink, dialect
from tests.waiting import until

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, linked, meet
from .reports import (
    BOX_XYXY_PX,
    FAULT,
    ORIGIN,
    OWN_NED_M,
    R_CAM_TARGET,
    R_NED_CAM,
    ROTATION_UNKNOWN,
    SIZE_WH,
    T_CAM_TARGET_M,
    TRACKING,
    V_NED_MPS,
)
from .reports import make_report as report
from .reports import make_track as track


def test_the_full_pose_arrives_as_target_relative() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        now_ns, utc_us = time.monotonic_ns(), time.time_ns() // 1000
        link.publish(report(track(now_ns), now_ns=now_ns))
        message = peer.named("TARGET_RELATIVE")
    assert (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM_ID, 191)
    assert (message.id, message.frame) == (0, 3)
    assert abs(message.timestamp - utc_us) < 5_000
    np.testing.assert_allclose([message.x, message.y, message.z], T_CAM_TARGET_M, rtol=1e-6)
    np.testing.assert_allclose(message.pos_std, [0.3, 0.4, 12.0], rtol=1e-6)
    R_cam_target = Rotation.from_quat(np.roll(message.q_target, -1)).as_matrix()
    np.testing.assert_allclose(R_cam_target, R_CAM_TARGET, atol=1e-6)
    R_ned_cam = Rotation.from_quat(np.roll(message.q_sensor, -1)).as_matrix()
    np.testing.assert_allclose(R_ned_cam, R_NED_CAM, atol=1e-6)


def test_what_was_told_before_the_end_still_arrives() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.event(3, "the main loop has stood still")
        link.stop()
        assert peer.named("STATUSTEXT").text == "the main loop has stood still"


def test_box_and_place_on_the_globe_arrive_for_the_ground_station() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns())))
        box, place = peer.named("CAMERA_TRACKING_IMAGE_STATUS"), None
        place = next((m for m in peer.received if m.get_type() == "CAMERA_TRACKING_GEO_STATUS"), None)
        place = place or peer.named("CAMERA_TRACKING_GEO_STATUS")
    assert (box.get_srcComponent(), box.tracking_status, box.tracking_mode) == (100, 1, 2)
    corners = [box.rec_top_x, box.rec_top_y, box.rec_bottom_x, box.rec_bottom_y]
    np.testing.assert_allclose(corners, (BOX_XYXY_PX + 0.5) / np.tile(SIZE_WH, 2), rtol=1e-5)
    middle = np.reshape(corners, (2, 2)).mean(axis=0)  # what a display with room for a point draws
    np.testing.assert_allclose([box.point_x, box.point_y], middle, rtol=1e-5)
    north_m = (place.lat * 1e-7 - ORIGIN[0]) * 111_170  # metres a degree at 47 degrees north
    east_m = (place.lon * 1e-7 - ORIGIN[1]) * 76_057
    t_ned_m = np.array([100.0, 50.0, -120.0]) + R_NED_CAM @ T_CAM_TARGET_M
    np.testing.assert_allclose([north_m, east_m], t_ned_m[:2], atol=0.5)
    assert place.alt == pytest.approx(ORIGIN[2] - t_ned_m[2], abs=0.01)
    np.testing.assert_allclose([place.vel_n, place.vel_e, place.vel_d], V_NED_MPS, rtol=1e-6)
    assert (place.h_acc, place.v_acc, place.vel_acc) == pytest.approx((3.0, 4.0, 2.0))
    assert place.dist == pytest.approx(np.linalg.norm(T_CAM_TARGET_M))
    nose = (R_NED_CAM @ R_CAM_TARGET)[:, 0]
    assert place.hdg == pytest.approx(math.atan2(nose[1], nose[0]) % (2 * math.pi), abs=1e-5)


def test_only_sure_fresh_whole_tracks_are_sent_and_coasting_is_said() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        now_ns = time.monotonic_ns()
        withheld = [
            track(now_ns, track_id=1, state=TrackState.TENTATIVE),
            track(now_ns, track_id=2, measured_ns=now_ns - 300_000_000, state=TrackState.COASTING),
            track(now_ns, track_id=3, t_cam_target_m=np.array([math.nan, 0.0, 200.0])),
            track(now_ns, track_id=4, covariance=np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])),
            track(now_ns, track_id=5, covariance=np.diag([1.0, 1.0, 200.0**2, 1.0, 1.0, 1.0])),
        ]
        coasting = track(now_ns, track_id=6, state=TrackState.COASTING, measured_ns=now_ns - 50_000_000)
        link.publish(report(*withheld, coasting))
        status = peer.named("CAMERA_TRACKING_IMAGE_STATUS")
        # A pose sent later shows that nothing of the above is still on its way.
        peer.until(
            lambda m: m.get_type() == "TARGET_RELATIVE" and m.id == 7,
            "later pose",
            lambda: link.publish(report(track(time.monotonic_ns(), track_id=7))),
        )
        peer.settle(lambda: link.counters().get("tracks_withheld") == len(withheld), "count of what was withheld")
    assert status.tracking_status == 8
    assert {m.id for m in peer.received if m.get_type() == "TARGET_RELATIVE"} == {6, 7}


def test_a_camera_that_gives_no_more_frames_is_said_to_track_nothing() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns())))
        assert peer.named("CAMERA_TRACKING_IMAGE_STATUS").tracking_status == 1
        peer.until(
            lambda m: m.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" and m.tracking_status == 0,
            "word that nothing is tracked",
            lambda: link.set_health(FAULT),
        )
        peer.until(
            lambda m: m.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" and m.tracking_status == 1,
            "the next frame's target",
            lambda: link.publish(report(track(time.monotonic_ns()))),
        )


def test_rates_are_bounded() -> None:
    with linked(target_relative_rate_hz=20.0, tracking_rate_hz=10.0) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.received.clear()
        began = time.monotonic()
        peer.settle(
            lambda: time.monotonic() - began > 2.0,
            "two seconds",
            lambda: link.publish(report(track(time.monotonic_ns()))),
        )
    counts = {name: sum(m.get_type() == name for m in peer.received) for name in ("TARGET_RELATIVE",)}
    counts["boxes"] = sum(m.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" for m in peer.received)
    assert 25 <= counts["TARGET_RELATIVE"] <= 43
    assert 12 <= counts["boxes"] <= 23


def test_px4_gets_no_target_relative_unless_asked(caplog: pytest.LogCaptureFixture) -> None:
    for asked in (False, True):
        with (
            linked(target_relative_to_px4=asked) as (link, _),
            Peer(link.ports[0], autopilot=dialect.MAV_AUTOPILOT_PX4) as peer,
        ):
            meet(link, peer)
            link.publish(report(track(time.monotonic_ns())))
            peer.named("CAMERA_TRACKING_IMAGE_STATUS")
            assert ("TARGET_RELATIVE" in {m.get_type() for m in peer.received}) == asked
    assert sum("TARGET_RELATIVE is not sent to PX4" in record.message for record in caplog.records) == 1


def test_an_attitude_that_is_not_known_is_told_as_unknown_and_the_place_all_the_same() -> None:
    with linked(follow_target=True) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns(), covariance=ROTATION_UNKNOWN)))
        told = {name: peer.named(name) for name in ("TARGET_RELATIVE", "CAMERA_TRACKING_GEO_STATUS", "FOLLOW_TARGET")}
    pose, place, traffic = told.values()
    assert list(pose.q_target) == [0.0] * 4
    assert math.hypot(*pose.q_sensor) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose([pose.x, pose.y, pose.z], T_CAM_TARGET_M, atol=1e-4)
    assert (math.isnan(place.hdg), math.isnan(place.hdg_acc)) == (True, True)
    assert math.isfinite(place.h_acc)
    assert (list(traffic.attitude_q), traffic.est_capabilities & 8) == ([0.0] * 4, 0)


def test_heartbeats_come_from_both_components_and_stop_when_the_loop_does() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.set_health(FAULT)
        sources = set()
        while sources != {191, 100}:
            beat = peer.named("HEARTBEAT", lambda: link.set_health(FAULT))
            sources.add(beat.get_srcComponent())
            assert (beat.get_srcSystem(), beat.autopilot) == (SYSTEM_ID, dialect.MAV_AUTOPILOT_INVALID)
            assert beat.type == {191: 18, 100: 30}[beat.get_srcComponent()]
        peer.until(
            lambda m: m.get_type() == "HEARTBEAT" and m.system_status == dialect.MAV_STATE_CRITICAL,
            "heartbeat that tells the fault",
            lambda: link.set_health(FAULT),
        )
        silent_from = time.monotonic()
        last_beat = silent_from
        while time.monotonic() - silent_from < 6.0:
            if any(m.get_type() == "HEARTBEAT" for m in peer.serve()):
                last_beat = time.monotonic()
    assert last_beat - silent_from < 4.5


def test_a_heartbeat_tells_what_goes_on_behind_degraded() -> None:
    tracking = Condition(HealthState.DEGRADED, Activity.TRACKING, (Reason("drops", "12 % of frames dropped"),))
    searching = replace(tracking, activity=Activity.SEARCHING)
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        for condition, status, mode in (
            (tracking, dialect.MAV_STATE_ACTIVE, 3 | 1 << 8),
            (searching, dialect.MAV_STATE_STANDBY, 1 | 1 << 8),
            (FAULT, dialect.MAV_STATE_CRITICAL, 1 << 9),
            (TRACKING, dialect.MAV_STATE_ACTIVE, 3),
        ):
            told = (dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, mode, status)
            peer.until(
                lambda m, told=told: (
                    m.get_type() == "HEARTBEAT" and (m.base_mode, m.custom_mode, m.system_status) == told
                ),
                f"heartbeat that tells {condition.headline}",
                lambda condition=condition: link.set_health(condition),
            )


def test_events_arrive_beside_a_report_that_no_message_holds() -> None:
    nowhere = dataclasses.replace(report(track(time.monotonic_ns())).own_ship, lat_lon_alt=(1e4, 8.0, 400.0))  # type: ignore[type-var]
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        wanted = {f"news {k}" for k in range(20)}
        for text in sorted(wanted):
            link.publish(dataclasses.replace(report(track(time.monotonic_ns())), own_ship=nowhere))
            link.event(6, text)

        def arrived() -> bool:
            return wanted <= {m.text for m in peer.received if m.get_type() == "STATUSTEXT"}

        peer.settle(arrived, "all events")
        peer.settle(lambda: link.counters().get("unpackable", 0) > 0, "count of what no message holds")


def test_a_flood_of_news_leaves_the_line_to_poses_and_to_what_is_wrong() -> None:
    """A ground station that drags a point over the picture chooses a target thirty times a second."""
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        began, number = time.monotonic(), 0

        def drag() -> None:
            nonlocal number
            link.event(6, f"target {(number := number + 1)} chosen")

        peer.settle(lambda: link.counters().get("news_left_out", 0) > 100, "news left out", drag)
        link.event(3, "fault: no frame for 2 s")
        peer.until(lambda m: m.get_type() == "STATUSTEXT" and m.severity == 3, "what is wrong", drag)
        told = [m.text for m in peer.received if m.get_type() == "STATUSTEXT"]
        assert len(told) < 40 + 2 * (time.monotonic() - began)


def test_long_events_arrive_in_chunks_that_belong_together() -> None:
    text = "degraded: no own attitude: poses in the camera frame only; 12 % of frames dropped"
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.event(4, text)
        first, second = peer.named("STATUSTEXT"), peer.named("STATUSTEXT")
    assert first.text + second.text == text
    assert first.id == second.id != 0
    assert (first.chunk_seq, second.chunk_seq, first.severity) == (0, 1, 4)


@pytest.mark.parametrize("length", [51, 99, 100, 101, 150])
def test_the_last_chunk_of_an_event_and_no_other_shows_by_a_null_that_it_is_the_last(length: int) -> None:
    text = "".join(chr(ord("a") + at % 26) for at in range(length))
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.event(4, text)
        chunks = [peer.named("STATUSTEXT")]
        while len(chunks[-1].text) == 50:  # no null in it
            chunks.append(peer.named("STATUSTEXT"))
    assert "".join(chunk.text for chunk in chunks) == text
    assert [chunk.chunk_seq for chunk in chunks] == list(range(len(chunks)))
    assert len({chunk.id for chunk in chunks} - {0}) == 1


def test_the_loop_never_waits_for_the_links_thread_to_count() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as flood:
        junk = b"\xfe\0\0\0\0\0\0\0" * 1_000  # what takes a parser longest: 10 ms
        waited_s, began = 0.0, time.monotonic()
        for _ in range(200):
            flood.wire.send(junk)
            asked = time.monotonic()
            link.counters()
            waited_s += time.monotonic() - asked
        # Waiting for the thread at each count would fill nearly all of this time; sending shares the rest.
        assert waited_s < 0.5 * (time.monotonic() - began)
        flood.settle(lambda: link.counters().get("refused_stranger", 0) > 0, "count of what was refused")


def test_the_target_is_told_as_one_to_follow_and_as_traffic_from_a_system_of_its_own() -> None:
    with (
        linked(follow_target=True, adsb_icao_address=0xF00000, virtual_system_id=77) as (link, _),
        Peer(link.ports[0]) as peer,
    ):
        meet(link, peer)
        now_ns = time.monotonic_ns()
        link.publish(report(track(now_ns, track_id=2), now_ns=now_ns))
        follow, traffic = peer.named("FOLLOW_TARGET"), None
        traffic = next((m for m in peer.received if m.get_type() == "ADSB_VEHICLE"), None) or peer.named("ADSB_VEHICLE")
    assert follow.get_srcSystem() == traffic.get_srcSystem() == 77
    t_ned_m = OWN_NED_M + R_NED_CAM @ T_CAM_TARGET_M
    for place in (follow, traffic):
        north_m, east_m = (place.lat * 1e-7 - ORIGIN[0]) * 111_170, (place.lon * 1e-7 - ORIGIN[1]) * 76_057
        np.testing.assert_allclose([north_m, east_m], t_ned_m[:2], atol=0.5)
    assert follow.alt == pytest.approx(ORIGIN[2] - t_ned_m[2], abs=0.01)
    assert traffic.altitude * 1e-3 == pytest.approx(ORIGIN[2] - t_ned_m[2], abs=0.01)
    np.testing.assert_allclose(follow.vel, V_NED_MPS, rtol=1e-6)
    R_ned_target = Rotation.from_quat(np.roll(follow.attitude_q, -1)).as_matrix()
    np.testing.assert_allclose(R_ned_target, R_NED_CAM @ R_CAM_TARGET, atol=1e-6)
    assert (follow.est_capabilities, follow.timestamp) == (1 + 2 + 8, now_ns // 1_000_000)
    assert (traffic.ICAO_address, traffic.callsign, traffic.emitter_type) == (0xF00002, "UAVPOSE2", 14)
    course_cdeg = math.degrees(math.atan2(V_NED_MPS[1], V_NED_MPS[0])) % 360 * 100
    assert traffic.heading == pytest.approx(course_cdeg, abs=1)
    assert traffic.hor_velocity == pytest.approx(100 * math.hypot(*V_NED_MPS[:2]), abs=1)
    assert traffic.ver_velocity == pytest.approx(-100 * V_NED_MPS[2], abs=1)


def test_without_a_place_on_the_globe_there_is_nothing_to_follow() -> None:
    with linked(follow_target=True, adsb_icao_address=1) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns()), own_ship=False))
        peer.named("TARGET_RELATIVE")
        peer.until(lambda m: m.get_type() == "TIMESYNC", "what comes after")
    assert not {"FOLLOW_TARGET", "ADSB_VEHICLE", "CAMERA_TRACKING_GEO_STATUS"} & {m.get_type() for m in peer.received}


def test_without_own_attitude_the_pose_says_so_and_nothing_is_told_on_the_globe() -> None:
    in_cam_only = {"R_ned_target": None, "t_ned_target_m": None, "v_ned_target_mps": None, "covariance_ned": None}
    with linked(follow_target=True, adsb_icao_address=1) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns(), **in_cam_only), own_ship=False))
        pose = peer.named("TARGET_RELATIVE")
        peer.until(lambda m: m.get_type() == "TIMESYNC", "what comes after")
    assert pose.q_sensor == [0.0] * 4
    np.testing.assert_allclose([pose.x, pose.y, pose.z], T_CAM_TARGET_M, rtol=1e-6)
    assert math.hypot(*pose.q_target) == pytest.approx(1.0, abs=1e-6)
    assert not {"FOLLOW_TARGET", "ADSB_VEHICLE", "CAMERA_TRACKING_GEO_STATUS"} & {m.get_type() for m in peer.received}


def test_a_vehicle_that_has_the_virtual_systems_id_gets_no_traffic(caplog: pytest.LogCaptureFixture) -> None:
    with linked(follow_target=True, virtual_system_id=SYSTEM_ID) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        link.publish(report(track(time.monotonic_ns())))
        peer.settle(lambda: link.counters().get("virtual_system_id_taken", 0) > 0, "count")
    assert "FOLLOW_TARGET" not in {m.get_type() for m in peer.received}
    told = [record.message for record in caplog.records if "FOLLOW_TARGET" in record.message]
    assert told == [f"mavlink: neither FOLLOW_TARGET nor ADSB_VEHICLE is sent: this vehicle too is {SYSTEM_ID}"]


def test_an_autopilot_that_falls_silent_is_in_the_log_once_each_time(
    stepped: int, caplog: pytest.LogCaptureFixture
) -> None:
    silence = "mavlink: the autopilot's heartbeat has stopped"
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        for times in (1, 2):
            peer.heartbeat()
            until(lambda times=times: link.counters().get("received_HEARTBEAT") == times, link.settle, what="heartbeat")
            for _ in range(8):
                clock.step_to(clock.monotonic_ns() + 1_000_000_000)
                link.settle()
            assert [record.message for record in caplog.records].count(silence) == times


def test_the_rest_of_a_report_does_not_go_out_after_the_process_was_held_up(stepped: int) -> None:
    """As when it is stopped between two datagrams of one report, and goes on later."""
    link = MavlinkLink(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue())
    kind = (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    beat = dialect.MAVLink_heartbeat_message(*kind, 0, 0, 4, 3).pack(MAVLink(None, srcSystem=1, srcComponent=1))
    link._station.take(FrameReader(datagram=True).feed(bytes(beat)), 0, stepped)
    for held_up_ns in (HELD_UP_MAX_NS, HELD_UP_MAX_NS + 1):
        began_ns = clock.monotonic_ns()
        letters = link._in_time(report(track(began_ns), now_ns=began_ns), began_ns)
        assert next(letters)
        clock.step_to(began_ns + held_up_ns)
        assert (list(letters) == []) == (held_up_ns > HELD_UP_MAX_NS)
    link.stop()
    assert link._count()["held_up"] == 1
