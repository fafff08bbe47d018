"""Compares our UTC with the autopilot's, which usually comes from GPS (SYSTEM_TIME, 2). Pure.

The difference is only reported, not corrected: recordings and logs use this computer's clock too. But a computer with
neither a battery-backed clock nor a network runs on the time of its last shutdown, and receivers reject its poses as
too old.
"""

from __future__ import annotations

SET_FROM_US = 1_577_836_800_000_000  # 2020: an earlier time means that the autopilot does not know it
SET_UNTIL_US = 4_102_444_800_000_000  # 2100
APART_NS = 1_000_000_000
TOGETHER_NS = 500_000_000
AGREEING = 3  # timestamps in a row that must agree
TOLD_AGAIN_NS = 60_000_000_000


class Daytime:
    """Every time is an argument."""

    def __init__(self) -> None:
        self.ahead_ns: int | None = None  # our UTC minus the autopilot's; None: it has not sent any
        self._apart = False
        self._in_a_row = 0
        self._untold = False
        self._told_ns: int | None = None

    def compare(self, time_unix_us: int, our_utc_ns: int) -> None:
        """`time_unix_us` of a SYSTEM_TIME, and our UTC at the time of its timestamp."""
        if not SET_FROM_US <= time_unix_us <= SET_UNTIL_US:
            return
        self.ahead_ns = our_utc_ns - time_unix_us * 1000
        changes = abs(self.ahead_ns) < TOGETHER_NS if self._apart else abs(self.ahead_ns) > APART_NS
        self._in_a_row = self._in_a_row + 1 if changes else 0
        if self._in_a_row == AGREEING:
            self._apart = self._untold = not self._apart
            self._in_a_row = 0

    def news(self, now_ns: int) -> list[str]:
        """A sentence each time that the two are found to differ, at most one a minute (`now_ns` is monotonic)."""
        just_told = self._told_ns is not None and now_ns - self._told_ns < TOLD_AGAIN_NS
        if not self._untold or just_told or self.ahead_ns is None:
            return []
        self._untold, self._told_ns = False, now_ns
        apart = f"{abs(self.ahead_ns) * 1e-9:.1f} s {'ahead of' if self.ahead_ns > 0 else 'behind'}"
        return [f"UTC here is {apart} the autopilot's: receivers that judge poses by their stamps will refuse them"]
