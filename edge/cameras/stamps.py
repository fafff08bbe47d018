"""Which clock a camera's timestamps come from, and a stream's clock relative to ours. Pure."""

from __future__ import annotations

from collections import deque

import numpy as np

DOUBTED_FRAMES = 100  # in a row, all about as old: no backlog is that long, so they are of another clock
BACKLOG_MAX_NS = 30_000_000_000  # longer than a link holds frames back
WINDOW_NS = 5_000_000_000
DRIFT_PPM = 500  # upper limit for the drift between two quartz clocks
# Encoders that count frames instead of time run slow by as much as the sensor does: 1000 ppm if 29.97 Hz is declared as
# 30. Little more is accepted, because a decoder or a link that cannot keep up looks alike, and its frames are stale.
SLOW_MAX_PPM = 2_000
SLOW_WINDOW_NS = 2_500_000_000
SLOW_WINDOWS = 6  # 15 s: within it, an acceptable clock is not late enough to be taken for a backlog
RAMP_OFF_SHARE, RAMP_OFF_NS = 0.05, 3_000_000  # deviation of a ramp from a line: share of its rise, or this if larger
# Frames that were buffered while nobody read arrive faster than they were filmed, each less late than the one before.
CATCHING_UP_NS = 10_000_000
CAUGHT_UP_NS = 500_000_000  # caught up if for this long no frame was less late by CATCHING_UP_NS
CATCHING_UP_MAX_NS = 5_000_000_000  # if it lasts longer, the stream's clock simply runs faster than ours


class StampCheck:
    """Judges whether timestamps are of our clock.

    A timestamp that is too old is not replaced by the arrival time: after a stall the first frames *are* old, and would
    be wrong if treated as new. It is the clock only if frames stay as old: those of a backlog arrive ever less late.
    """

    def __init__(self, age_max_ns: int) -> None:
        self._age_max_ns = age_max_ns
        self._fitted = self._foreign = False
        self._least: tuple[int, int] | None = None  # of the too old: the least age, and when the first such arrived
        self._doubted = 0  # too old ones since then

    def believes(self, stamp_ns: int, arrival_ns: int) -> bool | None:
        """Whether the timestamp is the exposure time of the frame that arrived at `arrival_ns` (monotonic).

        None: it may be that of an old frame, or of another clock: none has matched ours yet. Nothing else tells the
        frame's age, so it must not be used."""
        age_ns = arrival_ns - stamp_ns
        if age_ns < 0:
            return False
        if age_ns <= self._age_max_ns:
            self._fitted, self._foreign, self._least = True, False, None
            return True
        self._foreign = self._foreign or self._is_foreign(age_ns, arrival_ns)
        if self._foreign:
            return False
        return True if self._fitted else None

    def _is_foreign(self, age_ns: int, arrival_ns: int) -> bool:
        if self._least is None or age_ns < self._least[0] - CATCHING_UP_NS:
            self._least, self._doubted = (age_ns, arrival_ns), 0
        self._doubted += 1
        if self._fitted:
            return self._doubted > DOUBTED_FRAMES
        return age_ns > BACKLOG_MAX_NS or arrival_ns - self._least[1] >= CAUGHT_UP_NS


class SlowClock:
    """How much slower a stream's clock runs than ours, in ppm; 0 if that is no more than DRIFT_PPM.

    A backlog adds a step to the delay of the fastest frames, a slow clock adds a ramp: only a ramp that was straight
    over SLOW_WINDOWS is accepted, and kept until the next one. A fast clock needs no correction: its frames become the
    fastest by themselves.
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

    A stream's clock has an arbitrary start, so its offset is taken from the frame with the least delay: additional
    delay of others is jitter of network and decoder, or a backlog, and is removed. The least delay grows only as fast
    as two clocks drift apart, or as the stream's clock was measured to. The delay common to all frames (encoder,
    network, decoder) remains in the timestamp; `latency_ms` subtracts it, if it was measured.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None  # stamp, of the last frame whose stamp increased
        self._back_ns: int | None = None  # stamp of the frame just before, if it did not increase
        self._fastest: tuple[int, int] | None = None  # (arrival, arrival - stamp)
        self._slow = SlowClock()
        self._recent: deque[tuple[int, int]] = deque()  # the same for the last WINDOW_NS, delays increasing
        self._first_ns: int | None = None  # arrival
        self._less_late: tuple[int, int] | None = None  # the last frame that showed the stream to be catching up
        self.caught_up = False  # whether the stream is current; before that, its timestamps are too young

    def monotonic_ns(self, stamp_ns: int, arrival_ns: int) -> int | None:
        """The frame's time on our clock, never later than its arrival; None if the timestamp does not increase.

        A stream whose timestamps increase again from there has started over. A single one that is wrong, as some
        cameras send, changes nothing: frames after it may have been held back, and keep their age.
        """
        self._look_whether_caught_up(arrival_ns, arrival_ns - stamp_ns)
        back_ns, self._back_ns = self._back_ns, None
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            if back_ns is None or stamp_ns <= back_ns:
                self._back_ns = stamp_ns
                return None
            self._fastest, self._slow = None, SlowClock()
            self._recent.clear()
        self._last_ns = stamp_ns
        delay_ns = arrival_ns - stamp_ns
        self._slow.take(arrival_ns, delay_ns)
        if self._fastest is None or delay_ns <= self._reference_ns(arrival_ns):
            self._fastest = (arrival_ns, delay_ns)
        while self._recent and self._recent[-1][1] >= delay_ns:
            self._recent.pop()
        self._recent.append((arrival_ns, delay_ns))
        while arrival_ns - self._recent[0][0] > WINDOW_NS:
            self._recent.popleft()
        # For a frame that was buffered for seconds, the clocks' offset at its own time counts.
        return stamp_ns + self._reference_ns(stamp_ns + self._reference_ns(arrival_ns))

    def behind_ns(self) -> int:
        """How much later even the fastest frame of the last WINDOW_NS was than the least delay: a backlog. To be called
        after `monotonic_ns`."""
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
