"""What time it is for the daemon: the host's clocks, or in lock-step a sequence's, which stands still between steps.

Whatever decides or stamps by time asks here, so that a replay can own time. What guards against a process that hangs
(the watchdog, a wait for a thread's end) keeps to the host's clock.
"""

from __future__ import annotations

import time

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
