"""Commands addressed to us, each with its answer and what follows from it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue, StopTracking, TrackBox
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, linked, meet, on_the_wire
from .reports import BOX_XYXY_PX, SIZE_WH, K
from .reports import make_report as report
from .reports import make_track as track

CAMERA_COMPONENT = MavlinkSettings().camera_component_id


def test_commands_to_others_are_not_answered() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(400, 1.0, component=1)
        peer.command(400, 1.0, system=SYSTEM_ID + 1)
        peer.settle(lambda: link.counters().get("refused_not_for_us") == 2, "refusal")
        peer.command(2010)
        assert peer.named("COMMAND_ACK").command == 2010, "the first answer is to the command that was ours"


def test_commands_to_all_components_are_answered_once_by_the_camera_where_they_concern_it() -> None:
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(400, 1.0, component=0)
        peer.command(512, 148.0, component=0)
        peer.command(512, 246.0, component=0)  # ADSB_VEHICLE, which is off, and which the autopilot may send
        peer.settle(lambda: link.counters().get("refused_not_for_us") == 3, "refusal")
        peer.command(512, 259.0, component=0)
        acknowledged = peer.named("COMMAND_ACK")
        assert (acknowledged.command, acknowledged.result) == (512, dialect.MAV_RESULT_ACCEPTED)
        assert acknowledged.get_srcComponent() == CAMERA_COMPONENT
        peer.named("CAMERA_INFORMATION")
        peer.command(2010, component=0)
        acknowledged = peer.named("COMMAND_ACK")
        assert (acknowledged.command, acknowledged.get_srcComponent()) == (2010, CAMERA_COMPONENT)
        assert requests.take() == [StopTracking()]


ACCEPTED, DENIED, UNSUPPORTED = (
    dialect.MAV_RESULT_ACCEPTED,
    dialect.MAV_RESULT_DENIED,
    dialect.MAV_RESULT_UNSUPPORTED,
)


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (512, (259.0,), ACCEPTED),
        (512, (275.0,), ACCEPTED),
        (512, (0.0,), ACCEPTED),
        (512, (30.0,), UNSUPPORTED),
        (512, (246.0,), DENIED),
        (512, (math.inf,), DENIED),
        (521, (0.0,), DENIED),
        (511, (275.0, 100_000.0), ACCEPTED),
        (511, (275.0, 500_000.0), ACCEPTED),
        (511, (275.0, 1_000_000.0), ACCEPTED),
        (511, (276.0, 1_000_000.0), ACCEPTED),
        (511, (275.0, 1_250_000.0), DENIED),
        (511, (275.0, 1_000.0), DENIED),
        (511, (275.0, -2.0), DENIED),
        (511, (144.0, 100_000.0), DENIED),
        (511, (0.0, 100_000.0), UNSUPPORTED),
        (511, (math.nan, 1_000.0), DENIED),
        (2004, (1.5, 0.5), DENIED),
        (2004, (math.nan, 0.5), DENIED),
        (2005, (0.6, 0.4, 0.5, 0.6), DENIED),
        (2005, (0.1, 0.4, math.inf, 0.6), DENIED),
        (400, (1.0,), UNSUPPORTED),
    ],
)
def test_commands_are_answered(command: int, params: tuple[float, ...], result: int) -> None:
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(command, *params)
        ack = peer.named("COMMAND_ACK")
        assert (ack.command, ack.result, ack.get_srcComponent()) == (command, result, 100)
        assert (ack.target_system, ack.target_component) == (SYSTEM_ID, 1)
    assert requests.take() == []


def test_pointing_drawing_and_stopping_reach_the_loop_as_requests() -> None:
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(2004, 0.25, 0.75, 0.1)
        assert peer.named("COMMAND_ACK").result == ACCEPTED
        peer.command(2005, 0.1, 0.2, 0.3, 0.4)
        assert peer.named("COMMAND_ACK").result == ACCEPTED
        in_int = dialect.MAVLink_command_int_message(SYSTEM_ID, 100, 0, 2010, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0)
        peer.send(in_int)
        assert peer.named("COMMAND_ACK").result == ACCEPTED
        point, rectangle, stop = requests.take()
    aspect = SIZE_WH[0] / SIZE_WH[1]
    assert isinstance(point, TrackBox)
    np.testing.assert_allclose(point.box_xyxy_share, [0.15, 0.75 - 0.1 * aspect, 0.35, 0.75 + 0.1 * aspect], atol=1e-6)
    assert isinstance(rectangle, TrackBox)
    np.testing.assert_allclose(rectangle.box_xyxy_share, [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    assert stop == StopTracking()


@pytest.mark.parametrize("radius", [math.nan, 0.0, -1.0, 2.0])
def test_a_point_without_a_usable_radius_is_looked_at_four_hundredths_of_the_width_wide(radius: float) -> None:
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(2004, 0.5, 0.5, radius)
        assert peer.named("COMMAND_ACK").result == ACCEPTED
        (point,) = requests.take()
    assert isinstance(point, TrackBox)
    left, top, right, bottom = point.box_xyxy_share
    assert (left, right) == pytest.approx((0.48, 0.52))
    side_px = 0.04 * SIZE_WH[0]
    assert ((top + bottom) / 2, bottom - top) == pytest.approx((0.5, side_px / SIZE_WH[1])), "a square in the picture"


def test_a_loop_that_takes_no_requests_is_told_to_the_sender_who_can_still_stop() -> None:
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def answer(number: int, *parameters: float) -> int:
            peer.received.clear()
            peer.command(number, *parameters)
            return int(peer.named("COMMAND_ACK").result)

        assert [answer(2004, 0.5, 0.5, 0.1) for _ in range(8)] == [ACCEPTED] * 8
        assert answer(511, 275.0, -1.0) == ACCEPTED
        assert answer(2004, 0.5, 0.5, 0.1) == dialect.MAV_RESULT_TEMPORARILY_REJECTED
        sent = told_beside_poses(peer, lambda: link.publish(report(track(time.monotonic_ns()))))
        assert "CAMERA_TRACKING_IMAGE_STATUS" not in sent, "what is turned down changes nothing"
        assert answer(2010) == ACCEPTED
        assert requests.take() == [StopTracking()]


def test_the_camera_says_what_it_is_and_its_lens_where_the_sensor_is_known() -> None:
    for width_mm in (None, 6.4):
        with linked(sensor_width_mm=width_mm) as (link, _), Peer(link.ports[0]) as peer:
            meet(link, peer)
            peer.command(*((512, 259.0) if width_mm is None else (521, 1.0)))
            ack = peer.named("COMMAND_ACK")
            assert (ack.result, ack.get_srcComponent()) == (ACCEPTED, CAMERA_COMPONENT)
            information = peer.named("CAMERA_INFORMATION")
        assert (information.resolution_h, information.resolution_v) == SIZE_WH
        assert (information.flags, information.gimbal_device_id) == (512 + 1024 + 2048, 0)
        if width_mm is None:
            assert math.isnan(information.focal_length), "millimetres are not known from pixels"
        else:
            half_field_rad = math.atan2(0.5 * information.sensor_size_h, information.focal_length)
            assert half_field_rad == pytest.approx(math.atan2(0.5 * SIZE_WH[0], K[0, 0]), abs=1e-6)
            assert information.sensor_size_v == pytest.approx(6.4 * SIZE_WH[1] / SIZE_WH[0])


def test_the_onboard_computer_says_that_it_is_no_camera() -> None:
    """MAVSDK asks it too, and goes on if it accepts: what it waits for comes from the camera alone."""
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        for request in ((512, 259.0), (521, 1.0)):
            peer.command(*request, component=MavlinkSettings().component_id)
            ack = peer.named("COMMAND_ACK")
            assert (ack.command, ack.result, ack.get_srcComponent()) == (request[0], UNSUPPORTED, 191)
        peer.command(2010)
        peer.named("COMMAND_ACK")
        assert "CAMERA_INFORMATION" not in {message.get_type() for message in peer.received}


def test_a_camera_that_opens_at_another_size_than_its_calibrations_is_told_as_it_is() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        half = (SIZE_WH[0] // 2, SIZE_WH[1] // 2)
        link.publish(replace(report(track(time.monotonic_ns())), image_size_wh=half))
        peer.named("CAMERA_TRACKING_IMAGE_STATUS")
        peer.command(512, 259.0)
        information = peer.named("CAMERA_INFORMATION")
        assert (information.resolution_h, information.resolution_v) == half


def test_a_long_name_of_a_camera_is_cut_between_characters() -> None:
    camera = replace(CAMERA, name="Flug über die Küste vor der Nähe.mp4")
    station = Station(MavlinkSettings(system_id=SYSTEM_ID), OwnShipBuffer(), camera, RequestQueue())
    request = dialect.MAVLink_command_long_message(SYSTEM_ID, CAMERA_COMPONENT, 512, 0, 259.0, 0, 0, 0, 0, 0, 0)
    _, information = [letter.message for letter in station.take([request], 0, time.monotonic_ns())]
    told = bytes(information.model_name).rstrip(b"\0").decode()
    assert told == "Flug über die Küste vor der N"


def told_beside_poses(peer: Peer, publish: Callable[[], None]) -> set[str]:
    """The names of what comes while 20 poses do."""
    peer.received.clear()
    poses = 0

    def count(message: Any) -> bool:
        nonlocal poses
        poses += message.get_type() == "TARGET_RELATIVE"
        return poses == 20

    peer.until(count, "20 poses", publish)
    return {message.get_type() for message in peer.received}


def test_a_message_switched_off_stays_off_until_it_is_asked_for_or_switched_on() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def publish() -> None:
            link.publish(report(track(time.monotonic_ns())))

        peer.named("CAMERA_TRACKING_IMAGE_STATUS", publish)
        peer.command(511, 275.0, -1.0)
        peer.named("COMMAND_ACK")
        assert "CAMERA_TRACKING_IMAGE_STATUS" not in told_beside_poses(peer, publish)
        peer.command(512, 275.0)
        peer.named("CAMERA_TRACKING_IMAGE_STATUS", publish)
        peer.command(511, 275.0, 0.0)
        for _ in range(2):
            peer.named("CAMERA_TRACKING_IMAGE_STATUS", publish)


@pytest.mark.parametrize("pointing", [(2004, 0.5, 0.5), (2005, 0.4, 0.4, 0.6, 0.6)])
def test_a_ground_station_that_stops_tracking_is_told_the_box_again_when_it_starts_anew(
    pointing: tuple[int, float],
) -> None:
    """As QGroundControl does: it asks 2 Hz when it starts, and switches the box off when it stops."""
    requests = RequestQueue()
    with linked(requests=requests) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def publish() -> None:
            link.publish(report(track(time.monotonic_ns())))

        def ask(command: int, *params: float) -> None:
            peer.command(command, *params)
            ack = peer.named("COMMAND_ACK")
            assert (ack.command, ack.result) == (command, ACCEPTED)
            requests.take()

        ask(*pointing)
        ask(511, 275.0, 500_000.0)
        ask(2010)
        ask(511, 275.0, -1.0)
        assert "CAMERA_TRACKING_IMAGE_STATUS" not in told_beside_poses(peer, publish)
        ask(*pointing)
        for _ in range(2):
            peer.named("CAMERA_TRACKING_IMAGE_STATUS", publish)


def test_px4_is_not_given_target_relative_on_request_either() -> None:
    with linked() as (link, _), Peer(link.ports[0], autopilot=dialect.MAV_AUTOPILOT_PX4) as peer:
        meet(link, peer)
        peer.command(512, 511.0)
        assert peer.named("COMMAND_ACK").result == DENIED


def test_the_box_told_is_the_chosen_targets() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        now = time.monotonic_ns()
        other = track(now, track_id=1, box_xyxy_px=BOX_XYXY_PX + 200.0)
        link.publish(replace(report(track(now), other, now_ns=now), chosen_id=1))
        status = peer.named("CAMERA_TRACKING_IMAGE_STATUS")
    assert status.rec_top_x == pytest.approx((BOX_XYXY_PX[0] + 200.5) / SIZE_WH[0], rel=1e-5)


@pytest.mark.parametrize("message_id", [511.0, 276.0, 144.0, 246.0])
def test_what_there_is_nothing_to_tell_of_is_turned_down_for_now(message_id: float) -> None:
    with linked(follow_target=True, adsb_icao_address=1) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(512, message_id)
        assert peer.named("COMMAND_ACK").result == dialect.MAV_RESULT_TEMPORARILY_REJECTED, "no frame came"
        in_cam_only = {"R_ned_target": None, "t_ned_target_m": None, "v_ned_target_mps": None, "covariance_ned": None}
        for fields in ([], [in_cam_only]):
            active = len(fields)

            def is_told(message: Any, active: int = active) -> bool:
                return message.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" and message.tracking_status == active

            def publish(fields: list[dict[str, None]] = fields) -> None:
                link.publish(report(*(track(time.monotonic_ns(), **one) for one in fields), own_ship=False))

            peer.until(is_told, "what the camera sees", publish)
            peer.command(512, message_id)
            expected = ACCEPTED if message_id == 511.0 and fields else dialect.MAV_RESULT_TEMPORARILY_REJECTED
            assert peer.named("COMMAND_ACK").result == expected


def test_that_nothing_is_tracked_can_be_asked_for_without_a_frame() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.command(512, 275.0)
        assert peer.named("COMMAND_ACK").result == ACCEPTED
        status = peer.named("CAMERA_TRACKING_IMAGE_STATUS")
        assert status.tracking_status == dialect.CAMERA_TRACKING_STATUS_FLAGS_IDLE


def test_before_the_autopilot_is_received_a_camera_that_tracks_does_not_say_that_it_tracks_nothing() -> None:
    station = Station(MavlinkSettings(system_id=SYSTEM_ID), OwnShipBuffer(), CAMERA, RequestQueue())
    now_ns = time.monotonic_ns()
    assert station.report(report(track(now_ns), now_ns=now_ns), now_ns) == []
    wanted = dialect.MAVLink_command_long_message(SYSTEM_ID, 100, 512, 0, 275.0, *[0.0] * 6)
    by_ground = wanted.pack(MAVLink(None, srcSystem=255, srcComponent=190))
    told = on_the_wire(station.take(FrameReader(datagram=True).feed(by_ground), 0, now_ns))
    assert [(m.get_type(), getattr(m, "result", None)) for m in told] == [
        ("COMMAND_ACK", dialect.MAV_RESULT_TEMPORARILY_REJECTED)
    ]


@pytest.mark.parametrize(("later_s", "told"), [(0.5, True), (1.1, False), (180.0, False)])
def test_what_was_asked_for_once_comes_soon_or_never(later_s: float, told: bool) -> None:
    """Its stream is switched off; the target that was there when it was asked for is gone for a while."""
    station = Station(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue())
    mav, began_ns = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1), 10**12

    def tell(message: Any, now_ns: int) -> list[Any]:
        return on_the_wire(station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns))

    def seen(now_ns: int) -> set[str]:
        tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3), now_ns)
        return {m.get_type() for m in on_the_wire(station.report(report(track(now_ns), now_ns=now_ns), now_ns))}

    def asks(command: int, *params: float) -> int:
        long = dialect.MAVLink_command_long_message(SYSTEM_ID, 100, command, 0, *params, *[0.0] * (7 - len(params)))
        (ack,) = tell(long, began_ns)
        return int(ack.result)

    assert "CAMERA_TRACKING_GEO_STATUS" in seen(began_ns)
    assert asks(511, 276.0, -1.0) == asks(512, 276.0) == ACCEPTED
    assert ("CAMERA_TRACKING_GEO_STATUS" in seen(began_ns + round(later_s * 1e9))) is told
