"""Selects the link on which telemetry is requested and accepted. Pure: every time is an argument (monotonic ns)."""

from __future__ import annotations

HOME_SILENT_NS = 3_000_000_000
STEADY_NS = 2_000_000_000
STEADY_GAP_MAX_NS = 1_500_000_000  # between messages of steady reception: heartbeats come once a second
TRIED_NS = 15_000_000_000  # trial of a link of lower number: enough to request each rate more than once


class Home:
    """Links are numbered by preference. Home is the link where the autopilot was received first, until it is silent
    there or is received steadily on a link of lower number. If that one brings no telemetry, home returns to the link
    that did."""

    def __init__(self) -> None:
        self.link: int | None = None
        self._heard_ns: dict[int, tuple[int, int]] = {}  # by link: received steadily since, and last
        self._carries = False  # whether telemetry arrived on the home link
        self._left: tuple[int, int] | None = None  # the previous home link, to return to, and when the trial began
        self._barren: set[int] = set()  # links that were tried without success

    def heard(self, link: int, now_ns: int) -> None:
        """A message of any kind from our autopilot."""
        since_ns, last_ns = self._heard_ns.get(link, (now_ns, now_ns))
        self._heard_ns[link] = (now_ns if now_ns - last_ns > STEADY_GAP_MAX_NS else since_ns, now_ns)

    def carries(self) -> None:
        """Telemetry arrived on the home link."""
        self._carries, self._left = True, None

    def may_be(self, link: int, now_ns: int) -> bool:
        """Whether a link that received our autopilot's heartbeat is home or may become it now."""
        if self.link is None or link == self.link:
            return True
        if self._missed(link, now_ns):
            return True
        since_ns, last_ns = self._heard_ns.get(link, (now_ns, now_ns))
        steady = now_ns - last_ns <= STEADY_GAP_MAX_NS and now_ns - since_ns >= STEADY_NS
        if link < self.link and link not in self._barren and steady:
            return True
        _, home_ns = self._heard_ns.get(self.link, (0, 0))
        return now_ns - home_ns > HOME_SILENT_NS

    def move(self, link: int, now_ns: int) -> None:
        """Make another link home, one for which `may_be` is true."""
        left, returns = self.link, self._missed(link, now_ns)
        if left is not None and returns:
            self._barren.add(left)
        if left is not None and link < left and self._carries:
            self._left = (left, now_ns)
        elif self._left is not None:  # several links may be tried before returning
            self._left = (self._left[0], now_ns) if link < self._left[0] else None
        self.link, self._carries = link, returns

    def _missed(self, link: int, now_ns: int) -> bool:
        """Whether a link brought telemetry before another was tried as home, and that trial has failed."""
        return self._left is not None and self._left[0] == link and now_ns - self._left[1] > TRIED_NS
