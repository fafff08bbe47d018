"""Watches whether the aircraft seen are of the size that [target] says, as the network knows some of them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median

from edge.health import Reason
from edge.types import PROBABLE_SCORE, Estimate

RECENT_NS = 3_000_000_000
SIGHTS_LEAST = 5  # in that time, for a judgement


class SizeWatch:
    """Fed by the loop with the estimates of each frame."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque()  # capture_ns, times as large as given; 1: no contradiction

    def seen(self, capture_ns: int, estimates: Sequence[Estimate]) -> None:
        for estimate in estimates:
            if estimate.score >= PROBABLE_SCORE:
                self._recent.append((capture_ns, 1.0 if estimate.oversize is None else estimate.oversize))

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """One if more than half of what was seen lately contradicts the given size."""
        while self._recent and self._recent[0][0] < now_ns - RECENT_NS:
            self._recent.popleft()
        against = [oversize for _, oversize in self._recent if oversize != 1.0]
        if len(self._recent) < SIGHTS_LEAST or 2 * len(against) <= len(self._recent):
            return ()
        times = math.exp(median(math.log(oversize) for oversize in against))
        return (Reason("target_size", f"the target appears to be {times:.2g} times as large as [target] says"),)
