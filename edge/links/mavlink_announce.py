"""Which targets came and went between reports, as words for an operator. Pure."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from edge.types import Track, TrackState

INFO, NOTICE = 6, 5  # MAV_SEVERITY


class TargetAnnouncer:
    """A target is acquired with its first confirmed measurement and lost when its track is no more."""

    def __init__(self) -> None:
        self._known: set[int] = set()

    def words(self, tracks: Iterable[Track]) -> list[tuple[int, str]]:
        """(MAV_SEVERITY, text) of what changed since the call before."""
        sure = {track.track_id: track for track in tracks if track.state is not TrackState.TENTATIVE}
        lost = [(NOTICE, f"target {number} lost") for number in sorted(self._known - sure.keys())]
        acquired = [
            (INFO, f"target {number} acquired at {np.linalg.norm(sure[number].t_cam_target_m):.0f} m")
            for number in sorted(sure.keys() - self._known)
        ]
        self._known = set(sure)
        return lost + acquired
