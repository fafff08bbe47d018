"""What a link may say of a report: only tracks that are sure, fresh and whole."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from edge import clock
from edge.types import Report, Track, TrackState
from msgs.wire import is_covariance

UNSURE_RANGE_SHARE = 0.5  # range known worse than this is not told as a pose
ROTATION_TOLERANCE = 1e-3
UTC_PERIOD_NS = 1_000_000_000
NS_PER_MS = 1e6


def sendable(report: Report, now_ns: int, max_age_ms: float) -> list[Track]:
    """Tracks fit to be sent at `now_ns` (monotonic): confirmed or coasting, measured lately, finite and consistent."""
    oldest_ns = now_ns - round(max_age_ms * NS_PER_MS)
    return [
        track
        for track in report.tracks
        if track.state is not TrackState.TENTATIVE and track.measured_ns >= oldest_ns and _whole(track)
    ]


def _whole(track: Track) -> bool:
    in_cam = [track.box_xyxy_px, track.R_cam_target, track.t_cam_target_m, track.covariance]
    in_ned = [track.R_ned_target, track.t_ned_target_m, track.v_ned_target_mps, track.covariance_ned]
    values = in_cam + [value for value in in_ned if value is not None]
    if not np.isfinite(np.concatenate([np.ravel(value) for value in values])).all():
        return False
    range_m = float(np.linalg.norm(track.t_cam_target_m))
    if track.t_cam_target_m[2] <= 0.0 or not is_covariance(track.covariance):
        return False
    along = track.t_cam_target_m / range_m
    range_std_m = math.sqrt(max(float(along @ track.covariance[:3, :3] @ along), 0.0))
    skewness = np.abs(track.R_cam_target @ track.R_cam_target.T - np.eye(3)).max()
    return bool(skewness <= ROTATION_TOLERANCE and range_std_m <= UNSURE_RANGE_SHARE * range_m)


@dataclass
class UtcClock:
    """UTC of a monotonic time, by an offset measured anew each second. Use from one thread."""

    uncertainty_ns: int = 0  # of the last measurement: half the time between the two readings around it
    _offset_ns: int = 0
    _measured_ns: int | None = field(default=None)

    def utc_ns(self, monotonic_ns: int) -> int:
        now_ns = clock.monotonic_ns()
        if self._measured_ns is None or now_ns - self._measured_ns > UTC_PERIOD_NS:
            self._measure()
            self._measured_ns = now_ns
        return monotonic_ns + self._offset_ns

    def _measure(self) -> None:
        readings = []
        for _ in range(5):
            before_ns, utc_ns, after_ns = clock.monotonic_ns(), clock.utc_ns(), clock.monotonic_ns()
            readings.append((after_ns - before_ns, utc_ns - (before_ns + after_ns) // 2))
        spread_ns, self._offset_ns = min(readings)
        self.uncertainty_ns = spread_ns // 2
