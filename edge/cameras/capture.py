"""The capture thread: never blocks on the consumer, keeps only the newest frame, counts what it drops."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

from edge.cameras.reconnect import Reconnect
from edge.cameras.source import Source, SourceLost, wait_until
from edge.cameras.watch import FrameWatch, ModeWatch, RivalWatch, StampWatch
from edge.errors import InputError
from edge.health import Reason
from edge.types import Frame

log = logging.getLogger(__name__)

FROZEN_TOLD_NS = DAMAGED_TOLD_NS = 1_000_000_000
JUMPS_TOLD_S = 5  # how long a jump of the timestamps is reported
JUMPS_KEPT = 1000


class Capture:
    """Owns a source and the thread that reads it. The source may already be open."""

    def __init__(self, source: Source, opened: bool) -> None:
        self._source = source
        self._opened = self._fitted = opened
        self._stop = threading.Event()
        self._fresh = threading.Condition()
        self._newest: Frame | None = None
        self._end: Exception | None = None
        self._last_sequence: int | None = None
        self._counts: Counter[str] = Counter(
            captured=0, dropped=0, dropped_at_source=0, dropped_overtaken=0, frozen=0, time_jumps=0, reconnects=0
        )
        self._watch, self._stamps, self._mode, self._rivals = FrameWatch(), StampWatch(), ModeWatch(), RivalWatch()
        self._unstamped = 0  # the source's count of them with the last frame
        self._frozen_since_ns: int | None = None
        self._frozen_told = False
        self._sound_ns = 0  # time of the last picture that was not damaged, or since when there could be one
        self._damaged_before = 0  # the source's count of damaged ones then
        self._withheld = 0  # repeats of a live camera: frames are numbered without them, so a gap is a drop
        self._jumped_ns: deque[int] = deque(maxlen=JUMPS_KEPT)  # when timestamps jumped, monotonic
        self._lost: str | None = None  # why there is no camera now
        self._link = Reconnect()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    def start(self, _: Callable[[], None] = lambda: None, __: Callable[[], bool] = lambda: False) -> None:
        """Begin to read; `settle` and `stopped` are not used."""
        self._thread.start()

    def newest(self, timeout_s: float) -> Frame | None:
        """The newest frame not yet taken, waiting up to `timeout_s`; None if there is none.

        Raises EndOfStream after the last frame was taken, InputError if the source can never deliver, and any other
        exception that ended the thread: without that the daemon would wait forever.
        """
        with self._fresh:
            self._fresh.wait_for(lambda: self._newest is not None or self._end is not None, timeout_s)
            frame, self._newest = self._newest, None
            if frame is None and self._end is not None:
                raise self._end
            return frame

    def counters(self) -> dict[str, int]:
        """captured; dropped, at the source (if it numbers its frames) or replaced by a newer one before being taken;
        frozen (the same picture again); time_jumps; reconnects; the source's own counters, as camera_NAME.
        """
        with self._fresh:
            return {**self._counts, **{f"camera_{name}": n for name, n in self._source.counts.items()}}

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """Faults of the camera at `now_ns` (monotonic): lost, frozen, all damaged, timestamps that jump or have become
        worse, another size of picture, another publisher. From any thread."""
        found = []
        with self._fresh:
            if self._lost is not None:
                found.append(Reason("camera_lost", f"camera lost: {self._lost}"))
            since_ns = self._frozen_since_ns
            if since_ns is not None and now_ns - since_ns >= FROZEN_TOLD_NS:
                found.append(Reason("camera_frozen", f"camera frozen for {(now_ns - since_ns) / 1e9:.0f} s"))
            sound_ns = now_ns - self._sound_ns
            if self._source.counts.get("damaged", 0) > self._damaged_before and sound_ns >= DAMAGED_TOLD_NS:
                text = f"camera: all pictures damaged for {sound_ns / 1e9:.0f} s; the link loses packets"
                found.append(Reason("camera_damaged", text))
            jumps = sum(now_ns - jumped_ns <= JUMPS_TOLD_S * 1_000_000_000 for jumped_ns in self._jumped_ns)
            if jumps:
                found.append(Reason("camera_stamps", f"camera timestamps jump ({jumps} in {JUMPS_TOLD_S} s)"))
            found += [*self._stamps.reasons(now_ns), *self._mode.reasons(), *self._rivals.reasons(now_ns)]
        return tuple(found)

    def stop(self) -> None:
        """Stop the thread and close the source; waits only briefly for a driver that is stuck in a read."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=1.0)
        if not self._thread.is_alive():
            self._source.close()

    def _run(self) -> None:
        self._count_damage_anew()
        while True:
            try:
                if not self._opened:
                    wait_until(self._link.retry_at_ns, self._stop)
                    self._open()
                    self._opened = self._fitted = True
                    self._count_damage_anew()
                frame = self._source.read(self._stop)
            except SourceLost as error:
                self._lose(error)
            except Exception as end:
                with self._fresh:
                    self._end = end
                    self._fresh.notify_all()
                return
            else:
                self._link = self._link.delivered()
                if self._lives(frame):
                    number, jumps = frame.meta.sequence - self._withheld, self._counts["time_jumps"]
                    self._offer(replace(frame, meta=replace(frame.meta, sequence=number, time_jumps=jumps)))

    def _open(self) -> None:
        """Raises SourceLost, and InputError for a camera that never fitted its intrinsics. One that did may return in
        another mode once, and in its own the next time."""
        try:
            self._source.open()
        except InputError as error:
            if not self._fitted:
                raise
            raise SourceLost(str(error)) from error

    def _lose(self, error: SourceLost) -> None:
        if self._opened:
            self._source.close()
            self._opened = False
        if self._link.failures == 0:
            log.warning("camera lost: %s; trying again", error)
        self._link = self._link.lost(time.monotonic_ns())
        with self._fresh:
            self._counts["reconnects"] += 1
            self._lost = str(error)
            self._frozen_since_ns = None
        self._count_damage_anew()

    def _lives(self, frame: Frame) -> bool:
        """Whether the frame is new; from a live camera, a repeated picture is stale whatever its timestamp."""
        now_ns = time.monotonic_ns()
        jumps, repeats = self._watch.jumps(frame), self._watch.repeats(frame)
        frozen = repeats and self._source.live
        self._count_damage_anew()
        unstamped, self._unstamped = self._unstamped, self._source.counts.get("unstamped", 0)
        with self._fresh:
            if self._source.live:
                self._stamps.take(frame.meta, stamped=self._unstamped == unstamped)
                self._mode.take(frame)
                self._rivals.take(frame.meta, self._source.counts.get("other_publisher", 0))
            self._counts["time_jumps"] += jumps
            self._counts["frozen"] += repeats
            self._lost = None
            if jumps:
                self._jumped_ns.append(now_ns)
            if not frozen:
                self._frozen_since_ns, self._frozen_told = None, False
            elif self._frozen_since_ns is None:
                self._frozen_since_ns = now_ns
            self._withheld += frozen
        if jumps and self._counts["time_jumps"] == 1:
            log.warning("the camera's timestamps jump; the first time at frame %d", frame.meta.sequence)
        if frozen and not self._frozen_told and now_ns - (self._frozen_since_ns or now_ns) >= FROZEN_TOLD_NS:
            log.warning("the camera has sent the same picture for a second: it is frozen")
            self._frozen_told = True
        return not frozen

    def _count_damage_anew(self) -> None:
        with self._fresh:
            self._sound_ns, self._damaged_before = time.monotonic_ns(), self._source.counts.get("damaged", 0)

    def _offer(self, frame: Frame) -> None:
        with self._fresh:
            last = self._last_sequence
            missed = frame.meta.sequence - last - 1 if last is not None else frame.meta.sequence
            overtaken = 1 if self._newest is not None else 0
            self._counts["captured"] += 1
            self._counts["dropped"] += max(missed, 0) + overtaken
            self._counts["dropped_at_source"] += max(missed, 0)
            self._counts["dropped_overtaken"] += overtaken
            self._last_sequence = frame.meta.sequence
            self._newest = frame
            self._fresh.notify_all()
