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
        first = self._best(alive, sendable, chosen_id, now_ns)
        if first is not None:
            self._told, self._told_ns = (first.track_id, first.born_ns), now_ns
        return first

    def in_image(
        self, alive: Sequence[Track], rangeless: Sequence[Track], chosen_id: int | None, now_ns: int
    ) -> Track | None:
        """The target to show in the image while none can be sent with its range: by the same rules one of the
        `rangeless`. It does not count as sent, so that the first one with a range takes its place."""
        return self._best(alive, rangeless, chosen_id, now_ns)

    def _best(
        self, alive: Sequence[Track], candidates: Sequence[Track], chosen_id: int | None, now_ns: int
    ) -> Track | None:
        if chosen_id is not None:
            wanted = next(((t.track_id, t.born_ns) for t in alive if t.track_id == chosen_id), None)
        else:
            wanted = self._told if now_ns - self._told_ns <= WITHHELD_MAX_NS else None
        if wanted is not None and wanted in [(t.track_id, t.born_ns) for t in alive]:
            candidates = [t for t in candidates if (t.track_id, t.born_ns) == wanted]
        return min(candidates, key=lambda t: (t.state is not TrackState.CONFIRMED, t.track_id), default=None)
