"""Reports as MAVLink messages. Pure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from edge.health import Activity, Condition, HealthState
from edge.links.mavlink_receive import AUTOPILOT_COMPONENT
from edge.links.outgoing import UNSURE_ROTATION_RAD, rotation_known
from edge.tracking.geodesy import lat_lon_alt_from_ned
from edge.tracking.view import POSITION_STD_M
from edge.types import Array, CameraInfo, Report, Track, TrackState
from msgs import mavlink
from msgs.geometry import q_wxyz_from_R
from msgs.mavlink import dialect

NAN = math.nan
# Fields for which the message definition allows NaN as "not known".
IMAGE_STATUS_UNKNOWN = ("point_x", "point_y", "radius", "rec_top_x", "rec_top_y", "rec_bottom_x", "rec_bottom_y")
GEO_STATUS_UNKNOWN = ("h_acc", "v_acc", "vel_n", "vel_e", "vel_d", "vel_acc", "hdg", "hdg_acc")
CAMERA_INFORMATION_UNKNOWN = ("focal_length", "sensor_size_h", "sensor_size_v")
STATUSTEXT_BYTES = 50
CAMERA_NAME_BYTES = 32
VENDOR = b"MF-UAVPose6D"
CAMERA_ABILITIES = (
    dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT
    | dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    | dialect.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
)

SYSTEM_STATUS = {
    Activity.WAITING: dialect.MAV_STATE_BOOT,
    Activity.SEARCHING: dialect.MAV_STATE_STANDBY,
    Activity.COASTING: dialect.MAV_STATE_ACTIVE,
    Activity.TRACKING: dialect.MAV_STATE_ACTIVE,
}
# HEARTBEAT.custom_mode: the activity in the lowest byte, and bits for degraded and fault.
MODE_ACTIVITY = {activity: number for number, activity in enumerate(Activity)}
MODE_DEGRADED, MODE_FAULT = 1 << 8, 1 << 9
TRACKING_STATUS = {
    TrackState.CONFIRMED: dialect.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
    TrackState.COASTING: dialect.CAMERA_TRACKING_STATUS_FLAGS_COASTING,
}


def heartbeat(kind: int, condition: Condition) -> Any:
    """HEARTBEAT (0) of one of our components: MAV_TYPE `kind`, no autopilot; custom_mode as MODE_* says."""
    fault, degraded = condition.state is HealthState.FAULT, condition.state is HealthState.DEGRADED
    status = dialect.MAV_STATE_CRITICAL if fault else SYSTEM_STATUS[condition.activity]
    mode = MODE_ACTIVITY[condition.activity] | MODE_DEGRADED * degraded | MODE_FAULT * fault
    flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    return dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_INVALID, flags, mode, status, 3)


def target_relative(track: Track, utc_us: int) -> Any:
    """TARGET_RELATIVE (511): the full pose in `cam`; its timestamp is UNIX time of the exposure, µs."""
    R_ned_cam = None if track.R_ned_target is None else track.R_ned_target @ track.R_cam_target.T
    variance = np.diag(track.covariance)
    return mavlink.target_relative(
        utc_us=utc_us,
        target_id=track.track_id,
        t_cam_target_m=track.t_cam_target_m.tolist(),
        position_std_m=np.sqrt(variance[:3]).tolist(),
        attitude_std_rad=float(np.sqrt(np.mean(variance[3:]))),
        q_cam_target_wxyz=q_wxyz_from_R(track.R_cam_target).tolist() if rotation_known(track) else None,
        q_ned_cam_wxyz=None if R_ned_cam is None else q_wxyz_from_R(R_ned_cam).tolist(),
    )


def image_status(report: Report, track: Track | None) -> Any:
    """CAMERA_TRACKING_IMAGE_STATUS (275): the box in shares of the image, 0..1; idle without a track. A predicted box
    outside the image is sent without a rectangle."""
    if track is None:
        return idle_image_status()
    # Pixel centres are integers, so the image edge lies half a pixel before 0.
    shares = (track.box_xyxy_px.reshape(2, 2) + 0.5) / np.array(report.image_size_wh)
    (left, top), (right, bottom) = np.clip(shares, 0.0, 1.0).tolist()
    if right <= left or bottom <= top:
        predicted = (dialect.CAMERA_TRACKING_STATUS_FLAGS_COASTING, dialect.CAMERA_TRACKING_MODE_RECTANGLE, 0)
        return dialect.MAVLink_camera_tracking_image_status_message(*predicted, *[NAN] * 7)
    return dialect.MAVLink_camera_tracking_image_status_message(
        TRACKING_STATUS[track.state],
        dialect.CAMERA_TRACKING_MODE_RECTANGLE,
        dialect.CAMERA_TRACKING_TARGET_DATA_IN_STATUS,
        0.5 * (left + right),
        0.5 * (top + bottom),
        NAN,
        left,
        top,
        right,
        bottom,
    )


def idle_image_status() -> Any:
    """CAMERA_TRACKING_IMAGE_STATUS (275) of a camera that tracks nothing."""
    idle = (dialect.CAMERA_TRACKING_STATUS_FLAGS_IDLE, dialect.CAMERA_TRACKING_MODE_NONE, 0)
    return dialect.MAVLink_camera_tracking_image_status_message(*idle, *[NAN] * 7)


def geo_status(report: Report, track: Track) -> Any | None:
    """CAMERA_TRACKING_GEO_STATUS (276): the target's global position; None without own attitude and global position."""
    own_ship = report.own_ship
    t_m, R, P = track.t_ned_target_m, track.R_ned_target, track.covariance_ned
    if own_ship is None or own_ship.lat_lon_alt is None or t_m is None or R is None or P is None:
        return None
    lat, lon, alt = lat_lon_alt_from_ned(own_ship.lat_lon_alt, t_m)
    P_place, velocity, vel_acc = P[:3, :3], [NAN] * 3, NAN
    if own_ship.t_ned_body_m is None:
        # Relative to the own ship: the own position's error is missing, and such a velocity cannot be expressed.
        P_place = P_place + POSITION_STD_M**2 * np.eye(3)
    elif track.v_ned_target_mps is not None:
        velocity, vel_acc = track.v_ned_target_mps.tolist(), largest_std(P[3:6, 3:6])
    heading_rad, heading_std_rad = _heading_rad(R, P[6:, 6:]) if rotation_known(track) else (NAN, NAN)
    return dialect.MAVLink_camera_tracking_geo_status_message(
        TRACKING_STATUS[track.state],
        round(lat * 1e7),
        round(lon * 1e7),
        alt,
        largest_std(P_place[:2, :2]),
        math.sqrt(P_place[2, 2]),
        *velocity,
        vel_acc,
        float(np.linalg.norm(track.t_cam_target_m)),
        heading_rad,
        heading_std_rad,
    )


def camera_information(camera: CameraInfo, sensor_width_mm: float | None, gimbal_id: int | None, boot_ms: int) -> Any:
    """CAMERA_INFORMATION (259). The focal length in mm is computed from the sensor's width; NaN if that is unknown.
    `gimbal_id`: of the gimbal that it is on, a component id or the autopilot's number 1 to 6."""
    width_px, height_px = camera.image_size_wh
    mm_per_px = NAN if sensor_width_mm is None else sensor_width_mm / width_px
    name = camera.name.encode()[:CAMERA_NAME_BYTES].decode(errors="ignore").encode()  # whole characters
    return dialect.MAVLink_camera_information_message(
        boot_ms,
        list(VENDOR.ljust(CAMERA_NAME_BYTES, b"\0")),
        list(name.ljust(CAMERA_NAME_BYTES, b"\0")),
        0,
        float(camera.K[0, 0]) * mm_per_px,
        width_px * mm_per_px,
        height_px * mm_per_px,
        width_px,
        height_px,
        0,
        CAMERA_ABILITIES,
        0,
        b"",
        gimbal_id or 0,
    )


def interval_request(system_id: int, message_id: int, rate_hz: float) -> Any:
    """COMMAND_LONG (76) that requests a message at a rate from a system's autopilot."""
    # PX4 rejects the command unless its unused parameters are zero.
    return dialect.MAVLink_command_long_message(
        system_id, AUTOPILOT_COMPONENT, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
        message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0,
    )  # fmt: skip


def statustexts(severity: int, text: str, text_id: int) -> list[Any]:
    """STATUSTEXT (253), in chunks of 50 bytes if necessary; `text_id` 1..65535 links them."""
    chunks = _cut(text.encode())
    shared = text_id if len(chunks) > 1 else 0
    if shared and len(chunks[-1]) == STATUSTEXT_BYTES:
        chunks.append(b"")  # a null marks the last chunk: without one, receivers keep waiting for the rest
    return [dialect.MAVLink_statustext_message(severity, chunk, shared, i) for i, chunk in enumerate(chunks)]


def _cut(data: bytes) -> list[bytes]:
    """UTF-8 in pieces of a STATUSTEXT's size, at least one. No piece ends inside a character, as receivers decode each
    separately; it is filled with spaces instead, as a null would end the text.
    """
    pieces = []
    while len(data) > STATUSTEXT_BYTES:
        end = STATUSTEXT_BYTES
        while data[end] & 0xC0 == 0x80:  # in the middle of a character
            end -= 1
        pieces.append(data[:end].ljust(STATUSTEXT_BYTES))
        data = data[end:]
    return [*pieces, data]


def _heading_rad(R_ned_target: Array, P: Array) -> tuple[float, float]:
    """Heading 0..2 pi and its standard deviation, from the rotation's covariance P [3, 3] in ned. The steeper the nose
    points, the more a small tilt turns the heading: NaN if its standard deviation exceeds UNSURE_ROTATION_RAD."""
    north, east, down = R_ned_target[:, 0].tolist()
    heading_rad = math.atan2(east, north)
    slope = down / max(math.hypot(north, east), 1e-9)
    per_turn = np.array([-slope * math.cos(heading_rad), -slope * math.sin(heading_rad), 1.0])
    std_rad = math.sqrt(max(float(per_turn @ P @ per_turn), 0.0))
    if std_rad > UNSURE_ROTATION_RAD:
        return NAN, NAN
    return heading_rad % (2.0 * math.pi), std_rad


def largest_std(P: Array) -> float:
    """Standard deviation along the worst axis of a covariance [n, n]."""
    return math.sqrt(max(float(np.linalg.eigvalsh(P)[-1]), 0.0))
