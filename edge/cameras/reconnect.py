"""When to reopen a lost camera. Pure: every time is an argument."""

from __future__ import annotations

from dataclasses import dataclass

FIRST_WAIT_NS = 250_000_000
LONGEST_WAIT_NS = 5_000_000_000


@dataclass(frozen=True)
class Reconnect:
    """Capped exponential backoff: 0.25 s, 0.5 s, ... 5 s; a delivered frame resets it."""

    failures: int = 0
    retry_at_ns: int = 0

    def delivered(self) -> Reconnect:
        return Reconnect()

    def lost(self, now_ns: int) -> Reconnect:
        wait_ns = min(FIRST_WAIT_NS << min(self.failures, 16), LONGEST_WAIT_NS)
        return Reconnect(self.failures + 1, now_ns + wait_ns)
