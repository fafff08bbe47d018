"""Validation of received bytes. Pure except for its counters; everything rejected is counted by reason."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container
from typing import Any

from edge.links.mavlink_commands import concerns_us
from edge.links.mavlink_table import (
    ATTITUDE,
    ATTITUDE_QUATERNION,
    COMMAND_ACK,
    COMMAND_INT,
    COMMAND_LONG,
    GIMBAL_ATTITUDE,
    GLOBAL_POSITION_INT,
    HEARTBEAT,
    LOCAL_POSITION_NED,
    READ_IDS,
)
from msgs.mavlink import FrameReader, dialect, not_finite

DATAGRAM_MAX = 8192  # bytes; longer ones carry no telemetry
RATE_MAX_HZ = 2000
QUATERNION_TOLERANCE = 1e-2
# Physical limits for aircraft: finite but absurd values would pass through the filter into our output.
TURN_RATE_MAX_RADPS = 50.0
ANGLE_MAX_RAD = 2.0 * math.pi
LOCAL_MAX_M = 1e6
SPEED_MAX_MPS = 1e3
ALTITUDE_RANGE_MM = (-10_000_000, 100_000_000)
AUTOPILOT_COMPONENT = 1
GIMBAL_COMPONENTS = (
    dialect.MAV_COMP_ID_GIMBAL,
    dialect.MAV_COMP_ID_GIMBAL2,
    dialect.MAV_COMP_ID_GIMBAL3,
    dialect.MAV_COMP_ID_GIMBAL4,
    dialect.MAV_COMP_ID_GIMBAL5,
    dialect.MAV_COMP_ID_GIMBAL6,
)
# Types that are not vehicles; an antenna tracker, for example, runs an autopilot's firmware as component 1.
NOT_VEHICLES = (
    dialect.MAV_TYPE_GCS,
    dialect.MAV_TYPE_ANTENNA_TRACKER,
    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
    dialect.MAV_TYPE_GIMBAL,
    dialect.MAV_TYPE_ADSB,
    dialect.MAV_TYPE_CAMERA,
)
COMMANDS = (COMMAND_LONG, COMMAND_INT)
# Fields that may be NaN (not known); they are not used.
OPTIONAL_FIELDS = (
    "repr_offset_q",
    "angular_velocity_x",
    "angular_velocity_y",
    "angular_velocity_z",
    "delta_yaw",
    "delta_yaw_velocity",
)


def is_autopilot_heartbeat(message: Any) -> bool:
    """Whether a message is the heartbeat of a vehicle's autopilot, not of a ground station or another companion."""
    return (
        message.get_msgId() == HEARTBEAT
        and message.get_srcSystem() != 0
        and message.get_srcComponent() == AUTOPILOT_COMPONENT
        and message.autopilot != dialect.MAV_AUTOPILOT_INVALID
        and message.type not in NOT_VEHICLES
    )


class Receiver:
    """Checks the messages of one sender, whose address was checked before.

    Each message id of each system and component has a separate rate limit: no flood, not even under the autopilot's id,
    can use up the limit of the autopilot's heartbeat, which would then seem to stop.
    """

    def __init__(self, refused: Counter[str]) -> None:
        self._refused = refused
        self._second = 0
        self._in_second: Counter[tuple[int, int, int]] = Counter()

    def take(self, data: bytes, reader: FrameReader, now_ns: int) -> list[Any]:
        """Messages that are well-formed, of a kind we read and plausible; their sender is checked afterwards."""
        if reader.datagram and data[:1] not in (b"\xfd", b"\xfe"):
            return self._refuse("not_mavlink")
        if reader.datagram and len(data) > DATAGRAM_MAX:
            return self._refuse("too_long")
        bad, unknown = reader.bad_runs, reader.unknown_ids
        messages = reader.feed(data)
        self._refused["bad_data"] += reader.bad_runs - bad
        self._refused["message_id"] += reader.unknown_ids - unknown
        accepted = []
        for message in messages:
            reason = malformed(message) or self._too_many(message, now_ns)
            if reason is None:
                accepted.append(message)
            else:
                self._refused[reason] += 1
        return accepted

    def _refuse(self, reason: str) -> list[Any]:
        self._refused[reason] += 1
        return []

    def _too_many(self, message: Any, now_ns: int) -> str | None:
        second = now_ns // 1_000_000_000
        if second != self._second:
            self._second = second
            self._in_second.clear()
        kind = (message.get_srcSystem(), message.get_srcComponent(), message.get_msgId())
        self._in_second[kind] += 1
        return "rate" if self._in_second[kind] > RATE_MAX_HZ else None


def malformed(message: Any) -> str | None:
    """Why a parsed message is unusable, whoever sent it; None if it is valid."""
    message_id = message.get_msgId()
    if message_id not in READ_IDS:
        return "message_id"
    if message_id in COMMANDS:
        return None  # NaN means "not given" there; each command checks the parameters it reads
    if not_finite(message, but=OPTIONAL_FIELDS) is not None:
        return "not_finite"
    # Senders that do not know it leave it at 0: MAVSDK does in SYSTEM_TIME. Beside others it would look like a reboot.
    if getattr(message, "time_boot_ms", None) == 0:
        return "unstamped"
    if message_id in (ATTITUDE_QUATERNION, GIMBAL_ATTITUDE) and not _is_rotation(message):
        return "quaternion_norm"
    return None if _plausible(message) else "implausible"


def _is_rotation(message: Any) -> bool:
    gimbal = message.get_msgId() == GIMBAL_ATTITUDE
    q = message.q if gimbal else (message.q1, message.q2, message.q3, message.q4)
    return abs(math.hypot(*q) - 1.0) <= QUATERNION_TOLERANCE


def _plausible(message: Any) -> bool:
    message_id = message.get_msgId()
    if message_id in (ATTITUDE, ATTITUDE_QUATERNION):
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        angles = (message.roll, message.pitch, message.yaw) if message_id == ATTITUDE else ()
        return _within(TURN_RATE_MAX_RADPS, *rates) and _within(ANGLE_MAX_RAD, *angles)
    if message_id == LOCAL_POSITION_NED:
        in_place = _within(LOCAL_MAX_M, message.x, message.y, message.z)
        return in_place and _within(SPEED_MAX_MPS, message.vx, message.vy, message.vz)
    if message_id == GLOBAL_POSITION_INT:
        low_mm, high_mm = ALTITUDE_RANGE_MM
        return abs(message.lat) <= 90e7 and abs(message.lon) <= 180e7 and low_mm <= message.alt <= high_mm
    return True


def _within(limit: float, *values: float) -> bool:
    return all(abs(value) <= limit for value in values)


def misaddressed(
    message: Any, vehicle_id: int, our_components: Callable[[int], bool], enabled: Container[int]
) -> str | None:
    """Why a valid message is not for us: telemetry must be from our vehicle's autopilot, commands addressed to us."""
    if message.get_msgId() in COMMANDS:
        to_all = message.target_component == 0 and concerns_us(message, enabled)
        ours = message.target_system == vehicle_id and (to_all or our_components(message.target_component))
        return None if ours else "not_for_us"
    if message.get_srcSystem() != vehicle_id:
        return "not_our_autopilot"
    component = message.get_srcComponent()
    by_gimbal = message.get_msgId() == GIMBAL_ATTITUDE and component in GIMBAL_COMPONENTS
    if component != AUTOPILOT_COMPONENT and not by_gimbal:
        return "not_our_autopilot"
    if message.get_msgId() == COMMAND_ACK:
        # Addressed to another component it answers another's request; zeros mean that the addressee is not given.
        elsewhere = message.target_component != 0 and not our_components(message.target_component)
        return "not_for_us" if message.target_system not in (0, vehicle_id) or elsewhere else None
    return None
