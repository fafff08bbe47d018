"""Autopilots of other systems on the same network, one of which may be our own. Pure."""

from __future__ import annotations

from edge.links.mavlink_vehicle import LOST_NS

RIVAL_NS = 8_000_000_000  # of heartbeats without a long gap; one that replaces our own autopilot needs less


class Rivals:
    """Every time is an argument (monotonic ns)."""

    def __init__(self) -> None:
        self._spans_ns: dict[int, tuple[int, int]] = {}  # by system id: first and last heartbeat
        self._told: set[int] = set()

    def heard(self, system_id: int, now_ns: int) -> None:
        """A heartbeat of an autopilot that is not our own."""
        since_ns, last_ns = self._spans_ns.get(system_id, (now_ns, now_ns))
        self._spans_ns[system_id] = (now_ns if now_ns - last_ns > LOST_NS else since_ns, now_ns)

    def forget(self, system_id: int) -> None:
        """The system has become our own."""
        self._spans_ns.pop(system_id, None)

    def news(self) -> list[int]:
        """Systems received for RIVAL_NS, each once."""
        lasting = {system for system, (since_ns, last_ns) in self._spans_ns.items() if last_ns - since_ns > RIVAL_NS}
        found = sorted(lasting - self._told)
        self._told |= lasting
        return found
