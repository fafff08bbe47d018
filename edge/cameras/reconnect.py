"""When to reopen a lost camera: a pure state machine, driven by `capture`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

FIRST_WAIT_NS = 250_000_000
LONGEST_WAIT_NS = 5_000_000_000


class LinkState(Enum):
    CLOSED = "closed"  # to be opened at `retry_at_ns`
    STREAMING = "streaming"  # open and delivering


@dataclass(frozen=True)
class Reconnect:
    """Capped exponential backoff: 0.25 s, 0.5 s, ... 5 s; a delivered frame resets it."""

    state: LinkState = LinkState.CLOSED
    failures: int = 0
    retry_at_ns: int = 0

    def delivered(self) -> Reconnect:
        return Reconnect(LinkState.STREAMING)

    def lost(self, now_ns: int) -> Reconnect:
        wait_ns = min(FIRST_WAIT_NS << min(self.failures, 16), LONGEST_WAIT_NS)
        return Reconnect(LinkState.CLOSED, self.failures + 1, now_ns + wait_ns)
