"""How many evaluations per target, and of how many regions, the camera's frame interval allows."""

from __future__ import annotations

from collections import deque

from edge.types import FrameMeta, TrackState

UNHURRIED_NS = 60_000_000  # frame interval from which on there is time to evaluate each target more than once
REGION_NS = 60_000_000  # frame interval per region of the frame that is searched in it


class Pace:
    """Of one camera; remembers the previous frames."""

    def __init__(self) -> None:
        self._before: FrameMeta | None = None
        self._intervals_ns: deque[float] = deque(maxlen=2)

    def unhurried(self, meta: FrameMeta) -> bool:
        """Whether there is time to evaluate each target more than once. To be called for every frame, in order."""
        before, self._before = self._before, meta
        if before is None:
            return False
        self._intervals_ns.append(_interval_ns(before, meta))
        return self._intervals_ns[-1] >= UNHURRIED_NS

    def regions(self) -> int:
        """How many regions of the last frame there is time to search. A single long interval is a gap, as of a camera
        that was lost: after it, frames come as before."""
        return max(1, int(min(self._intervals_ns, default=0.0) // REGION_NS))


def looked_at_twice(state: TrackState, unhurried: bool) -> bool:
    """Whether a track is evaluated plain and mirrored in each frame instead of alternately: a track with few detections
    cannot wait for the next frame to correct it."""
    return unhurried or state is TrackState.TENTATIVE


def _interval_ns(before: FrameMeta, after: FrameMeta) -> float:
    """Mean interval between consecutive frames of the source, including those that were dropped in between."""
    return (after.capture_ns - before.capture_ns) / max(after.sequence - before.sequence, 1)
