"""The loop's self-reporting: its state in every iteration, changes as events, and a snapshot once a second."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

from edge import clock, threads
from edge.config import HealthSettings, MavlinkSettings
from edge.config_ground import ZenohSettings
from edge.health import Announcer, Health, HealthSnapshot, Reason
from edge.links.outgoing import probable
from edge.outlets import LEVELS, Outlets
from edge.status_board import StatusBoard
from edge.systemd import Notifier
from edge.target_news import TargetNews
from edge.types import Report
from edge.watchdog import Watchdog

log = logging.getLogger(__name__)

SNAPSHOT_PERIOD_NS = 1_000_000_000
LOG_EVERY_N_SNAPSHOTS = 10


class Supervisor:
    """Called only by the loop, in every iteration; feeds the watchdogs, the links, the status board and the log."""

    def __init__(
        self,
        settings: HealthSettings,
        wants_attitude: bool,
        outlets: Outlets,
        board: StatusBoard,
        count: Callable[[], Mapping[str, int]],
        reasons: Callable[[int], tuple[Reason, ...]],
    ) -> None:
        self._outlets = outlets
        self._board = board
        self._count = count
        self._reasons = reasons
        config = board.file.config
        links: dict[str, MavlinkSettings | ZenohSettings] = {"mavlink": config.mavlink, "zenoh": config.zenoh}
        self._age_max_ms = {name: link.max_age_ms for name, link in links.items() if link.enabled}
        self._faults: tuple[Reason, ...] = ()
        self._health = Health(wants_attitude)
        self._announcer = Announcer()
        self._targets = TargetNews()
        self._notifier = Notifier()
        self.watchdog = Watchdog(settings.loop_stuck_s, self._last_words)
        self._threads_wanted: frozenset[str] = frozenset()
        self._snapshot_due_ns = 0
        self._snapshots = 0
        self._flew = False
        self._ended_ns: int | None = None
        self.apply(settings)

    def apply(self, settings: HealthSettings) -> None:
        """Use these limits from now on."""
        self._health.no_frame_ns = round(settings.no_frame_s * 1e9)
        self._latency_max_ms = settings.latency_max_ms

    def ready(self) -> None:
        """The daemon is warmed up: the watched threads running now, and the links', are expected to keep running."""
        self._threads_wanted = threads.running() | self._outlets.threads()
        self._notifier.ready()

    def stopping(self) -> None:
        """The loop has ended: its state then is its last, however long the links take to stop."""
        self._ended_ns = clock.monotonic_ns()
        self._notifier.stopping()
        self._notifier.close()

    def frame_done(self, report: Report, stages_ns: Mapping[str, int]) -> None:
        if not self._flew:
            self._flew = True
            log.info("first frame done, %.0f ms after its exposure", stages_ns["total"] / 1e6)
        # The true size may not be known earlier, for example over zenoh, and may change in flight.
        self._board.image_size_wh = report.image_size_wh
        tracks = tuple(track for track in report.tracks if probable(track, report))
        own = report.own_ship
        placed = own is not None and (own.t_ned_body_m is not None or own.lat_lon_alt is not None)
        self._health.frame_done(report.meta.sequence, stages_ns, tracks, own is not None, clock.monotonic_ns(), placed)
        for level, text in self._targets.words(report):
            log.info("%s", text)
            self._outlets.event(level, text)

    def turn(self) -> None:
        """To be called once per iteration of the loop, with or without a frame."""
        now_ns = clock.monotonic_ns()
        self.watchdog.beat(time.monotonic_ns())
        self._notifier.feed(now_ns)
        self._health.faults = (*self._reasons(now_ns), *self._faults)
        condition = self._health.assess(now_ns)
        self._outlets.set_health(condition)
        if self._announcer.due(condition, now_ns):
            log.log(LEVELS.get(condition.state, logging.INFO), "%s", condition)
            self._outlets.tell(condition)
        if now_ns >= self._snapshot_due_ns:
            self._snapshot_due_ns = now_ns + SNAPSHOT_PERIOD_NS
            self._tell_snapshot()

    def snapshot(self) -> HealthSnapshot:
        now_ns = clock.monotonic_ns() if self._ended_ns is None else self._ended_ns
        return self._health.snapshot(now_ns, self._count(), self._board.facts())

    def _tell_snapshot(self) -> None:
        snapshot = self.snapshot()
        self._faults = self._find_faults(snapshot.time_ns)
        self._board.snapshot = snapshot
        self._outlets.publish_diagnostics(snapshot)
        self._notifier.status(snapshot.brief())
        if self._snapshots % LOG_EVERY_N_SNAPSHOTS == 0:
            log.info("%s", snapshot.brief())
        self._snapshots += 1

    def _find_faults(self, now_ns: int) -> tuple[Reason, ...]:
        ended = sorted(self._threads_wanted - threads.running())
        found = [Reason(f"thread_{name}", f"the {name} thread has ended") for name in ended]
        total = self._health.recent_total_ms(now_ns)
        if self._latency_max_ms is not None and total is not None and total.p95 > self._latency_max_ms:
            found.append(Reason("slow", f"slow: p95 {total.p95:.0f} ms from exposure to the links"))
        for link, limit_ms in self._age_max_ms.items():
            if total is not None and total.p50 > limit_ms:
                # More than half of the poses are withheld although everything else may look healthy.
                text = (
                    f"poses too old to be sent: {total.p50:.0f} ms from the exposure, [{link}] max_age_ms {limit_ms:g}"
                )
                found.append(Reason(f"{link}_too_old", text))
        return tuple(found)

    def _last_words(self, sentence: str) -> None:
        self._notifier.status(sentence)
        self._outlets.last_event(logging.ERROR, sentence)
