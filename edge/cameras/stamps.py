"""Whose clock a camera's stamps are of, and where a stream's own clock lies on ours. Pure."""

from __future__ import annotations

from collections import deque

DOUBTED_FRAMES = 100  # in a row that are too old: no backlog is so long, so the clock is another
WINDOW_NS = 5_000_000_000
DRIFT_PPM = 500  # no two clocks of cameras and computers run further apart
# What waited while nobody read comes faster than it was filmed, each frame less late than the one before.
CATCHING_UP_NS = 10_000_000
CAUGHT_UP_NS = 500_000_000  # no frame that much less late for so long
CATCHING_UP_MAX_NS = 5_000_000_000  # after it the stream's clock runs faster than ours, and will go on so


class StampCheck:
    """Judges stamps that should be of our clock, but may be of none.

    A stamp that is too old is no reason to take the arrival for the exposure: after a stall the first frames *are* old,
    and told as new ones they would be wrong. Only where stamps never fitted, or do so no more for DOUBTED_FRAMES, is it
    the clock.
    """

    def __init__(self, age_max_ns: int) -> None:
        self._age_max_ns = age_max_ns
        self._doubted = DOUBTED_FRAMES

    def believes(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Whether this is when the frame that came at `arrival_ns` (monotonic) was exposed."""
        age_ns = arrival_ns - stamp_ns
        if age_ns < 0:
            return False
        self._doubted = 0 if age_ns <= self._age_max_ns else self._doubted + 1
        return self._doubted < DOUBTED_FRAMES


class StreamClock:
    """Presentation times of a stream on the monotonic clock.

    A stream's clock begins anywhere, so its offset is taken from the frame that came fastest: what the others took
    longer is the network's and the decoder's jitter, or a backlog, and leaves the stamp. That frame is forgotten no
    faster than two clocks drift apart. What is common to all frames (encoder, network, decoder) stays in the stamp;
    `latency_ms` takes that off, if it was measured.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._fastest: tuple[int, int] | None = None  # (arrival, arrival - stamp)
        self._began_ns = 0
        self._recent: deque[tuple[int, int]] = deque()  # the same of the last WINDOW_NS, the latter growing
        self._first_ns: int | None = None  # arrival
        self._less_late: tuple[int, int] | None = None  # the last frame that showed the stream to be catching up
        self.caught_up = False  # whether the stream tells what is now: before that, its stamps are too young

    def monotonic_ns(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """The frame's time on our clock, never later than its arrival; None if the stream gives no stamp that grows."""
        self._look_whether_caught_up(arrival_ns, arrival_ns - stamp_ns)
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is not None and stamp_ns <= last_ns:
            self._fastest = None
            self._recent.clear()
            return None
        delay_ns = arrival_ns - stamp_ns
        if self._fastest is None:
            self._began_ns = arrival_ns
        if self._fastest is None or delay_ns <= self._reference_ns(arrival_ns):
            self._fastest = (arrival_ns, delay_ns)
        while self._recent and self._recent[-1][1] >= delay_ns:
            self._recent.pop()
        self._recent.append((arrival_ns, delay_ns))
        while arrival_ns - self._recent[0][0] > WINDOW_NS:
            self._recent.popleft()
        return stamp_ns + self._reference_ns(arrival_ns)

    def behind_ns(self, now_ns: int) -> int:
        """By how much even the fastest frame of the last WINDOW_NS came later than the stream once did."""
        if self._fastest is None or now_ns - self._began_ns < WINDOW_NS:
            return 0
        return self._recent[0][1] - self._reference_ns(now_ns)

    def _look_whether_caught_up(self, arrival_ns: int, delay_ns: int) -> None:
        if self._first_ns is None:
            self._first_ns = arrival_ns
        if self._less_late is None or delay_ns < self._less_late[1] - CATCHING_UP_NS:
            self._less_late = (arrival_ns, delay_ns)
        calm = arrival_ns - self._less_late[0] >= CAUGHT_UP_NS
        self.caught_up = self.caught_up or calm or arrival_ns - self._first_ns >= CATCHING_UP_MAX_NS

    def _reference_ns(self, now_ns: int) -> int:
        assert self._fastest is not None
        since_ns, delay_ns = self._fastest
        return delay_ns + (now_ns - since_ns) * DRIFT_PPM // 1_000_000
