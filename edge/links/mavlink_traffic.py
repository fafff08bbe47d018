"""Targets as traffic: FOLLOW_TARGET and ADSB_VEHICLE. Pure.

Both are sent under a virtual system id: ArduPilot ignores a target with its own id.
"""

from __future__ import annotations

import math
from typing import Any

from edge.links.mavlink_messages import largest_std
from edge.links.outgoing import rotation_known
from edge.tracking.geodesy import lat_lon_alt_from_ned
from edge.types import OwnShip, Report, Track
from msgs.geometry import q_wxyz_from_R
from msgs.mavlink import dialect

CALLSIGN = "UAVPOSE"  # and the target's number: 8 characters at most
POSITION_KNOWN, VELOCITY_KNOWN, ATTITUDE_KNOWN = 1, 2, 8  # est_capabilities, by the bit numbers of its definition
VELOCITY_STD_MAX_MPS = 10.0  # 1-sigma, along the worst axis: neither message can express a velocity's uncertainty
SPEED_MAX_CMPS = 32_767
NS_PER_MS = 1_000_000


def follow_target(report: Report, track: Track) -> Any | None:
    """FOLLOW_TARGET (144), stamped with the exposure in ms of our uptime; None without a global position or before the
    velocity is known: ArduPilot takes a target whose est_capabilities are without a velocity to stand still.

    Acceleration and turn rate are not estimated and are 0; est_capabilities says so of the acceleration, but has one
    bit for attitude and turn rate.
    """
    place, velocity = _place(report.own_ship, track), _velocity_mps(report.own_ship, track)
    R, P = track.R_ned_target, track.covariance_ned
    if place is None or velocity is None or R is None or P is None:
        return None
    turned = rotation_known(track)
    known = POSITION_KNOWN | VELOCITY_KNOWN | ATTITUDE_KNOWN * turned
    lat, lon, alt = place
    return dialect.MAVLink_follow_target_message(
        report.meta.capture_ns // NS_PER_MS,
        known,
        round(lat * 1e7),
        round(lon * 1e7),
        alt,
        velocity,
        [0.0] * 3,
        q_wxyz_from_R(R).tolist() if turned else [0.0] * 4,
        [0.0] * 3,
        [largest_std(P[:2, :2]), math.sqrt(P[2, 2]), 0.0],
        0,
    )


def adsb_vehicle(report: Report, track: Track, icao_address: int, now_ns: int) -> Any | None:
    """ADSB_VEHICLE (246) with `icao_address` plus the target's number; None without a global position."""
    place = _place(report.own_ship, track)
    if place is None:
        return None
    flags = dialect.ADSB_FLAGS_VALID_COORDS | dialect.ADSB_FLAGS_VALID_ALTITUDE | dialect.ADSB_FLAGS_VALID_CALLSIGN
    heading_cdeg, ground_cmps, up_cmps = 0, 0, 0
    velocity = _velocity_mps(report.own_ship, track)
    if velocity is not None:
        north, east, down = velocity
        flags |= dialect.ADSB_FLAGS_VALID_HEADING | dialect.ADSB_FLAGS_VALID_VELOCITY
        flags |= dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
        heading_cdeg = round(math.degrees(math.atan2(east, north)) * 100.0) % 36_000
        ground_cmps = min(round(math.hypot(north, east) * 100.0), SPEED_MAX_CMPS)
        up_cmps = max(min(round(-down * 100.0), SPEED_MAX_CMPS), -SPEED_MAX_CMPS)
    lat, lon, alt = place
    return dialect.MAVLink_adsb_vehicle_message(
        (icao_address + track.track_id) & 0xFFFFFF,
        round(lat * 1e7),
        round(lon * 1e7),
        dialect.ADSB_ALTITUDE_TYPE_GEOMETRIC,
        round(alt * 1e3),
        heading_cdeg,
        ground_cmps,
        up_cmps,
        f"{CALLSIGN}{track.track_id % 10}".encode(),
        dialect.ADSB_EMITTER_TYPE_UAV,
        min((now_ns - track.measured_ns) // 1_000_000_000, 255),
        flags,
        0,
    )


def _place(own_ship: OwnShip | None, track: Track) -> tuple[float, float, float] | None:
    if own_ship is None or own_ship.lat_lon_alt is None or track.t_ned_target_m is None:
        return None
    return lat_lon_alt_from_ned(own_ship.lat_lon_alt, track.t_ned_target_m)


def _velocity_mps(own_ship: OwnShip | None, track: Track) -> list[float] | None:
    """Velocity over ground, or None if unknown: without own position the track's is relative to the own ship."""
    if own_ship is None or own_ship.t_ned_body_m is None or track.v_ned_target_mps is None:
        return None
    P = track.covariance_ned
    if P is None or largest_std(P[3:6, 3:6]) > VELOCITY_STD_MAX_MPS:
        return None
    return [float(v) for v in track.v_ned_target_mps]
