"""Targets acquired and lost from frame to frame, as messages for the operator. Pure."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from edge.links.outgoing import probable, range_known
from edge.types import Report, TrackState

NS_PER_S = 1e9


@dataclass(frozen=True)
class _Held:
    since_ns: int  # confirmed, monotonic
    measured_ns: int
    range_m: float | None  # then; None: too uncertain to be sent


class TargetNews:
    """A target is acquired when its track is confirmed and probably an aircraft, and lost when that track is gone."""

    def __init__(self) -> None:
        self._held: dict[int, _Held] = {}

    def words(self, report: Report) -> list[tuple[int, str]]:
        """(logging level, text) of changes since the previous frame. Call it for every frame, as track numbers are
        reused."""
        sure = {
            track.track_id: track
            for track in report.tracks
            if track.state is not TrackState.TENTATIVE and (track.track_id in self._held or probable(track, report))
        }
        told = [(logging.WARNING, _lost(number, self._held[number])) for number in sorted(self._held.keys() - sure)]
        acquired = sorted(sure.keys() - self._held.keys())
        now = {}
        for number, track in sure.items():
            before = self._held.get(number)
            if before is not None and before.measured_ns == track.measured_ns:
                now[number] = before
                continue
            since_ns = track.time_ns if before is None else before.since_ns
            range_m = float(np.linalg.norm(track.t_cam_target_m)) if range_known(track) else None
            now[number] = _Held(since_ns, track.measured_ns, range_m)
        self._held = now
        return told + [(logging.INFO, _acquired(number, now[number])) for number in acquired]


def _acquired(number: int, held: _Held) -> str:
    return f"target {number} acquired" + (", range unknown" if held.range_m is None else f" at {held.range_m:.0f} m")


def _lost(number: int, held: _Held) -> str:
    held_s = (held.measured_ns - held.since_ns) / NS_PER_S
    last = "range unknown" if held.range_m is None else f"last seen at {held.range_m:.0f} m"
    return f"target {number} lost: held for {held_s:.1f} s, {last}"
