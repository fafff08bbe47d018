"""Telemetry that stands still while it says that it moves: its sender repeats the last value with new timestamps. Pure.

A live estimate differs from the one before in its last digits at least. One that does not, although its own rate moves
it, is stale whatever its timestamp.
"""

from __future__ import annotations

import numpy as np

from edge.types import Array

REPEATED_MIN_NS = 200_000_000  # what is estimated less often than it is sent is repeated too, but not for as long
WINDOW_NS = 1_000_000_000  # over longer times, the rates' errors of a vehicle at rest would add up
GAP_MAX_NS = 500_000_000
TOLD_AGAIN_NS = 60_000_000_000
NS_PER_S = 1e9


class Standstill:
    """Compares each sample with the previous one; times are monotonic ns of the measurement."""

    def __init__(self, same: float, least: float, sentence: str) -> None:
        """Values that differ by less than `same` in each element are one repeated; `least`: how far the rate must say
        that it has moved meanwhile; `sentence`: what a person is told."""
        self.times = 0  # how often it came to a standstill
        self._same, self._least, self._sentence = same, least, sentence
        self._last: tuple[int, Array, Array] | None = None  # time, the value repeated since, rate
        self._since_ns = 0
        self._missed = np.zeros(3)  # integral of the rate since then
        self._found = self._untold = False
        self._told_ns: int | None = None

    def stands(self, time_ns: int, value: Array, rate: Array) -> bool:
        """Whether this value has not moved although its rate [3], per second, says so; until it moves again."""
        last = self._last
        if last is None or np.any(np.abs(value - last[1]) >= self._same):
            self._last, self._found = (time_ns, value, rate), False
            self._begin(time_ns)
        elif time_ns > last[0]:
            self._last = (time_ns, last[1], rate)
            if time_ns - last[0] > GAP_MAX_NS or time_ns - self._since_ns > WINDOW_NS:
                self._begin(time_ns)
            self._missed = self._missed + 0.5 * (last[2] + rate) * ((time_ns - max(last[0], self._since_ns)) / NS_PER_S)
            moved = float(np.linalg.norm(self._missed)) > self._least
            if not self._found and moved and time_ns - self._since_ns >= REPEATED_MIN_NS:
                self.times += 1
                self._found = self._untold = True
        return self._found

    def news(self, now_ns: int) -> list[str]:
        """The sentence each time that it came to a standstill, at most once a minute (`now_ns` is monotonic)."""
        if not self._untold or (self._told_ns is not None and now_ns - self._told_ns < TOLD_AGAIN_NS):
            return []
        self._untold, self._told_ns = False, now_ns
        return [self._sentence]

    def _begin(self, time_ns: int) -> None:
        self._since_ns, self._missed = time_ns, np.zeros(3)
