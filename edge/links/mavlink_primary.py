"""Selects the target for messages with room for only one: always the same one while it exists."""

from __future__ import annotations

from collections.abc import Sequence

from edge.types import Track, TrackState

WITHHELD_MAX_NS = 2_000_000_000  # as long as a target that is not detected is kept


class Primary:
    """The selected target, else the one sent so far, else the lowest-numbered, detected ones before coasting ones.

    A follower must never be led to another aircraft and back: while the target is withheld, none is sent.
    """

    def __init__(self) -> None:
        self._told: tuple[int, int] | None = None  # track_id and born_ns of the one sent so far
        self._told_ns = 0

    def of(self, alive: Sequence[Track], sendable: Sequence[Track], chosen_id: int | None, now_ns: int) -> Track | None:
        """That target of a frame; None: there is none, or it is withheld. `sendable` are some of those `alive`."""
        if chosen_id is not None:
            wanted = next(((t.track_id, t.born_ns) for t in alive if t.track_id == chosen_id), None)
        else:
            wanted = self._told if now_ns - self._told_ns <= WITHHELD_MAX_NS else None
        if wanted is None or wanted not in [(t.track_id, t.born_ns) for t in alive]:
            candidates = sendable
        else:
            candidates = [t for t in sendable if (t.track_id, t.born_ns) == wanted]
        first = min(candidates, key=lambda t: (t.state is not TrackState.CONFIRMED, t.track_id), default=None)
        if first is not None:
            self._told, self._told_ns = (first.track_id, first.born_ns), now_ns
        return first
