"""Where a gimbal's camera looks: what the link makes of the gimbal's telemetry."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from edge.tracking.own_ship import GimbalFrame, OwnShipBuffer
from edge.types import Mount
from msgs.geometry import rotation_angle
from msgs.mavlink import MAVLink, dialect

from .mavlink_peer import SYSTEM_ID, Peer, linked, meet

BODY = Rotation.from_euler("ZYX", [1.2, 0.15, -0.4])
GIMBAL = Rotation.from_euler("ZYX", [0.6, -0.5, 0.05])
HEADING_ONLY = Rotation.from_euler("Z", 1.2)


@pytest.mark.parametrize(
    ("flags", "R_ned_gimbal"),
    [
        (64, GIMBAL),
        (32, HEADING_ONLY * GIMBAL),
        (16, GIMBAL),
        (0, HEADING_ONLY * GIMBAL),
        (64 + 16, GIMBAL),
        (32 + 16, HEADING_ONLY * GIMBAL),
    ],
)
def test_a_gimbals_attitude_is_read_as_its_flags_say(flags: int, R_ned_gimbal: Rotation) -> None:
    with linked(own_ship=OwnShipBuffer(gimballed=True)) as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        rate = peer.until(lambda m: m.get_type() == "COMMAND_LONG" and m.param1 == 285, "request for its rate")
        assert rate.param2 == 20_000.0
        gimbal = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=154)
        q = np.roll(GIMBAL.as_quat(), 1).tolist()

        def both() -> None:
            peer.attitude(BODY)
            # Its own boot clock, and rates that it does not know.
            stamp = peer.boot_ms() + 77_000
            message = dialect.MAVLink_gimbal_device_attitude_status_message(0, 0, stamp, flags, q, *[math.nan] * 3, 0)
            peer.wire.send(message.pack(gimbal))

        peer.attitude(BODY)
        peer.settle(lambda: link.counters().get("received_ATTITUDE_QUATERNION", 0) > 0, "attitude of the body")
        assert own_ship.at(time.monotonic_ns()) is None, "the body's attitude alone does not say where the camera looks"
        seen: list[Any] = []
        peer.settle(lambda: bool(seen), "both", lambda: (both(), seen.extend(filter(None, [own_ship.at(now_ns())]))))
    R = seen[0].R_ned_body @ seen[0].R_body_gimbal
    np.testing.assert_allclose(R, R_ned_gimbal.as_matrix(), atol=1e-5)
    assert 0.02 <= seen[0].clock_std_s < 0.03, "nobody synchronises a gimbal's clock"
    mount = Mount(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
    optical_axis_ned = seen[0].R_ned_body @ seen[0].camera(mount).R_body_cam[:, 2]
    np.testing.assert_allclose(optical_axis_ned, R_ned_gimbal.apply([1.0, 0.0, 0.0]), atol=1e-5)


def now_ns() -> int:
    return time.monotonic_ns()


@pytest.mark.parametrize(
    ("flags", "failure", "q", "component", "reason"),
    [
        (96, 0, [1.0, 0.0, 0.0, 0.0], 154, "gimbal_frame"),
        (64, 8, [1.0, 0.0, 0.0, 0.0], 154, "gimbal_failure"),
        (64, 0, [1.0, 1.0, 0.0, 0.0], 154, "quaternion_norm"),
        (64, 0, [math.nan, 0.0, 0.0, 0.0], 154, "not_finite"),
        (64, 0, [1.0, 0.0, 0.0, 0.0], 42, "not_our_autopilot"),
    ],
)
def test_a_gimbal_that_cannot_be_right_is_not_believed(
    flags: int, failure: int, q: list[float], component: int, reason: str
) -> None:
    with linked(own_ship=OwnShipBuffer(gimballed=True)) as (link, own_ship), Peer(link.ports[0]) as peer:
        meet(link, peer)
        gimbal = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=component)
        peer.wire.send(
            dialect.MAVLink_gimbal_device_attitude_status_message(0, 0, 5_000, flags, q, 0, 0, 0, failure).pack(gimbal)
        )
        peer.settle(lambda: link.counters().get(f"refused_{reason}") == 1, "refusal")
        peer.attitude(BODY)
        peer.settle(lambda: link.counters().get("received_ATTITUDE_QUATERNION", 0) > 0, "attitude of the body")
        assert own_ship.at(time.monotonic_ns()) is None


PX4, ARDUPILOT = dialect.MAV_AUTOPILOT_PX4, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
LOCKS = 4 + 8 + 16  # roll, pitch and yaw


@pytest.mark.parametrize(
    ("autopilot", "component", "flags", "measured"),
    [
        (PX4, 1, 2 + LOCKS, False),
        (PX4, 1, 0, False),
        (PX4, 1, 64, True),
        (PX4, 154, LOCKS, True),
        (ARDUPILOT, 1, 12, True),
    ],
)
def test_what_px4_steers_a_gimbals_servos_by_is_not_where_the_camera_looks(
    autopilot: int, component: int, flags: int, measured: bool
) -> None:
    own_ship = OwnShipBuffer(gimballed=True)
    with linked(own_ship=own_ship) as (link, _), Peer(link.ports[0], autopilot=autopilot) as peer:
        meet(link, peer)
        gimbal = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=component)

        def both() -> None:
            peer.attitude(BODY)
            nan = math.nan
            status = (
                0,
                0,
                peer.boot_ms(),
                flags,
                [1.0, 0.0, 0.0, 0.0],
                nan,
                nan,
                nan,
                0,
                nan,
                nan,
                int(component == 1),
            )
            peer.wire.send(dialect.MAVLink_gimbal_device_attitude_status_message(*status).pack(gimbal))

        if measured:
            peer.settle(lambda: own_ship.at(now_ns()) is not None, "own attitude", both)
            assert "refused_servo_gimbal" not in link.counters()
        else:
            told = peer.until(lambda m: m.get_type() == "STATUSTEXT", "sentence", both)
            assert told.text.startswith("PX4 tells what it steers the gimbal's servos by")
            assert link.counters()["refused_servo_gimbal"] > 0
            assert own_ship.at(now_ns()) is None
            for _ in range(3):
                peer.until(lambda m: m.get_type() == "TIMESYNC", "what goes on", both)
            texts = [m.text for m in peer.received if m.get_type() == "STATUSTEXT"]
            assert texts.count(told.text) == 1


@pytest.mark.parametrize(("configured", "heard"), [(None, 154), (2, 2)])
def test_the_camera_says_on_which_gimbal_it_is(configured: int | None, heard: int) -> None:
    own_ship = OwnShipBuffer(gimballed=True)
    with linked(own_ship=own_ship, gimbal_component_id=configured) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def gimbal_told() -> int:
            peer.command(512, 259.0)
            return int(peer.named("CAMERA_INFORMATION").gimbal_device_id)

        assert gimbal_told() == (configured or 0), "0: on none, or on one that is not known yet"
        status = dialect.MAVLink_gimbal_device_attitude_status_message(0, 0, 5_000, 64, [1, 0, 0, 0], 0, 0, 0, 0)
        peer.wire.send(status.pack(MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=154)))
        peer.settle(lambda: link.counters().get(f"received_{status.get_type()}") == 1, "attitude of the gimbal")
        assert gimbal_told() == heard


@given(share=st.floats(0.0, 1.0), seed=st.integers(0, 2**32 - 1))
def test_a_gimbals_attitude_between_samples_is_their_slerp(share: float, seed: int) -> None:
    rotations = Rotation.random(2, rng=np.random.default_rng(seed))
    buffer = OwnShipBuffer(gimballed=True)
    for time_ns, rotation in zip((0, 40_000_000), rotations, strict=True):
        assert buffer.add_attitude(time_ns, [1, 0, 0, 0], np.zeros(3))
        assert buffer.add_gimbal(time_ns, np.roll(rotation.as_quat(), 1), GimbalFrame.EARTH)
    time_ns = round(share * 40_000_000)
    own_ship = buffer.at(time_ns)
    assert own_ship is not None
    assert own_ship.R_body_gimbal is not None
    expected = Slerp([0, 40_000_000], rotations)(time_ns).as_matrix()
    assert rotation_angle(own_ship.R_body_gimbal, expected) < 1e-6


def test_a_turning_gimbal_goes_on_turning_for_150_milliseconds_and_is_then_unknown() -> None:
    buffer = OwnShipBuffer(gimballed=True)
    rate_radps = 0.8
    for k in range(6):
        yaw = Rotation.from_euler("z", rate_radps * 0.02 * k)
        buffer.add_attitude(k * 20_000_000, [1, 0, 0, 0], np.zeros(3))
        buffer.add_gimbal(k * 20_000_000, np.roll(yaw.as_quat(), 1), GimbalFrame.HEADING)
    ahead = buffer.at(250_000_000)
    assert ahead is not None
    assert ahead.R_body_gimbal is not None
    np.testing.assert_allclose(ahead.R_body_gimbal, Rotation.from_euler("z", 0.2).as_matrix(), atol=1e-9)
    for k in range(6, 20):
        buffer.add_attitude(k * 20_000_000, [1, 0, 0, 0], np.zeros(3))
    assert buffer.at(251_000_000) is None
