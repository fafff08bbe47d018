"""Health of the daemon: one state with its reasons, counters, and the times of the stages. Single-threaded."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from edge.types import Track, TrackState

WINDOW_FRAMES = 900  # of latencies: half a minute at 30 frames a second
RECENT_NS = 3_000_000_000  # period over which faults are judged, so that one that is over soon clears
NO_FRAME_NS = 2_000_000_000
FIRST_FRAME_NS = 10_000_000_000  # time for a stream to open; a camera without a frame by then counts as absent
DROPS_TOLERATED = 0.1
ANNOUNCE_NS = 1_000_000_000


class Activity(Enum):
    """What the loop is doing. From worst to best."""

    WAITING = "waiting"  # for frames
    SEARCHING = "searching"  # frames, but no target
    COASTING = "coasting"  # confirmed targets, but none detected now
    TRACKING = "tracking"  # a confirmed target is detected


class HealthState(Enum):
    """State of the daemon in one word."""

    TRACKING = "tracking"
    COASTING = "coasting"
    SEARCHING = "searching"
    INIT = "init"  # no frame yet
    DEGRADED = "degraded"  # works, but less well than it should: see the reasons, and the activity
    FAULT = "fault"  # no output: see the reasons


_WELL = {
    Activity.TRACKING: HealthState.TRACKING,
    Activity.COASTING: HealthState.COASTING,
    Activity.SEARCHING: HealthState.SEARCHING,
    Activity.WAITING: HealthState.INIT,
}
_ACTIVITIES = tuple(Activity)


@dataclass(frozen=True)
class Reason:
    """One cause of a degraded or fault state."""

    kind: str  # one of a fixed set, for programs
    text: str  # for a person; may contain changing numbers


@dataclass(frozen=True)
class Condition:
    """State and activity of the daemon, with the reasons."""

    state: HealthState
    activity: Activity
    reasons: tuple[Reason, ...] = ()

    @property
    def headline(self) -> str:
        """`degraded, tracking`, or the state alone if it implies the activity."""
        return f"{self.state.value}, {self.activity.value}" if self.state is HealthState.DEGRADED else self.state.value

    @property
    def texts(self) -> tuple[str, ...]:
        return tuple(reason.text for reason in self.reasons)

    def __str__(self) -> str:
        return f"{self.headline}: {'; '.join(self.texts)}" if self.reasons else self.headline

    def same_news(self, other: Condition) -> bool:
        """Whether it is no news after `other`: changed numbers in a reason do not count."""
        return (self.state, self.activity, self._kinds()) == (other.state, other.activity, other._kinds())

    def worse_than(self, other: Condition) -> bool:
        """A worse activity, or an additional reason."""
        less = _ACTIVITIES.index(self.activity) < _ACTIVITIES.index(other.activity)
        return less or bool(self._kinds() - other._kinds())

    def _kinds(self) -> frozenset[str]:
        return frozenset(reason.kind for reason in self.reasons)


@dataclass(frozen=True)
class Percentiles:
    """Milliseconds over the last frames."""

    p50: float
    p95: float
    p99: float


@dataclass(frozen=True)
class HealthSnapshot:
    """The status that is published once a second."""

    time_ns: int  # monotonic
    condition: Condition
    tracks: int  # confirmed or coasting
    frame_rate_hz: float
    counters: Mapping[str, int]
    latency_ms: Mapping[str, Percentiles]  # by stage (edge.stages.STAGES)
    facts: Mapping[str, str] = field(default_factory=dict)  # what the daemon runs with, e.g. the model's hash

    def brief(self) -> str:
        """Short form for the log: state, tracks, rate, latency from exposure to the links, frames dropped."""
        total = self.latency_ms.get("total")
        latency = f", {total.p50:.0f}/{total.p95:.0f}/{total.p99:.0f} ms p50/p95/p99" if total is not None else ""
        return f"{self._head()}{latency}, dropped={self.counters.get('dropped', 0)}"

    def line(self) -> str:
        """All of it, for the log when the daemon stops."""
        latency = " ".join(f"{stage} {p.p50:.1f}/{p.p95:.1f}/{p.p99:.1f}" for stage, p in self.latency_ms.items())
        counters = " ".join(f"{name}={count}" for name, count in self.counters.items() if count)
        return f"{self._head()} | ms p50/p95/p99: {latency or 'none'} | {counters}"

    def _head(self) -> str:
        because = f" ({'; '.join(self.condition.texts)})" if self.condition.reasons else ""
        return f"{self.condition.headline}{because} tracks={self.tracks} {self.frame_rate_hz:.1f} Hz"


class Announcer:
    """When to report a change to the operator: a flickering condition must not flood a telemetry radio.

    A worse condition is reported at once, a better one when it has lasted ANNOUNCE_NS; never two within that time,
    except a fault.
    """

    def __init__(self) -> None:
        self._told: Condition | None = None
        self._told_ns = 0
        self._current: Condition | None = None
        self._since_ns = 0

    def due(self, condition: Condition, now_ns: int) -> bool:
        """Whether to report the condition at `now_ns`; it then counts as reported. Call it in every iteration."""
        if self._current is None or not condition.same_news(self._current):
            self._current, self._since_ns = condition, now_ns
        if self._told is not None:
            if condition.same_news(self._told):
                return False
            since_ns = self._told_ns if condition.worse_than(self._told) else max(self._told_ns, self._since_ns)
            fault = condition.state is HealthState.FAULT is not self._told.state
            if not fault and now_ns - since_ns < ANNOUNCE_NS:
                return False
        self._told, self._told_ns = condition, now_ns
        return True


def judge(
    tracks: Iterable[Track],
    frame_age_ns: int | None,
    drops_share: float,
    has_attitude: bool,
    wants_attitude: bool,
    no_frame_ns: int = NO_FRAME_NS,
    faults: Sequence[Reason] = (),
    waited_ns: int = 0,
    lost_position: bool = False,
) -> Condition:
    """Condition of the daemon. `frame_age_ns`: None before the first frame; `waited_ns`: time waited for that one;
    `faults`: further reasons. Pure."""
    if frame_age_ns is None:
        state = HealthState.INIT if waited_ns <= max(no_frame_ns, FIRST_FRAME_NS) else HealthState.FAULT
        return Condition(state, Activity.WAITING, (Reason("no_camera", "waiting for the camera"), *faults))
    if frame_age_ns > no_frame_ns:
        silent_s = frame_age_ns / 1e9
        silent = Reason("no_frame", f"no frame for {silent_s:.{0 if silent_s >= 1.0 else 1}f} s")
        return Condition(HealthState.FAULT, Activity.WAITING, (silent, *faults))
    reasons = list(faults)
    if wants_attitude and not has_attitude:
        reasons.append(Reason("no_attitude", "no own attitude: poses in the camera frame only"))
    elif lost_position:
        reasons.append(Reason("no_position", "own position lost: targets relative to the own ship only"))
    if drops_share > DROPS_TOLERATED:
        reasons.append(Reason("drops", f"{100 * drops_share:.0f} % of frames dropped"))
    states = {track.state for track in tracks}
    activity = Activity.SEARCHING
    if TrackState.CONFIRMED in states:
        activity = Activity.TRACKING
    elif TrackState.COASTING in states:
        activity = Activity.COASTING
    return Condition(HealthState.DEGRADED if reasons else _WELL[activity], activity, tuple(reasons))


class Health:
    """Collects data from the loop; `assess` and `snapshot` evaluate them."""

    def __init__(self, wants_attitude: bool) -> None:
        self._wants_attitude = wants_attitude
        self.no_frame_ns = NO_FRAME_NS
        self.faults: tuple[Reason, ...] = ()  # found elsewhere, reported as reasons while present
        self._stages_ns: dict[str, deque[int]] = {}
        self._recent: deque[tuple[int, int, int]] = deque()  # done ns, number, total ns
        self._began_ns: int | None = None  # time of the first call
        self._done_ns: int | None = None
        self._tracks: tuple[Track, ...] = ()
        self._has_attitude = self._has_position = self._had_position = False
        self._poses = 0

    def frame_done(
        self,
        sequence: int,
        stages_ns: Mapping[str, int],
        tracks: tuple[Track, ...],
        has_attitude: bool,
        now_ns: int,
        has_position: bool = False,
    ) -> None:
        """Add one frame: its number (a gap is a drop), the times of its stages, and its results."""
        for stage, duration_ns in stages_ns.items():
            self._stages_ns.setdefault(stage, deque(maxlen=WINDOW_FRAMES)).append(duration_ns)
        self._done_ns = now_ns
        self._recent.append((now_ns, sequence, stages_ns["total"]))
        self._tracks, self._has_attitude, self._has_position = tracks, has_attitude, has_position
        self._had_position = self._had_position or has_position
        self._poses += sum(track.state is not TrackState.TENTATIVE for track in tracks)

    def assess(self, now_ns: int) -> Condition:
        self._forget(now_ns)
        if self._began_ns is None:
            self._began_ns = now_ns
        return judge(
            self._tracks,
            None if self._done_ns is None else now_ns - self._done_ns,
            self._drops_share(),
            self._has_attitude,
            self._wants_attitude,
            self.no_frame_ns,
            self.faults,
            now_ns - self._began_ns,
            self._had_position and not self._has_position,
        )

    def snapshot(
        self, now_ns: int, counters: Mapping[str, int], facts: Mapping[str, str] | None = None
    ) -> HealthSnapshot:
        condition = self.assess(now_ns)
        latency_ms = {stage: percentiles_ms(values) for stage, values in self._stages_ns.items()}
        sure = sum(track.state is not TrackState.TENTATIVE for track in self._tracks)
        # Without a camera, the last targets and rate are out of date.
        held, rate_hz = (0, 0.0) if condition.activity is Activity.WAITING else (sure, self._frame_rate_hz())
        counted = {"poses": self._poses, **counters}
        return HealthSnapshot(now_ns, condition, held, rate_hz, counted, latency_ms, facts or {})

    def recent_total_ms(self, now_ns: int) -> Percentiles | None:
        """Latency from exposure to the links over RECENT_NS; None without a frame in that period."""
        self._forget(now_ns)
        return percentiles_ms(total_ns for _, _, total_ns in self._recent) if self._recent else None

    def _forget(self, now_ns: int) -> None:
        while self._recent and now_ns - self._recent[0][0] > RECENT_NS:
            self._recent.popleft()

    def _drops_share(self) -> float:
        if len(self._recent) < 2:
            return 0.0
        produced = self._recent[-1][1] - self._recent[0][1]
        return 1.0 - (len(self._recent) - 1) / produced if produced > 0 else 0.0

    def _frame_rate_hz(self) -> float:
        if len(self._recent) < 2:
            return 0.0
        return (len(self._recent) - 1) / ((self._recent[-1][0] - self._recent[0][0]) / 1e9)


def percentiles_ms(durations_ns: Iterable[int]) -> Percentiles:
    """p50, p95 and p99 in milliseconds of at least one duration."""
    p50, p95, p99 = np.percentile(np.fromiter(durations_ns, dtype=np.float64), [50, 95, 99]) / 1e6
    return Percentiles(float(p50), float(p95), float(p99))
