"""Rate limit for output that others can trigger without end. Pure: every time is an argument."""

from __future__ import annotations


class Allowance:
    """A token bucket: a number at once, and one more each period."""

    def __init__(self, at_once: int, period_ns: int) -> None:
        self._at_once = at_once
        self._period_ns = period_ns
        self._left = at_once
        self._counted_ns = 0

    def take(self, now_ns: int) -> bool:
        """Whether one more is allowed at `now_ns`; it is then counted."""
        more = (now_ns - self._counted_ns) // self._period_ns
        self._counted_ns += more * self._period_ns
        self._left = min(self._left + more, self._at_once)
        if self._left == 0:
            return False
        self._left -= 1
        return True
