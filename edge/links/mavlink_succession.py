"""Which system is our own where the settings do not name it. Pure: every time comes in as an argument (monotonic ns).

It is the first whose autopilot is heard. Another that is heard while it speaks is another aircraft, and never taken.
One that is first heard after it fell silent may be the same autopilot under another id: it is taken, until the former
is heard again, which shows that it was another aircraft too.
"""

from __future__ import annotations

# What a slow line still brings of an autopilot after it took another id does not make two of it.
MEANWHILE_NS = 1_000_000_000


class Succession:
    """System ids in the order in which they were our own, and those that never are."""

    def __init__(self) -> None:
        self._line: list[int] = []  # the last of them is our own
        self._others: dict[int, int] = {}  # heard, and not known yet to be strangers: since when
        self._strangers: set[int] = set()

    def spoke(self, now_ns: int) -> None:
        """Our own was heard."""
        meanwhile = [system for system, since_ns in self._others.items() if now_ns - since_ns >= MEANWHILE_NS]
        self._strangers.update(meanwhile)
        for system in meanwhile:
            del self._others[system]

    def noticed(self, system_id: int, now_ns: int) -> None:
        """The autopilot of a system was heard, by whatever way."""
        if system_id not in self._line and system_id not in self._strangers:
            self._others.setdefault(system_id, now_ns)

    def takes(self, system_id: int, own_silent: bool, now_ns: int) -> bool:
        """Whether the system whose autopilot is heard is our own from now on, if it was not before."""
        if system_id in self._line:
            since = self._line.index(system_id) + 1
            self._strangers.update(self._line[since:])
            del self._line[since:]
            return True
        if system_id in self._strangers or (self._line and not own_silent):
            self.noticed(system_id, now_ns)
            return False
        self._others.pop(system_id, None)
        self._line.append(system_id)
        return True

    def is_former(self, system_id: int) -> bool:
        """Whether it was our own until it fell silent."""
        return system_id in self._line[:-1]

    def is_stranger(self, system_id: int) -> bool:
        return system_id in self._strangers
