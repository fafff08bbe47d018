"""Watches whether the aircraft seen are of the size that [target] says, as the network knows some of them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median

from edge.health import Reason
from edge.types import Estimate

RECENT_NS = 3_000_000_000
SIGHTS_LEAST = 5  # in that time, for a judgement; a camera that takes longer for so many frames is given that long
FRAME_GAP_MAX_NS = 2_000_000_000  # of frames further apart, no target is tracked
# Shares of them that contradict the size: what is told of from the one on is told of down to the other, so that a share
# in between does not come and go.
TOLD_ABOVE, OVER_BELOW = 0.5, 0.25


class SizeWatch:
    """Fed by the loop with the estimates of each frame."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque()  # capture_ns, times as large as given; 1: no contradiction
        self._told = False
        self._frame_ns: int | None = None
        self._interval_ns = 0  # between the last two frames

    def seen(self, capture_ns: int, estimates: Sequence[Estimate], doubtful_below: float) -> None:
        """Add a frame; estimates of a lower score than `doubtful_below` do not count."""
        if self._frame_ns is not None:
            self._interval_ns = min(capture_ns - self._frame_ns, FRAME_GAP_MAX_NS)
        self._frame_ns = capture_ns
        for estimate in estimates:
            if estimate.score >= doubtful_below:
                self._recent.append((capture_ns, 1.0 if estimate.oversize is None else estimate.oversize))

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """One if most of what was seen lately contradicts the given size, until little of it does."""
        recent_ns = max(RECENT_NS, (SIGHTS_LEAST + 1) * self._interval_ns)
        while self._recent and self._recent[0][0] < now_ns - recent_ns:
            self._recent.popleft()
        against = [oversize for _, oversize in self._recent if oversize != 1.0]
        most = (OVER_BELOW if self._told else TOLD_ABOVE) * len(self._recent)
        self._told = len(self._recent) >= SIGHTS_LEAST and len(against) > most
        if not self._told:
            return ()
        times = math.exp(median(math.log(oversize) for oversize in against))
        return (Reason("target_size", f"the target appears to be {times:.2g} times as large as [target] says"),)
