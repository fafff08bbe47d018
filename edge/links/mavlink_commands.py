"""COMMAND_LONG and COMMAND_INT addressed to us. Pure: the request, its MAV_RESULT, and the actions that follow.

| command | |
|---|---|
| 2004 CAMERA_TRACK_POINT, 2005 CAMERA_TRACK_RECTANGLE | look for a target there; send its box again if switched off |
| 2010 CAMERA_STOP_TRACKING | drop all targets |
| 511 SET_MESSAGE_INTERVAL | for messages sent at a rate |
| 512 REQUEST_MESSAGE | for messages that are sent |
| 521 REQUEST_CAMERA_INFORMATION | by which QGroundControl up to 4.3 finds a camera |

All other commands are UNSUPPORTED.
"""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass
from typing import Any

from edge.links.mavlink_schedule import RESUMED_HZ
from edge.links.mavlink_table import CAMERA_INFORMATION, HEARTBEAT, IMAGE_STATUS, RATE_LIMITS_HZ
from edge.requests import Request, StopTracking, TrackBox
from msgs.mavlink import dialect

POINT_HALF_SHARE = 0.02  # of the image width: half the box to examine around a point without a radius
RECTANGLE_MIN_SHARE = 1e-3
REQUESTABLE = frozenset((HEARTBEAT, CAMERA_INFORMATION, *RATE_LIMITS_HZ))

CAMERA_COMMANDS = frozenset((
    dialect.MAV_CMD_CAMERA_TRACK_POINT,
    dialect.MAV_CMD_CAMERA_TRACK_RECTANGLE,
    dialect.MAV_CMD_CAMERA_STOP_TRACKING,
))  # fmt: skip


@dataclass(frozen=True)
class Answer:
    """A MAV_RESULT, and what follows from it."""

    result: int
    request: Request | None = None  # to be handed to the loop
    send_once: int | None = None  # message id
    interval: tuple[int, float | None] | None = None  # message id, Hz as Schedule.set_rate takes it


def answer(command: Any, enabled: Container[int], aspect: float, of_camera: bool) -> Answer:
    """Answer a COMMAND_LONG or COMMAND_INT; none of its parameters is trusted.

    `enabled`: message ids that the configuration allows to be sent; `aspect`: image width over height; `of_camera`: the
    camera is asked, not the onboard computer.
    """
    if command.command == dialect.MAV_CMD_REQUEST_MESSAGE:
        return _request_message(command.param1, enabled, of_camera)
    if command.command == dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION:
        return _request_message(CAMERA_INFORMATION if command.param1 == 1.0 else math.nan, enabled, of_camera)
    if command.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
        return _set_interval(command.param1, command.param2, enabled)
    if command.command == dialect.MAV_CMD_CAMERA_TRACK_POINT:
        return _track_point(command.param1, command.param2, command.param3, aspect)
    if command.command == dialect.MAV_CMD_CAMERA_TRACK_RECTANGLE:
        return _track_rectangle((command.param1, command.param2, command.param3, command.param4))
    if command.command == dialect.MAV_CMD_CAMERA_STOP_TRACKING:
        return Answer(dialect.MAV_RESULT_ACCEPTED, request=StopTracking())
    return Answer(dialect.MAV_RESULT_UNSUPPORTED)


def concerns_us(command: Any, enabled: Container[int]) -> bool:
    """Whether a COMMAND_LONG or COMMAND_INT to all components is for ours too; `enabled` as for `answer`.

    All others are left to the autopilot: a refusal beside its answer would only confuse.
    """
    ours = command.param1 in RATE_LIMITS_HZ and command.param1 in enabled
    if command.command == dialect.MAV_CMD_REQUEST_MESSAGE:
        return ours or command.param1 == CAMERA_INFORMATION
    if command.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
        return ours
    return command.command in (*CAMERA_COMMANDS, dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION)


def _request_message(number: float, enabled: Container[int], of_camera: bool) -> Answer:
    if not math.isfinite(number):
        return Answer(dialect.MAV_RESULT_DENIED)
    message_id = int(number)
    # MAVSDK asks each component for it, and one that accepts again and again, until it comes from there.
    if message_id not in REQUESTABLE or (message_id == CAMERA_INFORMATION and not of_camera):
        return Answer(dialect.MAV_RESULT_UNSUPPORTED)
    if message_id in RATE_LIMITS_HZ and message_id not in enabled:
        return Answer(dialect.MAV_RESULT_DENIED)
    return Answer(dialect.MAV_RESULT_ACCEPTED, send_once=message_id)


def _set_interval(number: float, interval_us: float, enabled: Container[int]) -> Answer:
    if not math.isfinite(number) or not math.isfinite(interval_us):
        return Answer(dialect.MAV_RESULT_DENIED)
    message_id = int(number)
    if message_id not in RATE_LIMITS_HZ:
        return Answer(dialect.MAV_RESULT_UNSUPPORTED)
    if message_id not in enabled:
        return Answer(dialect.MAV_RESULT_DENIED)
    if interval_us in (0.0, -1.0):
        return Answer(dialect.MAV_RESULT_ACCEPTED, interval=(message_id, None if interval_us == 0.0 else 0.0))
    low_hz, high_hz = RATE_LIMITS_HZ[message_id]
    if not low_hz <= 1e6 / interval_us <= high_hz * 1.001:
        return Answer(dialect.MAV_RESULT_DENIED)
    return Answer(dialect.MAV_RESULT_ACCEPTED, interval=(message_id, 1e6 / interval_us))


def _track_point(x: float, y: float, radius: float, aspect: float) -> Answer:
    if not (_is_share(x) and _is_share(y)):
        return Answer(dialect.MAV_RESULT_DENIED)
    # The radius may be omitted, as NaN or as 0, which would be one pixel.
    half = radius if _is_share(radius) and radius > RECTANGLE_MIN_SHARE else POINT_HALF_SHARE
    return _look_into((x - half, y - half * aspect, x + half, y + half * aspect))


def _track_rectangle(corners: tuple[float, float, float, float]) -> Answer:
    left, top, right, bottom = corners
    if not all(_is_share(value) for value in corners):
        return Answer(dialect.MAV_RESULT_DENIED)
    if right - left < RECTANGLE_MIN_SHARE or bottom - top < RECTANGLE_MIN_SHARE:
        return Answer(dialect.MAV_RESULT_DENIED)
    return _look_into(corners)


def _look_into(box: tuple[float, float, float, float]) -> Answer:
    left, top, right, bottom = (min(max(value, 0.0), 1.0) for value in box)
    # Ground stations switch the box message off when they stop tracking, and may not switch it on again.
    box_told = (IMAGE_STATUS, RESUMED_HZ)
    return Answer(dialect.MAV_RESULT_ACCEPTED, request=TrackBox((left, top, right, bottom)), interval=box_told)


def _is_share(value: float) -> bool:
    return 0.0 <= value <= 1.0  # False for NaN
