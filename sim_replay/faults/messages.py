"""Messages that the peers received besides poses: which exposure each belongs to, and whether it is plausible. Pure.

The rig's own ship hovers level, facing north: a target's global position is north of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from msgs import topics
from msgs.mavlink import dialect
from msgs.receive import RAY_TOLERANCE

AUTOPILOT, SUBSCRIBER = "autopilot", "subscriber"
OWN_LAT_LON_ALT = (47.3977, 8.5456, 788.0)
OWN_UP_M = 300.0  # above the local origin
METRES_A_DEGREE = 111_195.0
RANGE_TOLERANCE = 0.02
LEVEL_TOLERANCE = 1e-2
IDLE = dialect.CAMERA_TRACKING_STATUS_FLAGS_IDLE
# Messages and topics about a target of known range, by name.
KINDS = (
    *("CAMERA_TRACKING_IMAGE_STATUS", "CAMERA_TRACKING_GEO_STATUS", "FOLLOW_TARGET", "ADSB_VEHICLE"),
    *("odom", "detections", "tf"),
)


@dataclass(frozen=True)
class ReceivedMessage:
    """Times are UTC."""

    peer: str
    kind: str
    arrival_ns: int
    capture_ns: int | None  # as stated in the message; None: no stamp, it describes the time of its arrival
    fault: str | None  # why it cannot be true, regardless of the time


def from_mavlink(record: dict[str, Any], utc_ns: Callable[[int], int]) -> ReceivedMessage | None:
    """A `message` line of the autopilot (`utc_ns` converts monotonic to UTC); None if it is not about a target."""
    kind = record["message"]
    if kind not in KINDS or (kind == "CAMERA_TRACKING_IMAGE_STATUS" and record["tracking_status"] == IDLE):
        return None
    capture_ns = utc_ns(record["timestamp"] * 1_000_000) if kind == "FOLLOW_TARGET" else None
    return ReceivedMessage(AUTOPILOT, kind, utc_ns(record["t_ns"]), capture_ns, _mavlink_fault(kind, record))


def from_zenoh(record: dict[str, Any]) -> ReceivedMessage:
    """A `sample` line of the subscriber."""
    stamp_ns = record.get("stamp_utc_ns", 0)
    arrival_ns = stamp_ns + round(record.get("age_ms", 0.0) * 1e6)
    return ReceivedMessage(SUBSCRIBER, record["topic"], arrival_ns, stamp_ns, _zenoh_fault(record))


def _mavlink_fault(kind: str, record: dict[str, Any]) -> str | None:
    if kind == "CAMERA_TRACKING_IMAGE_STATUS":
        left, top, right, bottom = (record[f"rec_{name}"] for name in ("top_x", "top_y", "bottom_x", "bottom_y"))
        known = None not in (left, top, right, bottom)
        return None if known and 0 <= left <= right <= 1 and 0 <= top <= bottom <= 1 else "a box outside the picture"
    alt_m = {
        "CAMERA_TRACKING_GEO_STATUS": lambda: record["alt"],
        "FOLLOW_TARGET": lambda: record["alt"],
        "ADSB_VEHICLE": lambda: record["altitude"] * 1e-3,
    }[kind]()
    own_lat, own_lon, own_alt_m = OWN_LAT_LON_ALT
    north_m = (record["lat"] * 1e-7 - own_lat) * METRES_A_DEGREE
    east_m = (record["lon"] * 1e-7 - own_lon) * METRES_A_DEGREE * math.cos(math.radians(own_lat))
    if not _ahead(north_m, east_m):
        return f"a place behind the camera: {north_m:.0f} m north, {east_m:.0f} m east"
    range_m = math.hypot(north_m, east_m, alt_m - own_alt_m)
    told_m = record.get("dist", range_m)
    near = abs(range_m - told_m) <= RANGE_TOLERANCE * told_m
    return None if near else f"a place {range_m:.0f} m away, not {told_m:.0f} m"


def _zenoh_fault(record: dict[str, Any]) -> str | None:
    if "unreadable" in record:
        return str(record["unreadable"])
    if record["topic"] == "odom":
        north_m, east_m, _ = record["t_m"]
        return None if _ahead(north_m, east_m) else f"a place behind the camera: {record['t_m']}"
    if record["topic"] == "tf":
        q_xyzw = record["q_xyzw"].get(topics.FRAME_BODY, (0.0, 0.0, 0.0, 0.0))
        return None if float(np.abs(q_xyzw[3])) >= 1.0 - LEVEL_TOLERANCE else f"an attitude that nobody flew: {q_xyzw}"
    if record["topic"] == "direction":
        x, y, z = record["ray_cam"]
        sane = z > 0.0 and abs(math.hypot(x, y, z) - 1.0) <= RAY_TOLERANCE
        return None if sane else f"a direction behind the camera, or of another length than 1: {record['ray_cam']}"
    return None


def _ahead(north_m: float, east_m: float) -> bool:
    return north_m > abs(east_m)
