"""Reports as the loop hands them to the links."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from edge.health import Activity, Condition, HealthState
from edge.types import FrameMeta, OwnShip, Report, Track, TrackState

K = np.array([[2000.0, 0.0, 959.5], [0.0, 2000.0, 539.5], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
R_NED_BODY = Rotation.from_euler("ZYX", [0.4, 0.1, -0.2]).as_matrix()
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
R_NED_CAM = R_NED_BODY @ R_BODY_CAM
R_CAM_TARGET = Rotation.from_rotvec([0.3, -1.1, 0.8]).as_matrix()
T_CAM_TARGET_M = np.array([12.0, -5.0, 240.0])
OWN_NED_M = np.array([100.0, 50.0, -120.0])
ORIGIN = (47.0, 8.0, 400.0)
V_NED_MPS = np.array([22.0, -4.0, 1.5])
BOX_XYXY_PX = np.array([1040.0, 480.0, 1080.0, 500.0])
TRACKING = Condition(HealthState.TRACKING, Activity.TRACKING)
SEARCHING = Condition(HealthState.SEARCHING, Activity.SEARCHING)
FAULT = Condition(HealthState.FAULT, Activity.WAITING)


ROTATION_UNKNOWN = np.diag([0.09, 0.16, 144.0, 1.1, 1.2, 1.3])  # radians that amount to any attitude


def rangeless(track: Track) -> Track:
    """The same track, its range as good as unknown."""
    along = track.t_cam_target_m / np.linalg.norm(track.t_cam_target_m)
    covariance = track.covariance.copy()
    covariance[:3, :3] = np.eye(3) + 300.0**2 * np.outer(along, along)
    return replace(track, covariance=covariance)


def make_track(now_ns: int, **changed: Any) -> Track:
    """A confirmed, fresh track in both frames; `changed` replaces fields."""
    covariance = np.diag([0.09, 0.16, 144.0, 0.01, 0.02, 0.03])
    track = Track(
        track_id=0,
        state=TrackState.CONFIRMED,
        time_ns=now_ns,
        measured_ns=now_ns,
        born_ns=now_ns,
        score=0.87,
        box_xyxy_px=BOX_XYXY_PX,
        R_cam_target=R_CAM_TARGET,
        t_cam_target_m=T_CAM_TARGET_M,
        covariance=covariance,
        R_ned_target=R_NED_CAM @ R_CAM_TARGET,
        t_ned_target_m=OWN_NED_M + R_NED_CAM @ T_CAM_TARGET_M,
        v_ned_target_mps=V_NED_MPS,
        covariance_ned=np.diag([4.0, 9.0, 16.0, 1.0, 4.0, 2.0, 0.01, 0.02, 0.09]),
    )
    return replace(track, **changed)


def make_report(*tracks: Track, sequence: int = 1, now_ns: int | None = None, own_ship: bool = True) -> Report:
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    own = OwnShip(now_ns, R_NED_BODY, OWN_NED_M, np.array([20.0, 0.0, 0.0]), ORIGIN) if own_ship else None
    return Report(FrameMeta(sequence, now_ns, now_ns), K, SIZE_WH, tracks, own)
