"""When to retry after a failure. Pure: every time is an argument."""

from __future__ import annotations

from dataclasses import dataclass

FIRST_WAIT_NS = 250_000_000
LONGEST_WAIT_NS = 8_000_000_000
STEADY_NS = 2_000_000_000  # a connection that lasted this long resets the waits


@dataclass(frozen=True)
class Backoff:
    """Waits of 0.25 s, 0.5 s, ... 8 s between attempts, reset after a connection that lasted."""

    retry_at_ns: int = 0
    failures: int = 0
    opened_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        return self.opened_ns is None and now_ns >= self.retry_at_ns

    def opened(self, now_ns: int) -> Backoff:
        return Backoff(self.retry_at_ns, self.failures, now_ns)

    def failed(self, now_ns: int) -> Backoff:
        """An attempt failed, or the connection was lost."""
        steady = self.opened_ns is not None and now_ns - self.opened_ns >= STEADY_NS
        failures = 0 if steady else self.failures
        wait_ns = min(FIRST_WAIT_NS << min(failures, 16), LONGEST_WAIT_NS)
        return Backoff(now_ns + wait_ns, failures + 1)
