"""Whose clock a camera's stamps are of, and where a stream's own clock lies on ours. Pure."""

from __future__ import annotations

from collections import deque

import numpy as np

DOUBTED_FRAMES = 100  # in a row that are too old: no backlog is so long, so the clock is another
WINDOW_NS = 5_000_000_000
DRIFT_PPM = 500  # no two quartz clocks run further apart
# Encoders that count frames instead of time run slow by as much as the sensor does: 1000 ppm where they tell 30 a
# second of 29.97. Little more is believed, as what a decoder or a link cannot keep up with looks alike, and is stale.
SLOW_MAX_PPM = 2_000
SLOW_WINDOW_NS = 2_500_000_000
SLOW_WINDOWS = 6  # 15 s: no clock that is followed is by then so late that it is taken for a backlog
RAMP_OFF_SHARE, RAMP_OFF_NS = 0.05, 3_000_000  # how far off its line a ramp may be: of its rise, or this if it is more
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


class SlowClock:
    """By how much a stream's clock runs slower than ours, in ppm; 0 where that is no more than DRIFT_PPM.

    What a backlog adds to the delay of the fastest frames is a step, what a slow clock adds is a ramp: only one that
    was straight over SLOW_WINDOWS is believed, and then until another is. A fast clock needs none of it: its frames
    become the fastest by themselves.
    """

    def __init__(self) -> None:
        self.ppm = 0
        self._fastest: deque[tuple[int, int]] = deque(maxlen=SLOW_WINDOWS)  # (arrival, delay) of each window
        self._window_ends_ns = 0

    def take(self, arrival_ns: int, delay_ns: int) -> None:
        if not self._fastest or arrival_ns >= self._window_ends_ns:
            if len(self._fastest) == SLOW_WINDOWS:
                self._look_for_a_ramp()
            self._fastest.append((arrival_ns, delay_ns))
            self._window_ends_ns = arrival_ns + SLOW_WINDOW_NS
        elif delay_ns < self._fastest[-1][1]:
            self._fastest[-1] = (arrival_ns, delay_ns)

    def _look_for_a_ramp(self) -> None:
        began_ns, least_ns = self._fastest[0]
        since_ns = np.array([arrival_ns - began_ns for arrival_ns, _ in self._fastest], dtype=np.float64)
        later_ns = np.array([delay_ns - least_ns for _, delay_ns in self._fastest], dtype=np.float64)
        slope, start_ns = np.polyfit(since_ns, later_ns, 1)
        off_ns = np.abs(start_ns + slope * since_ns - later_ns).max()
        straight = off_ns <= max(RAMP_OFF_SHARE * abs(slope) * since_ns[-1], RAMP_OFF_NS)
        if straight and abs(slope) <= SLOW_MAX_PPM * 1e-6:
            self.ppm = round(slope * 1e6) if slope > DRIFT_PPM * 1e-6 else 0


class StreamClock:
    """Presentation times of a stream on the monotonic clock.

    A stream's clock begins anywhere, so its offset is taken from the frame that came fastest: what the others took
    longer is the network's and the decoder's jitter, or a backlog, and leaves the stamp. That frame is forgotten no
    faster than two clocks drift apart, or the stream's has been seen to. What is common to all frames (encoder,
    network, decoder) stays in the stamp; `latency_ms` takes that off, if it was measured.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._fastest: tuple[int, int] | None = None  # (arrival, arrival - stamp)
        self._began_ns = 0
        self._slow = SlowClock()
        self._recent: deque[tuple[int, int]] = deque()  # the same of the last WINDOW_NS, the latter growing
        self._first_ns: int | None = None  # arrival
        self._less_late: tuple[int, int] | None = None  # the last frame that showed the stream to be catching up
        self.caught_up = False  # whether the stream tells what is now: before that, its stamps are too young

    def monotonic_ns(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """The frame's time on our clock, never later than its arrival; None if the stream gives no stamp that grows."""
        self._look_whether_caught_up(arrival_ns, arrival_ns - stamp_ns)
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is not None and stamp_ns <= last_ns:
            self._fastest, self._slow = None, SlowClock()
            self._recent.clear()
            return None
        delay_ns = arrival_ns - stamp_ns
        self._slow.take(arrival_ns, delay_ns)
        if self._fastest is None:
            self._began_ns = arrival_ns
        if self._fastest is None or delay_ns <= self._reference_ns(arrival_ns):
            self._fastest = (arrival_ns, delay_ns)
        while self._recent and self._recent[-1][1] >= delay_ns:
            self._recent.pop()
        self._recent.append((arrival_ns, delay_ns))
        while arrival_ns - self._recent[0][0] > WINDOW_NS:
            self._recent.popleft()
        # What waited for seconds is of the offset that the clocks had then.
        return stamp_ns + self._reference_ns(stamp_ns + self._reference_ns(arrival_ns))

    def behind_ns(self, now_ns: int) -> int:
        """By how much even the fastest frame of the last WINDOW_NS came later than the stream once did."""
        if self._fastest is None or now_ns - self._began_ns < WINDOW_NS:
            return 0
        arrival_ns, delay_ns = self._recent[0]
        return delay_ns - self._reference_ns(arrival_ns)

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
        return delay_ns + (now_ns - since_ns) * (DRIFT_PPM + self._slow.ppm) // 1_000_000
