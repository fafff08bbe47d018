"""Tracks, own ship, camera and health as ROS 2 messages. Pure; timestamps are UTC ns."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from edge.health import HealthSnapshot, HealthState
from edge.links.outgoing import rotation_known
from edge.types import Array, Mount, OwnShip, Report, Track
from msgs import cdr, topics
from msgs.geometry import NOT_ESTIMATED, q_wxyz_from_R

CLASS_FIXED_WING = "fixed_wing"
DIAGNOSTIC_LEVEL = {HealthState.DEGRADED: 1, HealthState.FAULT: 2}


def q_xyzw(R: ArrayLike) -> Array:
    """[3, 3] to a quaternion [4] in ROS order (x, y, z, w)."""
    return np.roll(q_wxyz_from_R(R), -1)


def target_name(track: Track) -> str:
    """`tN`, as in the topic name."""
    return f"t{track.track_id}"


def pose(track: Track, stamp_ns: int) -> cdr.PoseWithCovarianceStamped:
    """The target in `cam`; an unknown rotation is sent as identity with a variance that says so."""
    R, covariance = track.R_cam_target, track.covariance
    if not rotation_known(track):
        R, covariance = np.eye(3), _without_rotation(covariance)
    return cdr.PoseWithCovarianceStamped(stamp_ns, topics.FRAME_CAMERA, track.t_cam_target_m, q_xyzw(R), covariance)


def direction(track: Track, stamp_ns: int) -> cdr.Vector3Stamped:
    """Where the target's origin is seen in `cam`, as a unit vector: what is sent while its range is not known."""
    ray = track.t_cam_target_m / np.linalg.norm(track.t_cam_target_m)
    return cdr.Vector3Stamped(stamp_ns, topics.FRAME_CAMERA, ray)


def odometry(track: Track, own_ship: OwnShip, stamp_ns: int) -> cdr.Odometry | None:
    """The target in `ned`; without own position in base_link_ned, with relative velocity. None: no own attitude."""
    R, t_m, v_mps, P = track.R_ned_target, track.t_ned_target_m, track.v_ned_target_mps, track.covariance_ned
    if R is None or t_m is None or v_mps is None or P is None:
        return None
    pose_index = np.r_[0:3, 6:9]
    covariance = P[np.ix_(pose_index, pose_index)]
    if not rotation_known(track):
        R, covariance = np.eye(3), _without_rotation(covariance)
    twist = np.diag([NOT_ESTIMATED] * 6)
    twist[:3, :3] = R.T @ P[3:6, 3:6] @ R
    return cdr.Odometry(
        stamp_ns=stamp_ns,
        frame_id=topics.FRAME_NED if own_ship.t_ned_body_m is not None else topics.FRAME_BODY_NED,
        child_frame_id=topics.FRAME_TARGET,
        t_ned_target_m=t_m,
        q_ned_target_xyzw=q_xyzw(R),
        covariance=covariance,
        v_target_mps=R.T @ v_mps,
        omega_target_radps=np.zeros(3),
        covariance_twist=0.5 * (twist + twist.T),
    )


def detections(tracks: list[Track], stamp_ns: int) -> cdr.Detection3DArray:
    """All targets of one frame in `cam`; an empty array means that there is none."""
    found = []
    for track in tracks:
        told = pose(track, stamp_ns)
        t_m, q = told.t_cam_target_m, told.q_cam_target_xyzw
        one = cdr.Hypothesis(CLASS_FIXED_WING, track.score, t_m, q, told.covariance)
        found.append(cdr.Detection3D(stamp_ns, topics.FRAME_CAMERA, (one,), t_m, q, np.zeros(3), target_name(track)))
    return cdr.Detection3DArray(stamp_ns, topics.FRAME_CAMERA, tuple(found))


def _without_rotation(covariance: Array) -> Array:
    """[6, 6] with only the position's part kept."""
    told = np.zeros((6, 6))
    told[:3, :3] = covariance[:3, :3]
    told[3:, 3:] = NOT_ESTIMATED * np.eye(3)
    return told


def transforms(own_ship: OwnShip, mount: Mount, stamp_ns: int) -> cdr.TFMessage:
    """The own ship's transforms: camera on the body, body in base_link_ned, and that in `ned` if position is known."""
    q, q_camera = q_xyzw(own_ship.R_ned_body), q_xyzw(own_ship.camera(mount).R_body_cam)
    chain = [
        cdr.TransformStamped(stamp_ns, topics.FRAME_BODY_NED, topics.FRAME_BODY, np.zeros(3), q),
        cdr.TransformStamped(stamp_ns, topics.FRAME_BODY, topics.FRAME_CAMERA, mount.t_body_cam_m, q_camera),
    ]
    if own_ship.t_ned_body_m is not None:
        upright = np.array([0.0, 0.0, 0.0, 1.0])
        place = cdr.TransformStamped(stamp_ns, topics.FRAME_NED, topics.FRAME_BODY_NED, own_ship.t_ned_body_m, upright)
        chain.insert(0, place)
    return cdr.TFMessage(tuple(chain))


def camera_info(report: Report, stamp_ns: int) -> cdr.CameraInfo:
    """Intrinsics and lens distortion of the frame that the poses belong to (sensor_msgs/CameraInfo)."""
    width_px, height_px = report.image_size_wh
    P = np.hstack([report.K, np.zeros((3, 1))])
    model = "rational_polynomial" if len(report.distortion) > 5 else "plumb_bob"
    D = np.zeros(8 if len(report.distortion) > 5 else 5)
    D[: len(report.distortion)] = report.distortion
    return cdr.CameraInfo(stamp_ns, topics.FRAME_CAMERA, height_px, width_px, model, D, report.K, np.eye(3), P)


def diagnostics(snapshot: HealthSnapshot, vehicle_name: str, stamp_ns: int) -> cdr.DiagnosticArray:
    """Health as one DiagnosticStatus: state and reasons, counters and latencies."""
    condition = snapshot.condition
    values = {
        "state": condition.state.value,
        "activity": condition.activity.value,
        "tracks": str(snapshot.tracks),
        "frame_rate_hz": f"{snapshot.frame_rate_hz:.1f}",
        **snapshot.facts,
        **{name: str(count) for name, count in snapshot.counters.items()},
        **{
            f"latency_ms/{stage}/{name}": f"{value:.2f}"
            for stage, p in snapshot.latency_ms.items()
            for name, value in (("p50", p.p50), ("p95", p.p95), ("p99", p.p99))
        },
    }
    message = "; ".join((condition.headline, *condition.texts))
    level = DIAGNOSTIC_LEVEL.get(condition.state, 0)
    status = cdr.DiagnosticStatus(level, topics.NODE_NAME, message, vehicle_name, tuple(values.items()))
    return cdr.DiagnosticArray(stamp_ns, "", (status,))
