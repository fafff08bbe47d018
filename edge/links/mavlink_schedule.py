"""Limits how often each message is sent. Pure: every time is an argument."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

RESUMED_HZ = math.inf  # to `set_rate`: keep the current rate, or the default if the message is off
ASKED_NS = 1_000_000_000  # a single request that could not be met for this long is dropped
EARLY_SHARE = 0.1  # a message may be early by this share of its interval, as frame times jitter


@dataclass
class _Request:
    """For all instances of one message, as they are at one instant."""

    until_ns: int
    met_ns: int | None = None
    instances: set[int] = field(default_factory=set)

    def meets(self, instance: int, now_ns: int) -> bool:
        """Whether it is open for this instance, which then counts as sent."""
        if now_ns > self.until_ns or self.met_ns not in (None, now_ns) or instance in self.instances:
            return False
        self.met_ns = now_ns
        self.instances.add(instance)
        return True


class Schedule:
    """Rates by message id; each may have several instances (targets), timed independently."""

    def __init__(self, default_hz: Mapping[int, float]) -> None:
        self._default_hz = dict(default_hz)
        self._hz = dict(default_hz)
        self._due_ns: dict[tuple[int, int], int] = {}
        self._once: dict[int, _Request] = {}  # by message id

    @property
    def message_ids(self) -> set[int]:
        return set(self._default_hz)

    def set_rate(self, message_id: int, hz: float | None) -> None:
        """0 switches the message off, None sets the default, RESUMED_HZ the default if it is off."""
        if hz == RESUMED_HZ:
            hz = self._hz[message_id] or None
        self._hz[message_id] = self._default_hz[message_id] if hz is None else hz

    def ask_once(self, message_id: int, now_ns: int) -> None:
        """Send all instances at the next opportunity within ASKED_NS, regardless of the rate."""
        self._once[message_id] = _Request(now_ns + ASKED_NS)

    def due(self, message_id: int, instance: int, now_ns: int) -> bool:
        """Whether to send now; it then counts as sent. False for a message that is not scheduled."""
        hz = self._hz.get(message_id, 0.0)
        request = self._once.get(message_id)
        if request is not None and request.meets(instance, now_ns):
            return message_id in self._hz
        if hz == 0.0:
            return False
        interval_ns = round(1e9 / hz)
        # A rate raised meanwhile takes effect now; with an unchanged rate the due time is never later than this.
        latest_ns = now_ns + round((1.0 + EARLY_SHARE) * interval_ns)
        due_ns = min(self._due_ns.get((message_id, instance), now_ns), latest_ns)
        self._due_ns[message_id, instance] = due_ns
        if now_ns < due_ns - EARLY_SHARE * interval_ns:
            return False
        self._due_ns[message_id, instance] = max(due_ns, now_ns - interval_ns) + interval_ns
        return True
