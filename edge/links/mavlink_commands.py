"""COMMAND_LONG and COMMAND_INT addressed to us. Pure: what is asked, and the MAV_RESULT it gets.

Carried out: REQUEST_MESSAGE (512) for CAMERA_INFORMATION, SET_MESSAGE_INTERVAL (511) for what we send at a rate.
All else, tracking by hand too, is answered UNSUPPORTED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from msgs.mavlink import MAVLink_target_relative_message, dialect

TARGET_RELATIVE = MAVLink_target_relative_message.id
IMAGE_STATUS = dialect.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
GEO_STATUS = dialect.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS
CAMERA_INFORMATION = dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION

RATE_LIMITS_HZ = {TARGET_RELATIVE: (0.1, 50.0), IMAGE_STATUS: (5.0, 20.0), GEO_STATUS: (5.0, 20.0)}


@dataclass(frozen=True)
class Answer:
    """A MAV_RESULT, and what follows from it."""

    result: int
    send_camera_information: bool = False
    interval: tuple[int, float | None] | None = None  # message id, Hz: 0 off, None the default


def answer(command: Any) -> Answer:
    """Answer a COMMAND_LONG or COMMAND_INT; no parameter of it is trusted."""
    if command.command == dialect.MAV_CMD_REQUEST_MESSAGE:
        if command.param1 == CAMERA_INFORMATION:
            return Answer(dialect.MAV_RESULT_ACCEPTED, send_camera_information=True)
        return Answer(dialect.MAV_RESULT_UNSUPPORTED)
    if command.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
        return Answer(dialect.MAV_RESULT_UNSUPPORTED)
    if not math.isfinite(command.param1) or not math.isfinite(command.param2):
        return Answer(dialect.MAV_RESULT_DENIED)
    message_id, interval_us = int(command.param1), float(command.param2)
    if message_id not in RATE_LIMITS_HZ:
        return Answer(dialect.MAV_RESULT_UNSUPPORTED)
    if interval_us in (0.0, -1.0):
        return Answer(dialect.MAV_RESULT_ACCEPTED, interval=(message_id, None if interval_us == 0.0 else 0.0))
    low_hz, high_hz = RATE_LIMITS_HZ[message_id]
    if interval_us < 0.0 or not low_hz <= 1e6 / interval_us <= high_hz * 1.001:
        return Answer(dialect.MAV_RESULT_DENIED)
    return Answer(dialect.MAV_RESULT_ACCEPTED, interval=(message_id, 1e6 / interval_us))
