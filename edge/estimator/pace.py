"""How many evaluations per target, and of how many regions, the camera's frame interval allows."""

from __future__ import annotations

from edge.types import FrameMeta, TrackState

UNHURRIED_NS = 60_000_000  # frame interval from which on there is time to evaluate each target more than once
REGION_NS = 60_000_000  # frame interval per region of the frame that is searched in it


class Pace:
    """Of one camera; remembers the previous frame."""

    def __init__(self) -> None:
        self._before: FrameMeta | None = None
        self._interval_ns = 0.0

    def unhurried(self, meta: FrameMeta) -> bool:
        """Whether there is time to evaluate each target more than once. To be called for every frame, in order."""
        before, self._before = self._before, meta
        self._interval_ns = 0.0 if before is None else _interval_ns(before, meta)
        return self._interval_ns >= UNHURRIED_NS

    def regions(self) -> int:
        """How many regions of the last frame there is time to search."""
        return max(1, int(self._interval_ns // REGION_NS))


def looked_at_twice(state: TrackState, unhurried: bool) -> bool:
    """Whether a track is evaluated plain and mirrored in each frame instead of alternately: a track with few detections
    cannot wait for the next frame to correct it."""
    return unhurried or state is TrackState.TENTATIVE


def _interval_ns(before: FrameMeta, after: FrameMeta) -> float:
    """Mean interval between consecutive frames of the source, including those that were dropped in between."""
    return (after.capture_ns - before.capture_ns) / max(after.sequence - before.sequence, 1)
