"""Operator requests to the running daemon: queued by a link, processed by the loop at its next frame."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from edge import clock

WAITING_MAX = 8
POINTED_AGE_MAX_NS = 2_000_000_000


@dataclass(frozen=True)
class TrackBox:
    """Look for a target in this box."""

    box_xyxy_share: tuple[float, float, float, float]  # of the image's width and height, 0..1


@dataclass(frozen=True)
class SelectTarget:
    """Select a tracked target."""

    track_id: int


@dataclass(frozen=True)
class StopTracking:
    """Drop all targets."""


Request = TrackBox | SelectTarget | StopTracking


@dataclass(frozen=True)
class ReloadOutcome:
    """Outcome of a reload of model and configuration."""

    flies: bool  # False: rejected, nothing has changed
    said: str  # a sentence for a person
    model_sha256: str  # of the model in use now
    taken_over: tuple[str, ...] = ()  # `[section] key`
    needs_restart: tuple[str, ...] = ()


# Requests a reload, whose outcome is passed on once, from another thread; False, with no outcome: one is in progress.
AskReload = Callable[[Callable[[ReloadOutcome], None]], bool]


class RequestQueue:
    """Bounded and thread-safe; neither side ever waits for the other.

    Requests other than a stop are dropped after POINTED_AGE_MAX_NS, as the image has changed by then.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[tuple[Request, int]] = []
        self._too_late = 0

    def put(self, request: Request) -> bool:
        """Queue a request; False, and it is dropped, if too many are queued.

        A stop is always accepted: it cancels what is queued, and replaces it if there is no room.
        """
        with self._lock:
            self._drop_old()
            if len(self._waiting) >= WAITING_MAX:
                if not isinstance(request, StopTracking):
                    return False
                self._waiting.clear()
            self._waiting.append((request, clock.monotonic_ns()))
            return True

    def take(self) -> list[Request]:
        """All queued requests that are not too old, oldest first."""
        with self._lock:
            self._drop_old()
            waiting, self._waiting = self._waiting, []
            return [request for request, _ in waiting]

    def too_late(self) -> int:
        """Number of requests dropped as too old since the last call."""
        with self._lock:
            count, self._too_late = self._too_late, 0
            return count

    def _drop_old(self) -> None:
        oldest_ns = clock.monotonic_ns() - POINTED_AGE_MAX_NS
        lasting = [(r, put_ns) for r, put_ns in self._waiting if isinstance(r, StopTracking) or put_ns >= oldest_ns]
        self._too_late += len(self._waiting) - len(lasting)
        self._waiting = lasting
