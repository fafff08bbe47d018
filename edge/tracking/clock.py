"""The autopilot's clock relative to our monotonic one. Pure: every time is an argument.

TIMESYNC (MAVLink 111): a request has tc1 = 0 and ts1 = our ns; the reply mirrors ts1 and adds the autopilot's ns as
tc1. offset = tc1 - (ts1 + now) / 2, and its error is at most half the round trip.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

SAMPLES = 32  # of which the one with the shortest round trip is used
ASKED_KEPT = 16
ROUND_TRIP_MAX_NS = 200_000_000
JUMP_MIN_NS = 2_000_000  # beyond what round trips and drift explain
JUMP_AGREEING = 3  # samples in a row that must agree on a jump
STEPS_MAX = 3  # more are of a link that brings the autopilot's messages by two ways, with numbers of their own
STEP_MIN_MS = 5  # smaller ones are within the tracker's uncertainty of exposure times
STAMP_FUTURE_MAX_NS = 20_000_000
STAMP_AGE_MAX_NS = 1_000_000_000
QUICKEST_NS = 30_000_000_000  # longer than any backlog of a link lasts
DRIFT = 50e-6  # of two crystals relative to each other: the offset's error grows by it with age
UNSYNCED_STD_S = 0.02  # for the unmeasured minimum delay of a link, which is taken as zero
BOUND_TO_STD = 3.0**-0.5  # of an error distributed uniformly within its bound


@dataclass(frozen=True)
class Sample:
    offset_ns: int  # autopilot minus monotonic
    round_trip_ns: int
    time_ns: int  # of the reply


class TimesyncEstimator:
    """Offset of the autopilot's clock (ns since its boot) from ours, measured by TIMESYNC's two-way exchange."""

    def __init__(self) -> None:
        self.jumps = 0
        self._asked: deque[int] = deque(maxlen=ASKED_KEPT)
        self._samples: deque[Sample] = deque(maxlen=SAMPLES)
        self._suspects: list[Sample] = []

    @property
    def offset_ns(self) -> int | None:
        """Autopilot minus monotonic; None before the first reply."""
        return self._best().offset_ns if self._samples else None

    @property
    def uncertainty_ns(self) -> int | None:
        """Bound of the offset's error: half the best round trip."""
        return self._best().round_trip_ns // 2 if self._samples else None

    def std_s(self, now_ns: int) -> float | None:
        """Standard deviation of the offset now: from the bound at the measurement, the drift since, and how far the
        last reply contradicts it."""
        if not self._samples:
            return None
        best = self._best()
        doubt_ns = abs(self._suspects[-1].offset_ns - best.offset_ns) if self._suspects else 0
        return (BOUND_TO_STD * best.round_trip_ns / 2 + DRIFT * max(now_ns - best.time_ns, 0) + doubt_ns) * 1e-9

    def request(self, now_ns: int) -> int:
        """The ts1 of a new request; its reply is recognised by it."""
        self._asked.append(now_ns)
        return now_ns

    def reply(self, tc1_ns: int, ts1_ns: int, now_ns: int) -> bool:
        """Process a reply; False if it was not requested, if it took too long, or while it may be an outlier."""
        if ts1_ns not in self._asked:
            return False
        self._asked.remove(ts1_ns)
        round_trip_ns = now_ns - ts1_ns
        if not 0 <= round_trip_ns <= ROUND_TRIP_MAX_NS:
            return False
        sample = Sample(tc1_ns - (ts1_ns + now_ns) // 2, round_trip_ns, now_ns)
        if self._samples and _contradict(sample, self._best()):
            return self._suspect(sample)
        self._suspects.clear()
        self._samples.append(sample)
        return True

    def jumped(self) -> None:
        """Discard all samples: the autopilot's clock is known to have jumped."""
        self.jumps += 1
        self.clear()

    def clear(self) -> None:
        """Discard all samples: the autopilot has rebooted."""
        self._asked.clear()
        self._samples.clear()
        self._suspects.clear()

    def _suspect(self, sample: Sample) -> bool:
        if self._suspects and _contradict(sample, self._suspects[-1]):
            self._suspects.clear()
        self._suspects.append(sample)
        if len(self._suspects) < JUMP_AGREEING:
            return False
        self.jumps += 1
        self._samples.clear()
        self._samples.extend(self._suspects)
        self._suspects.clear()
        return True

    def _best(self) -> Sample:
        return min(self._samples, key=lambda s: s.round_trip_ns)


def _contradict(a: Sample, b: Sample) -> bool:
    """Whether the offset has changed between two samples: neither is off by more than half its round trip."""
    bound_ns = (a.round_trip_ns + b.round_trip_ns) / 2 + DRIFT * abs(a.time_ns - b.time_ns)
    return abs(a.offset_ns - b.offset_ns) > bound_ns + JUMP_MIN_NS


class BootClock:
    """The autopilot's boot time to monotonic ns: by TIMESYNC if the stamps fit it, else by the least recent delay.

    The least delay (arrival minus stamp) gives the offset up to the link's minimum delay, which is taken as zero.
    Stamps that fitted TIMESYNC before and are now too old are not of another clock: their messages were delayed.
    """

    def __init__(self, timesync: TimesyncEstimator) -> None:
        self._timesync = timesync
        self._fitted = False
        self._quickest: deque[tuple[int, int]] = deque()  # (arrival, delay) of the last QUICKEST_NS, delays increasing
        self.std_s = UNSYNCED_STD_S  # of the last stamp that was converted

    def monotonic_ns(self, boot_ns: int, arrival_ns: int) -> int:
        """Monotonic time of a timestamp; never later than its arrival."""
        least_delay_ns = self._least_delay_ns(arrival_ns - boot_ns, arrival_ns)
        offset_ns = self._timesync.offset_ns
        if offset_ns is not None:
            synced = boot_ns - offset_ns
            age_ns = arrival_ns - synced
            # Some peers answer TIMESYNC from a clock other than that of their timestamps.
            fits = -STAMP_FUTURE_MAX_NS <= age_ns <= STAMP_AGE_MAX_NS
            self._fitted = self._fitted or fits
            if fits or (self._fitted and age_ns > 0):
                self.std_s = self._timesync.std_s(arrival_ns) or 0.0
                return min(synced, arrival_ns)
        self.std_s = UNSYNCED_STD_S
        return boot_ns + least_delay_ns

    def _least_delay_ns(self, delay_ns: int, arrival_ns: int) -> int:
        while self._quickest and self._quickest[-1][1] >= delay_ns:
            self._quickest.pop()
        self._quickest.append((arrival_ns, delay_ns))
        while arrival_ns - self._quickest[0][0] > QUICKEST_NS:
            self._quickest.popleft()
        return self._quickest[0][1]


class RebootDetector:
    """Whether the autopilot has rebooted: its boot time fell by more than late datagrams can explain."""

    REORDER_MAX_MS = 2000

    def __init__(self) -> None:
        self._latest_ms: int | None = None

    def rebooted(self, boot_ms: int) -> bool:
        fell = self._latest_ms is not None and boot_ms < self._latest_ms - self.REORDER_MAX_MS
        if fell or self._latest_ms is None or boot_ms > self._latest_ms:
            self._latest_ms = boot_ms
        return fell


class StepDetector:
    """Whether the autopilot's clock was set back: of two messages of a kind, the one sent later has the earlier time.

    Which one was sent later is told by the sequence numbers of MAVLink's headers: a late datagram has both earlier.
    """

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, int]] = {}  # by message id: sequence number, ms
        self._steps = 0

    def set_back(self, message_id: int, sequence: int, boot_ms: int) -> bool:
        last, self._last[message_id] = self._last.get(message_id), (sequence, boot_ms)
        back = last is not None and 0 < (sequence - last[0]) % 256 < 128 and boot_ms <= last[1] - STEP_MIN_MS
        if back:
            self._steps += 1
            self._last = {message_id: (sequence, boot_ms)}  # the other kinds' are of the clock before: one step, once
        return back and self._steps <= STEPS_MAX
