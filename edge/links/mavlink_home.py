"""Which of the links telemetry is asked for and taken from. Pure: every time comes in as an argument (monotonic ns)."""

from __future__ import annotations

HOME_SILENT_NS = 3_000_000_000
STEADY_NS = 2_000_000_000
STEADY_GAP_MAX_NS = 1_500_000_000  # between two messages of who speaks steadily: heartbeats come once a second


class Home:
    """Links are numbered by preference. Home is where the autopilot was heard first, until it falls silent there, or is
    heard steadily on a link of lower number."""

    def __init__(self) -> None:
        self.link: int | None = None
        self._heard_ns: dict[int, tuple[int, int]] = {}  # by link: steadily since, and last

    def heard(self, link: int, now_ns: int) -> None:
        """Anything of our autopilot's."""
        since_ns, last_ns = self._heard_ns.get(link, (now_ns, now_ns))
        self._heard_ns[link] = (now_ns if now_ns - last_ns > STEADY_GAP_MAX_NS else since_ns, now_ns)

    def may_be(self, link: int, now_ns: int) -> bool:
        """Whether a link that our autopilot's heartbeat came by is home, or can be from now on."""
        if self.link is None or link == self.link:
            return True
        since_ns, last_ns = self._heard_ns.get(link, (now_ns, now_ns))
        if link < self.link and now_ns - last_ns <= STEADY_GAP_MAX_NS and now_ns - since_ns >= STEADY_NS:
            return True
        _, home_ns = self._heard_ns.get(self.link, (0, 0))
        return now_ns - home_ns > HOME_SILENT_NS

    def forget(self) -> None:
        """Another autopilot is our own now: where the last one was heard says nothing of it."""
        self.link = None
        self._heard_ns.clear()
