"""Hostile input for the daemon: noise, and MAVLink with valid checksums and absurd content."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Iterator
from typing import Any

from msgs.mavlink import MAVLink, dialect

VEHICLE = 1
STRANGE_SYSTEM = 42
DATAGRAM_MAX = 1200
FRAMES_IN_DATAGRAM = (1, 2, 4, 8, 16)
SEQUENCE_NUMBERS = 256
_BOOT_MS = 5_000


def random_datagrams(chance: random.Random) -> Iterator[bytes]:
    """Of random length; every second one begins like MAVLink 2."""
    while True:
        yield chance.randbytes(chance.randrange(1, DATAGRAM_MAX))
        yield b"\xfd" + chance.randbytes(chance.randrange(1, 300))


def hostile_datagrams() -> Iterator[bytes]:
    """Valid checksums: telemetry of another system or component, NaN, infinities, no rotations, absurd positions.

    One frame in a datagram, or several, as autopilots send them too.
    """
    frames = itertools.cycle(hostile_frames())
    for count in itertools.cycle(FRAMES_IN_DATAGRAM):
        yield b"".join(itertools.islice(frames, count))


def hostile_frames() -> list[bytes]:
    """The frames of `hostile_datagrams`, as many as it takes until each sender's sequence numbers begin again."""
    vehicle = MAVLink(None, srcSystem=VEHICLE, srcComponent=1)
    strangers = (
        MAVLink(None, srcSystem=STRANGE_SYSTEM, srcComponent=1),
        MAVLink(None, srcSystem=VEHICLE, srcComponent=66),
        MAVLink(None, srcSystem=255, srcComponent=190),
    )
    frames = []
    for _ in range(SEQUENCE_NUMBERS):
        frames += [_packed(vehicle, message) for message in _absurd()]
        frames += [_packed(stranger, message) for stranger, message in itertools.product(strangers, _upside_down())]
    return frames


def _packed(mav: Any, message: Any) -> bytes:
    """Packed by pymavlink: our own encoder rejects non-finite values."""
    packed = bytes(message.pack(mav))
    mav.seq = (mav.seq + 1) % SEQUENCE_NUMBERS
    return packed


def take_bytes(datagrams: Iterable[bytes], total: int) -> Iterator[bytes]:
    """Datagrams until they add up to `total` bytes."""
    for datagram in datagrams:
        yield datagram
        total -= len(datagram)
        if total <= 0:
            return


def _absurd() -> list[Any]:
    """Impossible values, none of which may reach the own-ship state."""
    nan, inf = math.nan, math.inf
    attitude, place = dialect.MAVLink_attitude_quaternion_message, dialect.MAVLink_local_position_ned_message
    return [
        attitude(_BOOT_MS, nan, 0, 0, 0, 0, 0, 0),
        attitude(_BOOT_MS, 0, 0, 0, 0, 0, 0, 0),
        attitude(_BOOT_MS, 1e30, 0, 0, 0, 0, 0, 0),
        attitude(_BOOT_MS, 1, 0, 0, 0, inf, 0, 0),
        attitude(_BOOT_MS, 1, 0, 0, 0, 1e20, 0, 0),
        dialect.MAVLink_attitude_message(_BOOT_MS, 1e9, nan, -inf, 0, 0, 0),
        place(_BOOT_MS, nan, nan, nan, 0, 0, 0),
        place(_BOOT_MS, 1e38, -1e38, 1e38, 0, 0, 0),
        place(_BOOT_MS, 0, 0, -300, 3e8, 0, 0),
        dialect.MAVLink_global_position_int_message(_BOOT_MS, 2**31 - 1, -(2**31), 2**31 - 1, 0, 0, 0, 0, 0),
        dialect.MAVLink_timesync_message(2**62, 1),
        dialect.MAVLink_timesync_message(-(2**62), -1),
        dialect.MAVLink_command_long_message(
            VEHICLE, 100, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, nan, -inf, nan, nan, nan, nan, nan
        ),
        dialect.MAVLink_command_long_message(
            VEHICLE, 100, dialect.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0, nan, inf, -1e30, 7, nan, nan, nan
        ),
    ]


def _upside_down() -> list[Any]:
    """Valid in itself, but not from our vehicle."""
    fixed_wing, autopilot = dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    return [
        dialect.MAVLink_heartbeat_message(fixed_wing, autopilot, 0, 0, dialect.MAV_STATE_ACTIVE, 3),
        dialect.MAVLink_attitude_quaternion_message(_BOOT_MS, 0, 1, 0, 0, 0, 0, 0),
        dialect.MAVLink_local_position_ned_message(_BOOT_MS, 9e5, 9e5, 0, 0, 0, 0),
    ]
