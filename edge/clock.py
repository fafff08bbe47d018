"""What time it is for the daemon: the host's clocks, or in lock-step a sequence's, which stands still between steps.

Whatever decides or stamps by time asks here, so that a replay can own time. What guards against a process that hangs
(the watchdog, a wait for a thread's end) keeps to the host's clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

UTC_PERIOD_NS = 1_000_000_000

_stepped_ns: int | None = None


def monotonic_ns() -> int:
    """Monotonic nanoseconds, of the host or of the step."""
    return time.monotonic_ns() if _stepped_ns is None else _stepped_ns


def utc_ns() -> int:
    """Nanoseconds since 1970 UTC; in lock-step the same as `monotonic_ns`: nothing tells the day of a replay."""
    return time.time_ns() if _stepped_ns is None else _stepped_ns


def stepped() -> bool:
    """Whether time stands still but for `step_to`."""
    return _stepped_ns is not None


def step_to(time_ns: int) -> None:
    """Let it be `time_ns`, from now on until the next step. Raises ValueError for a step back."""
    global _stepped_ns
    if _stepped_ns is not None and time_ns < _stepped_ns:
        raise ValueError(f"{time_ns} is before {_stepped_ns}")
    _stepped_ns = time_ns


def run_freely() -> None:
    """Keep to the host's clocks again."""
    global _stepped_ns
    _stepped_ns = None


@dataclass
class UtcClock:
    """UTC of a monotonic time and back, by an offset measured anew each second. Use from one thread."""

    uncertainty_ns: int = 0  # of the last measurement: half the time between the two readings around it
    _offset_ns: int = 0
    _measured_ns: int | None = field(default=None)

    def utc_ns(self, at_monotonic_ns: int) -> int:
        return at_monotonic_ns + self._offset()

    def monotonic_ns(self, at_utc_ns: int) -> int:
        return at_utc_ns - self._offset()

    def _offset(self) -> int:
        now_ns = monotonic_ns()
        if self._measured_ns is None or now_ns - self._measured_ns > UTC_PERIOD_NS:
            self._measure()
            self._measured_ns = now_ns
        return self._offset_ns

    def _measure(self) -> None:
        """Bracketed, and the tightest of a few: whoever is held up between two readings tells nothing false."""
        readings = []
        for _ in range(5):
            before_ns, now_utc_ns, after_ns = monotonic_ns(), utc_ns(), monotonic_ns()
            readings.append((after_ns - before_ns, now_utc_ns - (before_ns + after_ns) // 2))
        spread_ns, self._offset_ns = min(readings)
        self.uncertainty_ns = spread_ns // 2
