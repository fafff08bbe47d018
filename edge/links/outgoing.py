"""What of a report's tracks a link may send: only certain, recent and valid poses; of a target whose range is not
certain, its direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.types import Report, Track, TrackState
from msgs.wire import is_covariance

UNSURE_RANGE_SHARE = 0.5  # 1-sigma over range above which a pose is not sent
UNSURE_DIRECTION_RAD = float(np.deg2rad(1.0))  # 1-sigma of the worse axis above which a direction is not sent
UNSURE_ROTATION_RAD = 1.0  # root mean square over the axes; 1.33 for a completely unknown rotation
ROTATION_TOLERANCE = 1e-3
NS_PER_MS = 1e6


def sendable(report: Report, now_ns: int, max_age_ms: float) -> list[Track]:
    """Tracks whose pose is fit to be sent at `now_ns` (monotonic): confirmed or coasting, most probably a target or
    selected by the operator, recently measured, finite and consistent, at a known range. A track whose ned covariance
    is not valid is returned without its ned fields, for the camera frame only."""
    return [_of_what_is_known(track) for track in _valid(report, now_ns, max_age_ms) if range_known(track)]


def rangeless(report: Report, now_ns: int, max_age_ms: float) -> list[Track]:
    """Tracks of which only the direction is fit to be sent: as `sendable` ones, but at an unknown range."""
    return [track for track in _valid(report, now_ns, max_age_ms) if not range_known(track) and direction_known(track)]


def probable(track: Track, report: Report) -> bool:
    """Whether the track is most probably an aircraft, or what the operator selected."""
    return track.score >= report.doubtful_below or track.track_id == report.chosen_id


def rotation_known(track: Track) -> bool:
    """Whether the rotation is certain enough to be sent; otherwise no link may send an attitude."""
    return float(np.trace(track.covariance[3:, 3:])) <= 3.0 * UNSURE_ROTATION_RAD**2


def range_known(track: Track) -> bool:
    """Whether the range is certain enough for a pose to be sent."""
    range_m = float(np.linalg.norm(track.t_cam_target_m))
    along = track.t_cam_target_m / range_m
    variance_m2 = float(along @ track.covariance[:3, :3] @ along)
    return variance_m2 <= (UNSURE_RANGE_SHARE * range_m) ** 2


def direction_known(track: Track) -> bool:
    """Whether the direction is certain enough to be sent, in messages that cannot say how certain it is."""
    range_m = float(np.linalg.norm(track.t_cam_target_m))
    along = track.t_cam_target_m / range_m
    across = np.eye(3) - np.outer(along, along)
    variance_m2 = float(np.linalg.eigvalsh(across @ track.covariance[:3, :3] @ across)[-1])
    return variance_m2 <= (UNSURE_DIRECTION_RAD * range_m) ** 2


def _valid(report: Report, now_ns: int, max_age_ms: float) -> list[Track]:
    oldest_ns = now_ns - round(max_age_ms * NS_PER_MS)
    return [
        track
        for track in report.tracks
        if track.state is not TrackState.TENTATIVE
        and probable(track, report)
        and track.measured_ns >= oldest_ns
        and _whole(track)
    ]


def _of_what_is_known(track: Track) -> Track:
    if track.covariance_ned is None or is_covariance(track.covariance_ned):
        return track
    return replace(track, R_ned_target=None, t_ned_target_m=None, v_ned_target_mps=None, covariance_ned=None)


def _whole(track: Track) -> bool:
    in_cam = [track.box_xyxy_px, track.R_cam_target, track.t_cam_target_m, track.covariance]
    in_ned = [track.R_ned_target, track.t_ned_target_m, track.v_ned_target_mps, track.covariance_ned]
    values = in_cam + [value for value in in_ned if value is not None]
    if not np.isfinite(np.concatenate([np.ravel(value) for value in values])).all():
        return False
    if track.t_cam_target_m[2] <= 0.0 or not is_covariance(track.covariance):
        return False
    skewness = np.abs(track.R_cam_target @ track.R_cam_target.T - np.eye(3)).max()
    return bool(skewness <= ROTATION_TOLERANCE)
