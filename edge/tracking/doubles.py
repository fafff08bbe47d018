"""Duplicate targets of one aircraft: both fit the same detections, take turns at them and are never both seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

TURNS_NS = 2_000_000_000
TURNS_MIN = 20  # at low frame rates, two targets that are often missed may not be seen together for TURNS_NS either

Key = tuple[int, int]  # track_id and born_ns


@dataclass
class _Turns:
    since_ns: int
    last_ns: int
    count: int = 0


class Doubles:
    """Counts the turns of each pair since both were last seen in one frame. Used by the tracker, once a frame."""

    def __init__(self) -> None:
        self._turns: dict[frozenset[Key], _Turns] = {}

    def among(self, both: set[Key], turns: Iterable[tuple[Key, Key]], time_ns: int) -> list[tuple[Key, Key]]:
        """Those of `turns` (target seen, target missed though it fits as well) that are of one aircraft.

        All targets in `both` were seen in this frame.
        """
        # A target not seen for that long is lost, and its turns with it.
        self._turns = {
            pair: one for pair, one in self._turns.items() if not pair <= both and time_ns - one.last_ns <= TURNS_NS
        }
        found = []
        for seen, missed in turns:
            known = self._turns.setdefault(frozenset((seen, missed)), _Turns(time_ns, time_ns))
            known.last_ns = time_ns
            known.count += 1
            if known.count >= TURNS_MIN and time_ns - known.since_ns > TURNS_NS:
                found.append((seen, missed))
        return found
