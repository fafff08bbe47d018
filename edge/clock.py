"""The daemon's time source: the host's clocks, or in lock-step mode a sequence's, which stands still between steps.

Every decision and timestamp uses it, so that a replay can control time. Only guards against a hanging process (the
watchdog, timeouts for the end of a thread) use the host's clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

UTC_PERIOD_NS = 1_000_000_000
UTC_SET_NS = 1_000_000  # a smaller step of UTC is found by the next measurement
SLEPT_NS = 10_000_000  # no machine suspends and resumes in less

_stepped_ns: int | None = None


def monotonic_ns() -> int:
    """Monotonic nanoseconds, of the host or of the current step."""
    return time.monotonic_ns() if _stepped_ns is None else _stepped_ns


def utc_ns() -> int:
    """Nanoseconds since 1970 UTC; in lock-step mode the same as `monotonic_ns`, as a replay has no date."""
    return time.time_ns() if _stepped_ns is None else _stepped_ns


def asleep_ns() -> int:
    """Total time in suspend since boot, which the monotonic clock does not count; 0 in lock-step mode."""
    # In this order, a delay between the two readings makes the result smaller, not larger.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns() if _stepped_ns is None else 0


def stepped() -> bool:
    """Whether time is advanced by `step_to` only (lock-step mode)."""
    return _stepped_ns is not None


def step_to(time_ns: int) -> None:
    """Set the time to `time_ns` until the next step. Raises ValueError for a step back."""
    global _stepped_ns
    if _stepped_ns is not None and time_ns < _stepped_ns:
        raise ValueError(f"{time_ns} is before {_stepped_ns}")
    _stepped_ns = time_ns


def run_freely() -> None:
    """Return to the host's clocks."""
    global _stepped_ns
    _stepped_ns = None


@dataclass
class UtcClock:
    """Converts monotonic time to UTC and back, by an offset measured every second and as soon as UTC was stepped or the
    machine was suspended. Use from one thread."""

    _offset_ns: int = 0
    _measured_ns: int | None = None

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
        """Whether UTC was stepped: a reading since `before_ns`, however delayed, does not fit the stored offset."""
        now_utc_ns, after_ns = utc_ns(), monotonic_ns()
        ahead_ns = now_utc_ns - self._offset_ns
        return not before_ns - UTC_SET_NS <= ahead_ns <= after_ns + UTC_SET_NS

    def _measure(self) -> None:
        """UTC is read between two monotonic readings; the closest pair of a few is used, so that delays do no harm."""
        readings = []
        for _ in range(5):
            before_ns, now_utc_ns, after_ns = monotonic_ns(), utc_ns(), monotonic_ns()
            readings.append((after_ns - before_ns, now_utc_ns - (before_ns + after_ns) // 2))
        _, self._offset_ns = min(readings)


class SleepWatch:
    """Detects that the machine was suspended: by the monotonic clock alone, old state would look current."""

    def __init__(self) -> None:
        self._asleep_ns = asleep_ns()

    def slept_ns(self) -> int:
        """Time suspended since the last call; 0: not at all."""
        slept_ns = asleep_ns() - self._asleep_ns
        self._asleep_ns += max(slept_ns, 0)
        return slept_ns if slept_ns >= SLEPT_NS else 0
