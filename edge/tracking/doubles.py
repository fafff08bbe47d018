"""Which two targets are one aircraft: both fit what is seen, by turns, and never are both seen at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

TURNS_NS = 2_000_000_000
TURNS_MIN = 20  # at few frames a second two that are often missed are not seen together for as long

Key = tuple[int, int]  # number and birth


@dataclass
class _Turns:
    since_ns: int
    last_ns: int
    count: int = 0


class Doubles:
    """Counts the turns of each two since they were last seen together. Used by the tracker, once a frame."""

    def __init__(self) -> None:
        self._turns: dict[frozenset[Key], _Turns] = {}

    def among(self, both: set[Key], turns: Iterable[tuple[Key, Key]], time_ns: int) -> list[tuple[Key, Key]]:
        """Of these `turns`, (who was seen, who was missed though it fits as well), those of one aircraft.

        Of `both`, any two were seen at once.
        """
        # A target that nobody has seen for so long is gone, and its turns with it.
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
