"""Which system is our own if it is not configured. Pure: every time is an argument (monotonic ns).

It is the first whose autopilot is received. Once it has been for SETTLED_NS, any other received meanwhile is another
aircraft and never accepted. One first received after ours fell silent may be the same autopilot under another id: it is
accepted until the former is received again, which proves it to be another aircraft too. A first one that was our own
only briefly was another aircraft flying by: it is not accepted again.
"""

from __future__ import annotations

# A slow line may still deliver messages of our autopilot after it changed its id: these are not a second autopilot.
MEANWHILE_NS = 1_000_000_000
SETTLED_NS = 10_000_000_000  # of reception, after which our own is unlikely to be another aircraft flying by


class Succession:
    """System ids in the order in which they were our own, and those that never can be."""

    def __init__(self) -> None:
        self._line: list[int] = []  # the last one is our own
        self._tenure_ns: dict[int, tuple[int, int]] = {}  # of those in the line: received as our own from, and to
        self._others: dict[int, int] = {}  # received since, not yet known to be strangers
        self._strangers: set[int] = set()

    def spoke(self, now_ns: int) -> None:
        """Our own autopilot was received."""
        if not self._line:
            return
        own = self._line[-1]
        since_ns, _ = self._tenure_ns[own]
        self._tenure_ns[own] = (since_ns, now_ns)
        if now_ns - since_ns < SETTLED_NS:
            return
        meanwhile = [system for system, since_ns in self._others.items() if now_ns - since_ns >= MEANWHILE_NS]
        self._strangers.update(meanwhile)
        for system in meanwhile:
            del self._others[system]

    def noticed(self, system_id: int, now_ns: int) -> None:
        """The autopilot of a system was received, on any link."""
        if system_id not in self._line and system_id not in self._strangers:
            self._others.setdefault(system_id, now_ns)

    def takes(self, system_id: int, own_silent: bool, now_ns: int) -> bool:
        """Whether the system whose autopilot was received is our own, possibly from now on."""
        if system_id in self._line:
            since = self._line.index(system_id) + 1
            if self._outranks(system_id):
                self._strangers.update(self._line[since:])
                del self._line[since:]
                return True
            self._line.remove(system_id)
        if system_id in self._strangers or (self._line and not own_silent):
            self.noticed(system_id, now_ns)
            return False
        self._others.pop(system_id, None)
        self._line.append(system_id)
        self._tenure_ns[system_id] = (now_ns, now_ns)
        return True

    def is_former(self, system_id: int) -> bool:
        """Whether the system was our own until it fell silent."""
        return system_id in self._line[:-1] and self._outranks(system_id)

    def is_stranger(self, system_id: int) -> bool:
        return system_id in self._strangers

    def _outranks(self, system_id: int) -> bool:
        """Whether one of the line was our own for SETTLED_NS, or as long as the last one, and so may be again."""
        long_ns, own_ns = (to - since for since, to in (self._tenure_ns[system_id], self._tenure_ns[self._line[-1]]))
        return long_ns >= min(SETTLED_NS, own_ns)
