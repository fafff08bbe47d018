"""Selects the target for messages with room for only one: always the same one while it exists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from edge.types import Track, TrackState

WITHHELD_MAX_NS = 2_000_000_000  # as long as a target that is not detected is kept


class _Selected(NamedTuple):
    """A track, and when it was last selected."""

    track_id: int
    born_ns: int
    time_ns: int


class Primary:
    """The selected target, else the one sent so far, else the lowest-numbered, detected ones before coasting ones.

    A follower must never be led to another aircraft and back: while the target is withheld, none is sent.
    """

    def __init__(self) -> None:
        self._told: _Selected | None = None
        self._shown: _Selected | None = None  # in the image: the one told, or one without a range

    def of(self, alive: Sequence[Track], sendable: Sequence[Track], chosen_id: int | None, now_ns: int) -> Track | None:
        """That target of a frame; None: there is none, or it is withheld. `sendable` are some of those `alive`."""
        first = _first(alive, sendable, chosen_id, self._told, now_ns)
        if first is not None:
            self._told = self._shown = _Selected(first.track_id, first.born_ns, now_ns)
        return first

    def in_image(
        self, alive: Sequence[Track], rangeless: Sequence[Track], chosen_id: int | None, now_ns: int
    ) -> Track | None:
        """The target to show in the image, to be called for each frame of which none is sent with its range: one of the
        `rangeless`, the same one while it exists. It does not count as sent, so that the first one with a range takes
        its place."""
        first = _first(alive, rangeless, chosen_id, self._shown, now_ns)
        if first is not None:
            self._shown = _Selected(first.track_id, first.born_ns, now_ns)
        return first


def _first(
    alive: Sequence[Track], candidates: Sequence[Track], chosen_id: int | None, before: _Selected | None, now_ns: int
) -> Track | None:
    if chosen_id is not None:
        wanted = next(((t.track_id, t.born_ns) for t in alive if t.track_id == chosen_id), None)
    elif before is not None and now_ns - before.time_ns <= WITHHELD_MAX_NS:
        wanted = (before.track_id, before.born_ns)
    else:
        wanted = None
    if wanted in [(t.track_id, t.born_ns) for t in alive]:
        candidates = [t for t in candidates if (t.track_id, t.born_ns) == wanted]
    return min(candidates, key=lambda t: (t.state is not TrackState.CONFIRMED, t.track_id), default=None)
