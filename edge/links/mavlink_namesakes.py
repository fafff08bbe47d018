"""Detects other components of our vehicle with one of our ids: an existing camera or companion. Pure.

Both would execute the same commands and receive each other's answers.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Any

from edge.links.mavlink_packing import Letter
from edge.links.mavlink_table import HEARTBEAT

REMEMBERED = 64  # of our own heartbeats: routers may return them to us, seconds later
HEARD_OFTEN = 3  # foreign heartbeats until it is reported


class Namesakes:
    """`keys`: for each of our component ids the configuration key that sets it."""

    def __init__(self, keys: Mapping[int, str]) -> None:
        self._keys = dict(keys)
        self._ours: deque[tuple[int, ...]] = deque(maxlen=REMEMBERED)
        self._heard: Counter[int] = Counter()

    def sent(self, heartbeats: Iterable[Letter]) -> None:
        self._ours += [_content(letter.component_id, letter.message) for letter in heartbeats]

    def heard(self, message: Any, vehicle_id: int | None) -> None:
        """Any message except an autopilot's heartbeat."""
        component_id = message.get_srcComponent()
        ours = message.get_srcSystem() == vehicle_id and component_id in self._keys
        if ours and message.get_msgId() == HEARTBEAT and _content(component_id, message) not in self._ours:
            self._heard[component_id] += 1

    def news(self) -> list[str]:
        """A sentence for each such id, once."""
        often = [one for one in self._keys if self._heard[one] >= HEARD_OFTEN]
        return [f"another component {one} of this vehicle is heard: set another {self._keys.pop(one)}" for one in often]


def _content(component_id: int, heartbeat: Any) -> tuple[int, ...]:
    beat = heartbeat
    return component_id, beat.type, beat.autopilot, beat.base_mode, beat.custom_mode, beat.system_status
