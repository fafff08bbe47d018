"""How much time a camera's frames leave for each target."""

from __future__ import annotations

from edge.types import FrameMeta, TrackState

UNHURRIED_NS = 60_000_000  # from one of the camera's frames to the next: time for more than one look at each target


class Pace:
    """Of one camera; remembers the frame before."""

    def __init__(self) -> None:
        self._before: FrameMeta | None = None

    def unhurried(self, meta: FrameMeta) -> bool:
        """Whether there is time for more than one look at each target; asked of every frame, in their order."""
        before, self._before = self._before, meta
        return before is not None and _interval_ns(before, meta) >= UNHURRIED_NS


def looked_at_twice(state: TrackState, unhurried: bool) -> bool:
    """Whether a track is looked at plain and mirrored in one frame, and not by turns: one that few frames have shown
    cannot wait for the next to put it right."""
    return unhurried or state is TrackState.TENTATIVE


def _interval_ns(before: FrameMeta, after: FrameMeta) -> float:
    """Between two frames of the source, those that were not looked at counted."""
    return (after.capture_ns - before.capture_ns) / max(after.sequence - before.sequence, 1)
