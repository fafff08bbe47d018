"""The one target that CAMERA_TRACKING_* and FOLLOW_TARGET tell of stays the one it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge.config import MavlinkSettings
from edge.links.mavlink_primary import WITHHELD_MAX_NS, Primary
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, Track, TrackState
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import on_the_wire
from .reports import OWN_NED_M, R_NED_CAM, SIZE_WH, K, make_report, make_track, rangeless

FRAME_NS = 33_333_333
FAR_M = np.array([-60.0, 20.0, 420.0])
HEARTBEAT = dialect.MAVLink_heartbeat_message(
    dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3
)


def near(now_ns: int, seen_ns: int) -> Track:
    state = TrackState.CONFIRMED if seen_ns == now_ns else TrackState.COASTING
    return make_track(now_ns, track_id=0, born_ns=1, state=state, measured_ns=seen_ns)


def far(now_ns: int) -> Track:
    t_ned_m = OWN_NED_M + R_NED_CAM @ FAR_M
    return make_track(now_ns, track_id=1, born_ns=2, t_cam_target_m=FAR_M, t_ned_target_m=t_ned_m)


@pytest.mark.parametrize(("chosen_id", "missed"), [(0, range(30, 50)), (None, range(30, 50)), (None, range(9, 99, 7))])
def test_nobody_is_led_to_another_aircraft_while_the_one_told_is_missed(chosen_id: int | None, missed: range) -> None:
    settings = MavlinkSettings(endpoints=["udpin:127.0.0.1:0"], follow_target=True)
    station = Station(settings, OwnShipBuffer(), CameraInfo("cam", SIZE_WH, K, 30.0), RequestQueue())
    autopilot, seen_ns, told = MAVLink(None, srcSystem=1, srcComponent=1), 0, []
    for frame in range(120):
        now_ns = 10**12 + frame * FRAME_NS
        if frame % 30 == 0:
            station.take(FrameReader(datagram=True).feed(HEARTBEAT.pack(autopilot)), 0, now_ns)
        seen_ns = seen_ns if frame in missed else now_ns
        report = make_report(near(now_ns, seen_ns), far(now_ns), now_ns=now_ns)
        told += on_the_wire(station.report(replace(report, chosen_id=chosen_id), now_ns))
    places = {(one.lat, one.lon) for one in told if one.get_type() == "FOLLOW_TARGET"}
    ranges_m = {round(one.dist) for one in told if one.get_type() == "CAMERA_TRACKING_GEO_STATUS"}
    boxes = {one.point_x for one in told if one.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" and one.tracking_status}
    assert [len(places), len(ranges_m), len(boxes)] == [1, 1, 1]


def test_another_is_told_when_the_one_told_is_lost_or_withheld_for_long_unless_a_person_chose_it() -> None:
    primary, one, other = Primary(), near(5, 5), far(5)
    assert primary.of([one, other], [one, other], None, 0) is one
    assert primary.of([one, other], [other], None, WITHHELD_MAX_NS) is None
    assert primary.of([one, other], [other], 0, WITHHELD_MAX_NS + 1) is None, "a person chose it"
    assert primary.of([one, other], [other], None, WITHHELD_MAX_NS + 1) is other
    assert primary.of([one, other], [one, other], None, WITHHELD_MAX_NS + 2) is other, "nor back"
    assert primary.of([one], [one], None, WITHHELD_MAX_NS + 3) is one, "lost"
    again = replace(one, born_ns=9)
    assert primary.of([again, other], [other], None, WITHHELD_MAX_NS + 4) is other, "its number is another's now"
    assert primary.of([again, other], [again, other], 0, WITHHELD_MAX_NS + 5) is again
    assert primary.of([], [], None, WITHHELD_MAX_NS + 6) is None


def test_of_a_target_whose_range_is_not_known_the_box_alone_is_told() -> None:
    """Neither's at first, then that of the second one, which takes the place of the first."""
    settings = MavlinkSettings(endpoints=["udpin:127.0.0.1:0"], follow_target=True)
    station = Station(settings, OwnShipBuffer(), CameraInfo("cam", SIZE_WH, K, 30.0), RequestQueue())
    autopilot, told = MAVLink(None, srcSystem=1, srcComponent=1), list[tuple[int, Any]]()
    for frame in range(120):
        now_ns = 10**12 + frame * FRAME_NS
        if frame % 30 == 0:
            station.take(FrameReader(datagram=True).feed(HEARTBEAT.pack(autopilot)), 0, now_ns)
        one, other = near(now_ns, now_ns), replace(far(now_ns), box_xyxy_px=np.array([100.0, 100.0, 140.0, 120.0]))
        tracks = (rangeless(one), rangeless(other)) if frame < 60 else (rangeless(one), other)
        report = make_report(*tracks, now_ns=now_ns)
        told += [(frame, message) for message in on_the_wire(station.report(report, now_ns))]

    def frames(name: str) -> list[int]:
        return [frame for frame, message in told if message.get_type() == name]

    boxes = {
        frame: int(message.point_x * SIZE_WH[0])
        for frame, message in told
        if message.get_type() == "CAMERA_TRACKING_IMAGE_STATUS"
    }
    assert {boxes[frame] for frame in boxes if frame < 60} == {1060}
    assert {boxes[frame] for frame in boxes if frame >= 60} == {120}
    assert min(boxes) < 10
    for name in ("TARGET_RELATIVE", "CAMERA_TRACKING_GEO_STATUS", "FOLLOW_TARGET"):
        assert min(frames(name)) >= 60, name


def test_who_lost_the_range_of_the_target_told_shows_its_box_and_leads_nobody_to_another() -> None:
    primary, one, other = Primary(), near(5, 5), far(5)
    assert primary.of([one, other], [one, other], None, 0) is one
    assert primary.of([one, other], [other], None, 1) is None
    assert primary.in_image([one, other], [one], None, 1) is one
    assert primary.in_image([one, other], [], None, 1) is None
    assert primary.of([one, other], [], 1, 2) is None, "a person chose the other"
    assert primary.in_image([one, other], [one, other], 1, 2) is other


def test_who_has_no_range_of_two_targets_shows_the_box_of_one_and_the_same() -> None:
    """Although in every third frame it is the other one alone that is detected; then the other alone has a range."""
    primary, one, other, shown = Primary(), near(5, 5), far(5), []
    for frame in range(300):
        now_ns = frame * FRAME_NS
        first = replace(one, state=TrackState.COASTING) if frame % 3 == 1 else one
        ranged = [other] if 150 <= frame < 160 else []
        told = primary.of([first, other], ranged, None, now_ns)
        assert told is (other if ranged else None)
        box = told or primary.in_image([first, other], [first, other], None, now_ns)
        assert box is not None
        shown.append(box.track_id)
    assert shown == [one.track_id] * 150 + [other.track_id] * 150


def test_a_box_shown_without_a_range_is_not_replaced_by_another_until_it_is_withheld_for_long() -> None:
    primary, one, other = Primary(), near(5, 5), far(5)
    assert primary.in_image([one, other], [one, other], None, 0) is one
    assert primary.in_image([one, other], [other], None, WITHHELD_MAX_NS) is None
    assert primary.in_image([one, other], [other], None, WITHHELD_MAX_NS + 1) is other
    assert primary.in_image([one, other], [one, other], None, WITHHELD_MAX_NS + 2) is other, "nor back"
