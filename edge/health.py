"""How the daemon is: one state with its reasons, counters, and how long each stage takes. Single-threaded."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from edge.types import Track, TrackState

WINDOW_FRAMES = 900  # half a minute at 30 frames a second
RATE_OVER_NS = 2_000_000_000
NO_FRAME_NS = 2_000_000_000
DROPS_TOLERATED = 0.1
ANNOUNCE_NS = 1_000_000_000


class HealthState(Enum):
    INIT = "init"  # no frame yet
    SEARCHING = "searching"  # frames, but no target
    TRACKING = "tracking"  # a confirmed target, seen
    COASTING = "coasting"  # confirmed targets, none seen just now
    DEGRADED = "degraded"  # works, but less well than it should: see the reasons
    FAULT = "fault"  # gives nothing: see the reasons


BEST_TO_WORST = (
    HealthState.TRACKING,
    HealthState.COASTING,
    HealthState.SEARCHING,
    HealthState.INIT,
    HealthState.DEGRADED,
    HealthState.FAULT,
)


@dataclass(frozen=True)
class Percentiles:
    """Milliseconds over the last frames."""

    p50: float
    p95: float
    p99: float


@dataclass(frozen=True)
class HealthSnapshot:
    """What goes out once a second."""

    time_ns: int  # monotonic
    state: HealthState
    reasons: tuple[str, ...]
    tracks: int  # confirmed or coasting
    frame_rate_hz: float
    counters: Mapping[str, int]
    latency_ms: Mapping[str, Percentiles]  # by stage (edge.stages.STAGES)
    facts: Mapping[str, str] = field(default_factory=dict)  # what the daemon flies with, e.g. the model's hash

    def brief(self) -> str:
        """For the log each second: state, tracks, rate, latency from exposure to the links, frames dropped."""
        total = self.latency_ms.get("total")
        latency = f", {total.p50:.0f}/{total.p95:.0f}/{total.p99:.0f} ms p50/p95/p99" if total is not None else ""
        return f"{self._head()}{latency}, dropped={self.counters.get('dropped', 0)}"

    def line(self) -> str:
        """All of it, for the log when the daemon stops."""
        latency = " ".join(f"{stage} {p.p50:.1f}/{p.p95:.1f}/{p.p99:.1f}" for stage, p in self.latency_ms.items())
        counters = " ".join(f"{name}={count}" for name, count in self.counters.items() if count)
        return f"{self._head()} | ms p50/p95/p99: {latency or 'none'} | {counters}"

    def _head(self) -> str:
        because = f" ({'; '.join(self.reasons)})" if self.reasons else ""
        return f"{self.state.value}{because} tracks={self.tracks} {self.frame_rate_hz:.1f} Hz"


class Announcer:
    """When a change of state is worth telling an operator: a state that flickers must not flood a telemetry radio.

    A worse state is told at once, a better one when it has lasted ANNOUNCE_NS; never two within that time but for a
    fault.
    """

    def __init__(self) -> None:
        self._told: HealthState | None = None
        self._told_ns = 0
        self._current: HealthState | None = None
        self._since_ns = 0

    def due(self, state: HealthState, now_ns: int) -> bool:
        """Whether to tell `state`, which holds at `now_ns`, now; it then counts as told. Call it at every turn."""
        if state is not self._current:
            self._current, self._since_ns = state, now_ns
        if state is self._told:
            return False
        if self._told is not None and state is not HealthState.FAULT:
            worse = BEST_TO_WORST.index(state) > BEST_TO_WORST.index(self._told)
            if now_ns - (self._told_ns if worse else max(self._told_ns, self._since_ns)) < ANNOUNCE_NS:
                return False
        self._told, self._told_ns = state, now_ns
        return True


def judge(
    tracks: Iterable[Track],
    frame_age_ns: int | None,
    drops_share: float,
    has_attitude: bool,
    wants_attitude: bool,
    no_frame_ns: int = NO_FRAME_NS,
    faults: Sequence[str] = (),
) -> tuple[HealthState, tuple[str, ...]]:
    """The state and its reasons. `frame_age_ns` is None before the first frame; `faults` are what else is less well
    than it should be. Pure."""
    if frame_age_ns is None:
        return HealthState.INIT, ("waiting for the camera", *faults)
    if frame_age_ns > no_frame_ns:
        return HealthState.FAULT, (f"no frame for {frame_age_ns / 1e9:.0f} s", *faults)
    reasons = list(faults)
    if wants_attitude and not has_attitude:
        reasons.append("no own attitude: poses in the camera frame only")
    if drops_share > DROPS_TOLERATED:
        reasons.append(f"{100 * drops_share:.0f} % of frames dropped")
    if reasons:
        return HealthState.DEGRADED, tuple(reasons)
    states = {track.state for track in tracks}
    if TrackState.CONFIRMED in states:
        return HealthState.TRACKING, ()
    return (HealthState.COASTING if TrackState.COASTING in states else HealthState.SEARCHING), ()


class Health:
    """Collects what the loop saw; `assess` and `snapshot` say what it means."""

    def __init__(self, wants_attitude: bool, no_frame_ns: int = NO_FRAME_NS) -> None:
        self._wants_attitude = wants_attitude
        self.no_frame_ns = no_frame_ns
        self.faults: tuple[str, ...] = ()  # what others noticed, told as reasons while it is there
        self._stages_ns: dict[str, deque[int]] = {}
        self._done_ns: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._sequence: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._tracks: tuple[Track, ...] = ()
        self._has_attitude = False
        self._poses = 0

    def frame_done(
        self,
        sequence: int,
        stages_ns: Mapping[str, int],
        tracks: tuple[Track, ...],
        has_attitude: bool,
        now_ns: int,
    ) -> None:
        """Note one frame: its number at the source, the time each stage took, what came out."""
        for stage, duration_ns in stages_ns.items():
            self._stages_ns.setdefault(stage, deque(maxlen=WINDOW_FRAMES)).append(duration_ns)
        self._done_ns.append(now_ns)
        self._sequence.append(sequence)
        self._tracks, self._has_attitude = tracks, has_attitude
        self._poses += sum(track.state is not TrackState.TENTATIVE for track in tracks)

    def assess(self, now_ns: int) -> tuple[HealthState, tuple[str, ...]]:
        frame_age_ns = now_ns - self._done_ns[-1] if self._done_ns else None
        return judge(
            self._tracks,
            frame_age_ns,
            self._drops_share(),
            self._has_attitude,
            self._wants_attitude,
            self.no_frame_ns,
            self.faults,
        )

    def snapshot(
        self, now_ns: int, counters: Mapping[str, int], facts: Mapping[str, str] | None = None
    ) -> HealthSnapshot:
        state, reasons = self.assess(now_ns)
        latency_ms = {stage: percentiles_ms(values) for stage, values in self._stages_ns.items()}
        sure = sum(track.state is not TrackState.TENTATIVE for track in self._tracks)
        counted = {"poses": self._poses, **counters}
        rate_hz = self._frame_rate_hz(now_ns)
        return HealthSnapshot(now_ns, state, reasons, sure, rate_hz, counted, latency_ms, facts or {})

    def _drops_share(self) -> float:
        if len(self._sequence) < 2:
            return 0.0
        produced = self._sequence[-1] - self._sequence[0]
        return 1.0 - (len(self._sequence) - 1) / produced if produced > 0 else 0.0

    def _frame_rate_hz(self, now_ns: int) -> float:
        recent = [done_ns for done_ns in self._done_ns if now_ns - done_ns <= RATE_OVER_NS]
        return (len(recent) - 1) / ((recent[-1] - recent[0]) / 1e9) if len(recent) > 1 else 0.0


def percentiles_ms(durations_ns: Iterable[int]) -> Percentiles:
    """p50, p95 and p99 in milliseconds of at least one duration."""
    p50, p95, p99 = np.percentile(np.fromiter(durations_ns, dtype=np.float64), [50, 95, 99]) / 1e6
    return Percentiles(float(p50), float(p95), float(p99))
