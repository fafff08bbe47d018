"""What a person asks of the running daemon: a link leaves it here, the loop takes it at its next frame."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from edge import clock

WAITING_MAX = 8
POINTED_AGE_MAX_NS = 2_000_000_000


@dataclass(frozen=True)
class TrackBox:
    """Look for a target here."""

    box_xyxy_share: tuple[float, float, float, float]  # of the picture's width and height, 0..1


@dataclass(frozen=True)
class SelectTarget:
    """Choose a target that is tracked."""

    track_id: int


@dataclass(frozen=True)
class StopTracking:
    """Drop all targets."""


Request = TrackBox | SelectTarget | StopTracking


@dataclass(frozen=True)
class ReloadOutcome:
    """What came of a reload of model and configuration."""

    flies: bool  # False: refused, all is as before
    said: str  # a sentence for a person
    model_sha256: str  # that flies now
    taken_over: tuple[str, ...] = ()  # `[section] key`
    needs_restart: tuple[str, ...] = ()


# Asks for a reload, whose outcome is told once, from another thread; False, and nothing is told: one is under way.
AskReload = Callable[[Callable[[ReloadOutcome], None]], bool]


class RequestQueue:
    """Bounded, and safe to use from several threads; neither side ever waits for the other.

    What was pointed at longer than POINTED_AGE_MAX_NS ago is dropped: the picture is another one by then.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[tuple[Request, int]] = []
        self._too_late = 0

    def put(self, request: Request) -> bool:
        """Leave a request; False, and it is not taken, if too many wait.

        A stop always is: it undoes what waits, and where there is no room takes its place.
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
        """All that wait and are not too late, oldest first."""
        with self._lock:
            self._drop_old()
            waiting, self._waiting = self._waiting, []
            return [request for request, _ in waiting]

    def too_late(self) -> int:
        """How many were dropped since the last call."""
        with self._lock:
            count, self._too_late = self._too_late, 0
            return count

    def _drop_old(self) -> None:
        oldest_ns = clock.monotonic_ns() - POINTED_AGE_MAX_NS
        lasting = [(r, put_ns) for r, put_ns in self._waiting if isinstance(r, StopTracking) or put_ns >= oldest_ns]
        self._too_late += len(self._waiting) - len(lasting)
        self._waiting = lasting
