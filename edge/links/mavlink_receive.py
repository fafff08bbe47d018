"""What is believed of a datagram. Pure but for its counters; everything refused is counted by reason."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

from msgs.mavlink import MAVError, MAVLink, dialect

DATAGRAM_MAX = 8192  # bytes; longer ones carry no telemetry, and parsing is slow
RATE_MAX_HZ = 2000
MAGIC = (0xFD, 0xFE)  # MAVLink 2 and 1
QUATERNION_TOLERANCE = 1e-2
AUTOPILOT_COMPONENT = 1
# Types that fly with nobody's camera; an antenna tracker runs an autopilot's firmware as component 1.
NOT_VEHICLES = (
    dialect.MAV_TYPE_GCS,
    dialect.MAV_TYPE_ANTENNA_TRACKER,
    dialect.MAV_TYPE_ONBOARD_CONTROLLER,
    dialect.MAV_TYPE_GIMBAL,
    dialect.MAV_TYPE_ADSB,
    dialect.MAV_TYPE_CAMERA,
)

TELEMETRY = (
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME,
    dialect.MAVLINK_MSG_ID_ATTITUDE,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    dialect.MAVLINK_MSG_ID_TIMESYNC,
    dialect.MAVLINK_MSG_ID_COMMAND_ACK,
)
COMMANDS = (dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT)


def parse(datagram: bytes) -> list[Any]:
    """All of a datagram's messages, bad ones as pymavlink gives them.

    A parser for each datagram: a truncated header in one must not swallow the next.
    """
    parser = MAVLink(None)
    parser.robust_parsing = True
    try:
        return list(parser.parse_buffer(bytearray(datagram)) or [])
    except MAVError:
        return []


def is_autopilot_heartbeat(message: Any) -> bool:
    """Whether a message is the heartbeat of a vehicle's autopilot, not of a ground station or another companion."""
    return (
        message.get_msgId() == dialect.MAVLINK_MSG_ID_HEARTBEAT
        and message.get_srcSystem() != 0
        and message.get_srcComponent() == AUTOPILOT_COMPONENT
        and message.autopilot != dialect.MAV_AUTOPILOT_INVALID
        and message.type not in NOT_VEHICLES
    )


class Receiver:
    """Checks for one endpoint, whose sender's address was checked before."""

    def __init__(self, refused: Counter[str]) -> None:
        self._refused = refused
        self._second = 0
        self._in_second = 0

    def take(self, datagram: bytes, now_ns: int) -> list[Any]:
        """Messages that are well-formed, of a kind we read and finite; who sent them is the next check."""
        if not datagram or datagram[0] not in MAGIC:
            return self._refuse("not_mavlink")
        if len(datagram) > DATAGRAM_MAX:
            return self._refuse("too_long")
        accepted = []
        for message in parse(datagram):
            reason = malformed(message) or self._too_many(now_ns)
            if reason is None:
                accepted.append(message)
            else:
                self._refused[reason] += 1
        return accepted

    def _refuse(self, reason: str) -> list[Any]:
        self._refused[reason] += 1
        return []

    def _too_many(self, now_ns: int) -> str | None:
        second = now_ns // 1_000_000_000
        self._in_second = self._in_second + 1 if second == self._second else 1
        self._second = second
        return "rate" if self._in_second > RATE_MAX_HZ else None


def malformed(message: Any) -> str | None:
    """Why a parsed message is no use, whoever sent it; None if it is sound."""
    kind = message.get_type()
    if kind == "BAD_DATA":
        return "bad_data"
    # Unknown ids skip CRC and signature in pymavlink.
    if kind.startswith("UNKNOWN") or message.get_msgId() not in TELEMETRY + COMMANDS:
        return "message_id"
    if not _finite(message):
        return "not_finite"
    if message.get_msgId() == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
        norm = math.hypot(message.q1, message.q2, message.q3, message.q4)
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            return "quaternion_norm"
    return None


def _finite(message: Any) -> bool:
    if message.get_msgId() in COMMANDS:
        return True  # NaN stands for "not given" there; each command looks at what it reads
    for field in message.get_fieldnames():
        value = getattr(message, field)
        numbers = value if isinstance(value, (list, tuple)) else (value,)
        if field != "repr_offset_q" and any(isinstance(x, float) and not math.isfinite(x) for x in numbers):
            return False
    return True


def misaddressed(message: Any, vehicle_id: int, our_components: Callable[[int], bool]) -> str | None:
    """Why a sound message is not for us: telemetry must come from our vehicle's autopilot, commands go to us."""
    if message.get_msgId() in COMMANDS:
        ours = message.target_system == vehicle_id and our_components(message.target_component)
        return None if ours else "not_for_us"
    if message.get_srcSystem() != vehicle_id or message.get_srcComponent() != AUTOPILOT_COMPONENT:
        return "not_our_autopilot"
    if message.get_msgId() == dialect.MAVLINK_MSG_ID_COMMAND_ACK and message.target_system not in (0, vehicle_id):
        return "not_for_us"
    return None
