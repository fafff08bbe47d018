"""Lines that say how far a long computation over windows has come."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from trainer.data import TrainingBatch

TOLD_EVERY = 150  # windows


class Tally:
    """Says how many of `total` windows are done, every TOLD_EVERY and at the end."""

    def __init__(self, what: str, total: int, say: Callable[[str], None]) -> None:
        self._what, self._total, self._say = what, total, say
        self._done = 0

    def add(self, count: int) -> None:
        before, self._done = self._done, self._done + count
        if self._done // TOLD_EVERY > before // TOLD_EVERY or self._done >= self._total:
            self._say(f"{self._what}: {self._done} of {self._total} windows")


def windows_in(batches: Iterable[TrainingBatch]) -> int:
    return sum(len(batch.present) for batch in batches)
