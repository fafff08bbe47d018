"""What time it is for the daemon: the host's clocks, or in lock-step a sequence's, which stands still between steps.

Whatever decides or stamps by time asks here, so that a replay can own time. What guards against a process that hangs
(the watchdog, a wait for a thread's end) keeps to the host's clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

UTC_PERIOD_NS = 1_000_000_000
UTC_SET_NS = 1_000_000  # by less nobody sets it, and the next measurement finds it
SLEPT_NS = 10_000_000  # no machine goes to sleep and wakes in less

_stepped_ns: int | None = None


def monotonic_ns() -> int:
    """Monotonic nanoseconds, of the host or of the step."""
    return time.monotonic_ns() if _stepped_ns is None else _stepped_ns


def utc_ns() -> int:
    """Nanoseconds since 1970 UTC; in lock-step the same as `monotonic_ns`: nothing tells the day of a replay."""
    return time.time_ns() if _stepped_ns is None else _stepped_ns


def asleep_ns() -> int:
    """How long the machine has slept since its start; 0 in lock-step. The monotonic clock stands still meanwhile."""
    # In this order whoever is held up between the two finds less, not more.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns() if _stepped_ns is None else 0


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
    """UTC of a monotonic time and back, by an offset measured anew each second, and as soon as UTC has been set or the
    machine has slept. Use from one thread."""

    uncertainty_ns: int = 0  # of the last measurement: half the time between the two readings around it
    _offset_ns: int = 0
    _measured_ns: int | None = field(default=None)

    def utc_ns(self, at_monotonic_ns: int) -> int:
        return at_monotonic_ns + self._offset()

    def monotonic_ns(self, at_utc_ns: int) -> int:
        return at_utc_ns - self._offset()

    def _offset(self) -> int:
        now_ns = monotonic_ns()
        if self._measured_ns is None or now_ns - self._measured_ns > UTC_PERIOD_NS or self._was_set(now_ns):
            self._measure()
            self._measured_ns = now_ns
        return self._offset_ns

    def _was_set(self, before_ns: int) -> bool:
        """Whether no reading of UTC since `before_ns`, however long it was held up, can be of the offset of before."""
        now_utc_ns, after_ns = utc_ns(), monotonic_ns()
        ahead_ns = now_utc_ns - self._offset_ns
        return not before_ns - UTC_SET_NS <= ahead_ns <= after_ns + UTC_SET_NS

    def _measure(self) -> None:
        """Bracketed, and the tightest of a few: whoever is held up between two readings tells nothing false."""
        readings = []
        for _ in range(5):
            before_ns, now_utc_ns, after_ns = monotonic_ns(), utc_ns(), monotonic_ns()
            readings.append((after_ns - before_ns, now_utc_ns - (before_ns + after_ns) // 2))
        spread_ns, self._offset_ns = min(readings)
        self.uncertainty_ns = spread_ns // 2


class SleepWatch:
    """Notices that the machine has slept: by the monotonic clock what was known before looks as new as ever."""

    def __init__(self) -> None:
        self._asleep_ns = asleep_ns()

    def slept_ns(self) -> int:
        """For how long, since this was last asked; 0: not at all."""
        slept_ns = asleep_ns() - self._asleep_ns
        self._asleep_ns += max(slept_ns, 0)
        return slept_ns if slept_ns >= SLEPT_NS else 0
