"""Which system is our own where the settings do not name it. Pure: every time comes in as an argument (monotonic ns).

It is the first whose autopilot is heard. Once it has been that for some time, another that is heard while it speaks is
another aircraft, and never taken. One that is first heard after it fell silent may be the same autopilot under another
id: it is taken, until the former is heard again, which shows that it was another aircraft too. A first that was our own
for a moment alone was another aircraft that flew by: it is not taken back.
"""

from __future__ import annotations

# What a slow line still brings of an autopilot after it took another id does not make two of it.
MEANWHILE_NS = 1_000_000_000
SETTLED_NS = 10_000_000_000  # of being heard, from which on our own is not likely to be another's that flies by


class Succession:
    """System ids in the order in which they were our own, and those that never are."""

    def __init__(self) -> None:
        self._line: list[int] = []  # the last of them is our own
        self._tenure_ns: dict[int, tuple[int, int]] = {}  # of those in the line: heard as our own from, and to
        self._others: dict[int, int] = {}  # heard, and not known yet to be strangers: since when
        self._strangers: set[int] = set()

    def spoke(self, now_ns: int) -> None:
        """Our own was heard."""
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
        """The autopilot of a system was heard, by whatever way."""
        if system_id not in self._line and system_id not in self._strangers:
            self._others.setdefault(system_id, now_ns)

    def takes(self, system_id: int, own_silent: bool, now_ns: int) -> bool:
        """Whether the system whose autopilot is heard is our own from now on, if it was not before."""
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
        """Whether it was our own until it fell silent."""
        return system_id in self._line[:-1] and self._outranks(system_id)

    def is_stranger(self, system_id: int) -> bool:
        return system_id in self._strangers

    def _outranks(self, system_id: int) -> bool:
        """Whether one of the line was our own long enough to be so again, or as long as the last of it."""
        long_ns, own_ns = (to - since for since, to in (self._tenure_ns[system_id], self._tenure_ns[self._line[-1]]))
        return long_ns >= min(SETTLED_NS, own_ns)
