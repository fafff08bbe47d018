"""Which of the links telemetry is asked for and taken from. Pure: every time comes in as an argument (monotonic ns)."""

from __future__ import annotations

HOME_SILENT_NS = 3_000_000_000
STEADY_NS = 2_000_000_000
STEADY_GAP_MAX_NS = 1_500_000_000  # between two messages of who speaks steadily: heartbeats come once a second
TRIED_NS = 15_000_000_000  # on a link of lower number: time to ask for each rate more than once


class Home:
    """Links are numbered by preference. Home is where the autopilot was heard first, until it falls silent there, or is
    heard steadily on a link of lower number; from one that then brings no telemetry it goes back to one that did."""

    def __init__(self) -> None:
        self.link: int | None = None
        self._heard_ns: dict[int, tuple[int, int]] = {}  # by link: steadily since, and last
        self._carries = False  # whether telemetry came by the home link
        self._left: tuple[int, int] | None = None  # the link that home was before and goes back to, and since when
        self._barren: set[int] = set()  # links that were tried in vain

    def heard(self, link: int, now_ns: int) -> None:
        """Anything of our autopilot's."""
        since_ns, last_ns = self._heard_ns.get(link, (now_ns, now_ns))
        self._heard_ns[link] = (now_ns if now_ns - last_ns > STEADY_GAP_MAX_NS else since_ns, now_ns)

    def carries(self) -> None:
        """Telemetry came by the home link."""
        self._carries, self._left = True, None

    def may_be(self, link: int, now_ns: int) -> bool:
        """Whether a link that our autopilot's heartbeat came by is home, or can be from now on."""
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
        """Home is another link from now on: one that may be."""
        left, returns = self.link, self._missed(link, now_ns)
        if left is not None and returns:
            self._barren.add(left)
        if left is not None and link < left and self._carries:
            self._left = (left, now_ns)
        elif self._left is not None:  # several are tried before it goes back
            self._left = (self._left[0], now_ns) if link < self._left[0] else None
        self.link, self._carries = link, returns

    def _missed(self, link: int, now_ns: int) -> bool:
        """Whether telemetry came by a link until home was tried elsewhere, and none has come since."""
        return self._left is not None and self._left[0] == link and now_ns - self._left[1] > TRIED_NS
