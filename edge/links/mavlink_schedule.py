"""How often each message may go. Pure: every time comes in as an argument."""

from __future__ import annotations

import math
from collections.abc import Mapping

RESUMED_HZ = math.inf  # to `set_rate`: the rate that holds, or the default of what is off
ASKED_NS = 1_000_000_000  # what was asked for once and could not be told for so long is not told later
EARLY_SHARE = 0.1  # a message may come this share of its interval early: frames jitter


class Schedule:
    """Rates by message id; each may have several instances (targets) with a rhythm of their own."""

    def __init__(self, default_hz: Mapping[int, float]) -> None:
        self._default_hz = dict(default_hz)
        self._hz = dict(default_hz)
        self._due_ns: dict[tuple[int, int], int] = {}
        self._once: dict[int, int] = {}  # message id, until ns

    @property
    def message_ids(self) -> set[int]:
        return set(self._default_hz)

    def set_rate(self, message_id: int, hz: float | None) -> None:
        """0 switches off, None takes the default, RESUMED_HZ does where it is off."""
        if hz == RESUMED_HZ:
            hz = self._hz[message_id] or None
        self._hz[message_id] = self._default_hz[message_id] if hz is None else hz

    def ask_once(self, message_id: int, now_ns: int) -> None:
        """Let the next opportunity within ASKED_NS be taken whatever the rate."""
        self._once[message_id] = now_ns + ASKED_NS

    def due(self, message_id: int, instance: int, now_ns: int) -> bool:
        """Whether to send now; it then counts as sent. False for what is not scheduled at all."""
        hz = self._hz.get(message_id, 0.0)
        if now_ns <= self._once.pop(message_id, -1):
            return message_id in self._hz
        if hz == 0.0:
            return False
        interval_ns = round(1e9 / hz)
        # A rate that was raised since holds from now on; one that holds is due no later than this.
        latest_ns = now_ns + round((1.0 + EARLY_SHARE) * interval_ns)
        due_ns = min(self._due_ns.get((message_id, instance), now_ns), latest_ns)
        self._due_ns[message_id, instance] = due_ns
        if now_ns < due_ns - EARLY_SHARE * interval_ns:
            return False
        self._due_ns[message_id, instance] = max(due_ns, now_ns - interval_ns) + interval_ns
        return True
