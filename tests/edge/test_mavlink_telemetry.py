"""Own ship, clocks and rates: what the link makes of the autopilot's telemetry."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.geometry import rotation_angle
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, SYSTEM_ID, Peer, hear, linked, meet, on_the_wire
from .reports import TRACKING, make_report, make_track


def test_own_attitude_is_stamped_with_the_time_it_was_measured() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        turning = Rotation.from_euler("ZYX", [0.3, 0.1, -0.2])
        measured_ns = time.monotonic_ns() - 200_000_000
        stamp_ms = (measured_ns - peer.boot_at_ns) // 1_000_000
        # It arrives 200 ms after it was measured, as over a slow link.
        peer.attitude(turning, stamp_ms)
        peer.settle(lambda: own_ship.at(measured_ns + 2_000_000) is not None, "attitude")
        assert own_ship.at(measured_ns - 100_000_000) is None, "not before it was measured"
        assert own_ship.at(measured_ns + 160_000_000) is None, "not by the time it arrived"
        now = own_ship.at(measured_ns + 2_000_000)
        assert now is not None
        np.testing.assert_allclose(now.R_ned_body, turning.as_matrix(), atol=1e-6)


def asks_for_attitude(message: Any) -> bool:
    return message.get_type() == "COMMAND_LONG" and message.param1 == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


def test_a_reboot_clears_the_own_ship_and_asks_for_rates_again() -> None:
    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        link.set_health(TRACKING)
        peer.until(asks_for_attitude, "first request")
        meet(link, peer)
        hear(own_ship, peer, Rotation.identity())
        before_ns = time.monotonic_ns()
        peer.boot_at_ns = before_ns - 1_000_000
        peer.attitude(Rotation.from_euler("x", 1.0))
        peer.settle(lambda: link.counters()["reboots"] == 1, "reboot")
        assert own_ship.at(before_ns - 1_000_000) is None, "what was before the reboot is gone"
        peer.until(asks_for_attitude, "request after the reboot")


def test_nothing_of_one_vehicle_is_left_when_another_takes_its_place() -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())

    def tell(system_id: int, now_s: float, boot_s: float, rotation: Rotation) -> None:
        mav = MAVLink(None, srcSystem=system_id, srcComponent=1)
        q = np.roll(rotation.as_quat(), 1).tolist()
        for message in (
            dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3),
            dialect.MAVLink_attitude_quaternion_message(round(boot_s * 1000), *q, 0.0, 0.0, 0.0),
        ):
            station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, round(now_s * 1e9))

    turned = Rotation.from_euler("x", 1.0)
    tell(1, now_s=1_000.0, boot_s=500.0, rotation=Rotation.identity())
    station.tick(1_006_000_000_000)
    tell(2, now_s=1_006.0, boot_s=20.0, rotation=turned)
    now = own_ship.at(1_006_010_000_000)
    assert now is not None, "stamped by the clock of the vehicle that is gone"
    np.testing.assert_allclose(now.R_ned_body, turned.as_matrix(), atol=1e-6)
    assert own_ship.at(1_000_000_000_000) is None


def test_rare_quaternions_do_not_hide_frequent_euler_angles() -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())
    mav, start_ns, ms, roll_radps = MAVLink(None, srcSystem=1, srcComponent=1), 1_000_000_000_000, 1_000_000, 0.5

    def tell(message: Any, now_ns: int) -> None:
        station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns)

    for at_ms in range(3_000):
        now_ns, boot_ms, roll = start_ns + at_ms * ms, 50_000 + at_ms, roll_radps * at_ms * 1e-3
        if at_ms % 1_000 == 0:
            tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3), now_ns)
        if at_ms % 20 == 5:
            tell(dialect.MAVLink_attitude_message(boot_ms, roll, 0.0, 0.0, roll_radps, 0.0, 0.0), now_ns)
        if at_ms % 250 == 0:
            q = np.roll(Rotation.from_euler("x", roll).as_quat(), 1).tolist()
            tell(dialect.MAVLink_attitude_quaternion_message(boot_ms, *q, roll_radps, 0.0, 0.0), now_ns)
        if at_ms > 500:
            now = own_ship.at(now_ns)
            assert now is not None, f"unknown {at_ms} ms after the start"
            assert rotation_angle(now.R_ned_body, Rotation.from_euler("x", roll).as_matrix()) < 2e-3
    assert station.refused["late"] == 0


@pytest.mark.parametrize("synced", [True, False])
def test_own_attitude_goes_on_when_the_autopilots_milliseconds_wrap_after_49_days(synced: bool) -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())
    mav, wrap_ns, ms = MAVLink(None, srcSystem=1, srcComponent=1), 1_000_000_000_000, 1_000_000
    station.health(TRACKING, wrap_ns)

    def tell(message: Any, now_ns: int) -> None:
        station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns)

    for now_ns in range(wrap_ns - 2_000 * ms, wrap_ns + 2_000 * ms, 20 * ms):
        up_ns = now_ns - wrap_ns + 2**32 * ms
        if now_ns % (1_000 * ms) == 0:
            beat = (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
            tell(dialect.MAVLink_heartbeat_message(*beat), now_ns)
        asked = on_the_wire(station.tick(now_ns).home)
        for question in (m for m in asked if m.get_type() == "TIMESYNC" and synced):
            tell(dialect.MAVLink_timesync_message(up_ns + ms, question.ts1), now_ns + 2 * ms)
        attitude = dialect.MAVLink_attitude_quaternion_message(up_ns // ms % 2**32, 1.0, 0, 0, 0, 0, 0, 0)
        tell(attitude, now_ns + 5 * ms)
        now = own_ship.at(now_ns + 5 * ms)
        assert now is not None
        if synced and now_ns > wrap_ns - 1_500 * ms:
            assert now.clock_std_s < 2e-3
    assert station.vehicle.reboots == (0 if synced else 1)


def test_data_held_back_by_the_link_is_not_a_reboot_after_49_days() -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())
    mav, start_ns, ms = MAVLink(None, srcSystem=1, srcComponent=1), 1_000_000_000_000, 1_000_000

    def up_ns(at_ns: int) -> int:
        return at_ns - start_ns + 2**32 * ms + 1_000_000_000_000

    def tell(message: Any, now_ns: int) -> None:
        station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns)

    def attitude(at_ns: int, now_ns: int) -> None:
        turned = Rotation.from_euler("z", 0.1 * (at_ns - start_ns) / 1e9)
        q = np.roll(turned.as_quat(), 1).tolist()
        tell(dialect.MAVLink_attitude_quaternion_message(up_ns(at_ns) // ms % 2**32, *q, 0.0, 0.0, 0.1), now_ns)

    for now_ns in range(start_ns, start_ns + 3_000 * ms, 20 * ms):
        if now_ns % (1_000 * ms) == 0:
            tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3), now_ns)
        for question in (m for m in on_the_wire(station.tick(now_ns).home) if m.get_type() == "TIMESYNC"):
            tell(dialect.MAVLink_timesync_message(up_ns(now_ns), question.ts1), now_ns)
        attitude(now_ns, now_ns)
    # The link then delivers nothing for 4 s, and after that everything at once.
    cut_ns, now_ns = start_ns + 3_000 * ms, start_ns + 7_000 * ms
    attitude(cut_ns, now_ns)
    assert own_ship.at(now_ns) is None, "an attitude of four seconds ago passes for the current one"
    for at_ns in range(cut_ns + 20 * ms, now_ns + 1, 20 * ms):
        attitude(at_ns, now_ns)
    assert station.vehicle.reboots == 0
    then = own_ship.at(start_ns + 5_000 * ms)
    assert then is not None
    np.testing.assert_allclose(then.R_ned_body, Rotation.from_euler("z", 0.5).as_matrix(), atol=1e-4)


def test_rates_are_asked_for_with_zeros_and_again_when_they_fall() -> None:
    with linked(attitude_rate_hz=50.0) as (link, _), Peer(link.ports[0]) as peer:
        link.set_health(TRACKING)
        first = peer.until(asks_for_attitude, "request for attitude")
        assert (first.command, first.param2) == (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 20_000.0)
        assert (first.target_system, first.target_component) == (SYSTEM_ID, 1)
        assert [first.param3, first.param4, first.param5, first.param6, first.param7] == [0.0] * 5
        sent_at = 0.0

        def ten_a_second() -> None:
            nonlocal sent_at
            if time.monotonic() - sent_at > 0.1:
                sent_at = time.monotonic()
                peer.attitude(Rotation.identity())

        peer.until(asks_for_attitude, "second request", ten_a_second)
        peer.settle(lambda: link.counters()["rates_asked_again"] >= 1, "count of what was asked again")


def test_our_clock_is_told_to_who_asks() -> None:
    """The one that stamps what we send: who lays it on an own clock by these answers can place our stamps."""
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        before_ns = time.time_ns() - 1_000_000
        peer.send(dialect.MAVLink_timesync_message(0, 123_456_789))
        reply = peer.until(lambda m: m.get_type() == "TIMESYNC" and m.tc1 != 0, "reply")
        assert reply.ts1 == 123_456_789
        assert before_ns <= reply.tc1 <= time.time_ns() + 1_000_000


def test_px4_places_a_pose_on_its_own_clock_by_our_answers() -> None:
    """It learns how far the clock of our answers lies from its own, and adds that to the stamps that we send."""
    station = Station(MavlinkSettings(target_relative_to_px4=True), OwnShipBuffer(), CAMERA, RequestQueue())
    mav, now_ns = MAVLink(None, srcSystem=1, srcComponent=1), time.monotonic_ns()
    own_us = now_ns // 1000 - 50_000_000  # it started 50 s after this host

    def tell(message: Any) -> list[Any]:
        return on_the_wire(station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns))

    tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3))
    (answer,) = tell(dialect.MAVLink_timesync_message(0, own_us * 1000))
    offset_us = own_us - answer.tc1 // 1000
    exposed_ns = now_ns - 30_000_000
    told = on_the_wire(station.report(make_report(make_track(now_ns), now_ns=exposed_ns), now_ns))
    (stamp_us,) = (m.timestamp for m in told if m.get_type() == "TARGET_RELATIVE")
    assert stamp_us + offset_us == pytest.approx(own_us - 30_000, abs=2)


def test_a_refused_rate_is_counted_and_asked_for_less_often() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        peer.accepts = False
        link.set_health(TRACKING)
        peer.settle(lambda: link.counters()["rates_refused"] >= 4, "refusals")
        asked = [m for m in peer.received if asks_for_attitude(m)]
        assert len(asked) < 3, "a refusal is not answered with the same request at once"


@pytest.mark.parametrize("has_quaternion", [True, False])
def test_attitude_in_angles_is_asked_for_where_none_comes_as_a_quaternion(has_quaternion: bool) -> None:
    own_ship = OwnShipBuffer()
    station = Station(MavlinkSettings(), own_ship, CAMERA, RequestQueue())
    mav, ms = MAVLink(None, srcSystem=1, srcComponent=1), 1_000_000
    rates_hz: dict[int, float] = {}

    def tell(message: Any, now_ns: int) -> None:
        station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, now_ns)

    def answer(question: Any, now_ns: int) -> None:
        has = has_quaternion or question.param1 != dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
        if has:
            rates_hz[int(question.param1)] = 1e6 / question.param2
        result = dialect.MAV_RESULT_ACCEPTED if has else dialect.MAV_RESULT_UNSUPPORTED
        tell(dialect.MAVLink_command_ack_message(question.command, result, 0, 0, 1, 191), now_ns)

    for now_ns in range(1_000_000 * ms, 1_015_000 * ms, 20 * ms):
        if now_ns % (1_000 * ms) == 0:
            beat = (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, 4, 3)
            tell(dialect.MAVLink_heartbeat_message(*beat), now_ns)
        if dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION in rates_hz:
            tell(dialect.MAVLink_attitude_quaternion_message(now_ns // ms, 1.0, 0, 0, 0, 0, 0, 0), now_ns)
        if dialect.MAVLINK_MSG_ID_ATTITUDE in rates_hz:
            tell(dialect.MAVLink_attitude_message(now_ns // ms, 0, 0, 0, 0, 0, 0), now_ns)
        asked = on_the_wire(station.tick(now_ns).home)
        for question in (m for m in asked if m.get_type() == "COMMAND_LONG"):
            answer(question, now_ns)
    assert own_ship.at(1_014_990 * ms) is not None
    assert rates_hz.get(dialect.MAVLINK_MSG_ID_ATTITUDE) == (None if has_quaternion else 50.0)


def test_an_attitude_that_the_autopilot_holds_to_be_unhealthy_is_not_used_until_it_is_well() -> None:
    ahrs, gyro = dialect.MAV_SYS_STATUS_AHRS, dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO

    def status(health: int, enabled: int = ahrs | gyro) -> Any:
        return dialect.MAVLink_sys_status_message(ahrs | gyro, enabled, health, 0, 0, -1, -1, *[0] * 6)

    with linked() as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        hear(own_ship, peer, Rotation.identity())
        peer.send(status(ahrs))  # another sensor's failure is the autopilot's affair
        peer.send(status(gyro, enabled=gyro))  # it estimates none

        def tell() -> None:
            peer.attitude(Rotation.identity())

        peer.settle(lambda: link.counters().get("received_SYS_STATUS") == 2, "both states")
        before = link.counters()["received_ATTITUDE_QUATERNION"]
        peer.settle(lambda: link.counters()["received_ATTITUDE_QUATERNION"] >= before + 3, "attitudes", tell)
        assert "refused_unhealthy" not in link.counters()
        peer.send(status(gyro))

        def says_so(message: Any) -> bool:
            return message.get_type() == "STATUSTEXT" and message.text.startswith(
                "the autopilot says that its attitude"
            )

        assert peer.until(says_so, "text", tell).severity == dialect.MAV_SEVERITY_WARNING
        refused = link.counters().get("refused_unhealthy", 0)
        peer.settle(lambda: link.counters().get("refused_unhealthy", 0) >= refused + 10, "refusals", tell)
        assert own_ship.at(time.monotonic_ns()) is None
        assert sum(map(says_so, peer.received)) == 1
        peer.send(status(ahrs | gyro))
        hear(own_ship, peer, Rotation.identity())
