"""Recording samples as MCAP with the ROS 2 profile: the same CDR bytes as on the wire, under the same topic names.

A separate thread writes; `record` never blocks. New samples are written to disk as a chunk every second, or sooner if
they are many, so a crash loses at most one second; files left unfinished are repaired at the next start. A full disk
stops the recording, never the program.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from msgs import topics
from msgs.mcap_file import McapFile, Publisher
from msgs.recording_store import RecordingLimits, Store, Tell
from msgs.topics import Topic

log = logging.getLogger(__name__)

WAITING_MAX = 4096  # samples buffered while the disk stalls
WAITING_BYTES_MAX = 64 * 1024**2  # images are large
FULL_ENOUGH = 0.25  # share of either limit at which the writer does not wait for the second to end
STANDING_MAX = 256  # bounds memory against fake names
FLUSH_S = 1.0
RETRY_S = 3.0
CLOCK_STEP_NS = 500_000_000  # a larger step of UTC, as by network time, starts a new file
GAPS_S = 10.0  # between two warnings about a disk that is too slow
STOP_TIMEOUT_S = 10.0


@dataclass(frozen=True, eq=False)
class Sample:
    """A sample to be written."""

    topic: Topic
    name: str  # topic name with vehicle and target
    payload: bytes
    log_ns: int  # UTC, when it was recorded
    publish_ns: int  # UTC, when it was put
    clock_ns: int  # UTC minus monotonic clock at the time of recording
    publisher: Publisher | None

    @property
    def monotonic_ns(self) -> int:
        """Time of recording on the monotonic clock."""
        return self.log_ns - self.clock_ns


class Recorder:
    """Writes `<stem>_<number>_<UTC>.mcap` files into a folder; thread-safe.

    `tell(level, text)` receives messages for the operator (levels as in rcl_interfaces/Log), on the recorder's thread;
    they are not logged here.
    """

    def __init__(self, folder: Path, stem: str, limits: RecordingLimits, tell: Tell, *, on: bool = True) -> None:
        self._tell = _harmless(tell)
        self._store = Store(folder, stem, limits, self._tell)
        self._limits = limits
        self._changed = threading.Condition()
        self._waiting: deque[Sample] = deque()
        self._waiting_bytes = 0
        self._in_hand = 0  # samples that the writer has taken and not written yet
        self._overflowed = 0  # lost to a full buffer since the last warning
        self._gaps_due_s = 0.0
        self._standing: dict[tuple[str, Publisher | None], Sample] = {}
        self._counters: Counter[str] = Counter()
        self._wanted = on
        self._stopping = False
        self._woken = False
        self._file: McapFile | None = None
        self._opened_s = 0.0
        self._clock_ns = 0  # of the file's first sample
        self._retry_s = 0.0
        self._failure: str | None = None  # while set, new samples are lost
        self._stopped = False  # as reported: from a failure until samples are written again
        self._holds_samples = False  # whether the file on disk contains samples
        self._thread: threading.Thread | None = None

    @property
    def recording(self) -> bool:
        """Whether samples are being recorded: switched on, and the disk works."""
        with self._changed:
            return self._wanted and self._failure is None and not self._stopping

    def start(self) -> None:
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def record(
        self,
        topic: Topic,
        uav: str,
        target: str | None,
        payload: bytes,
        publish_ns: int,
        publisher: Publisher | None = None,
    ) -> None:
        """Queue a sample for writing if recording is on; never blocks. Dropped and counted if the disk fails."""
        name, log_ns, clock_ns = topics.topic_name(topic, uav, target), time.time_ns(), _utc_ahead_ns()
        sample = Sample(topic, name, payload, log_ns, publish_ns, clock_ns, publisher)
        with self._changed:
            whose = (name, publisher)
            if topic.cache == 1 and (whose in self._standing or len(self._standing) < STANDING_MAX):
                self._standing[whose] = sample
            if not self._wanted or self._stopping:
                return
            full = len(self._waiting) >= WAITING_MAX or self._waiting_bytes + len(payload) > WAITING_BYTES_MAX
            if self._failure is not None or full:
                self._counters["lost"] += 1
                self._overflowed += self._failure is None
            else:
                self._waiting.append(sample)
                self._waiting_bytes += len(payload)
                if self._due():
                    self._changed.notify()

    def switch(self, on: bool) -> None:
        """Begin to record, or end the current file; returns immediately."""
        with self._changed:
            self._wanted = on
            self._woken = True
            self._changed.notify()

    def stop(self) -> None:
        """Write queued samples and close the file. May be called more than once, and without start. What a stalled
        disk has not taken after STOP_TIMEOUT_S is counted as lost."""
        with self._changed:
            self._stopping = self._woken = True
            self._changed.notify()
        if self._thread is None:
            return
        self._thread.join(STOP_TIMEOUT_S)
        self._thread = None
        with self._changed:
            lost = self._in_hand + len(self._waiting)
            if lost:
                self._counters["lost"] += lost
        if lost:
            text = f"recording ended before the disk had taken all: {lost} messages may be lost"
            self._tell(logging.WARNING, text)

    def counters(self) -> dict[str, int]:
        with self._changed:
            return {"recorded": 0, **self._counters}

    def _work(self) -> None:
        began_s = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(self._due, max(0.0, began_s + FLUSH_S - time.monotonic()))
                began_s = time.monotonic()
                self._woken = False
                samples, self._waiting, self._waiting_bytes = self._waiting, deque(), 0
                self._in_hand = len(samples)
                wanted, stopping = self._wanted, self._stopping
                go_on = wanted and not stopping
            self._tell_gaps()
            runs = _between_clock_steps(samples) or [[]]
            while runs:
                try:
                    self._turn(runs[0], go_on or len(runs) > 1)
                except Exception as error:
                    # Usually a full disk; but no error may silently end the recorder thread.
                    self._fail(error, sum(map(len, runs)))
                    break
                runs.pop(0)
            if stopping:
                return
            if self._stopped and not wanted:
                self._forget_failure()

    def _due(self) -> bool:
        """Whether the writer should start before the second has ended."""
        full = len(self._waiting) / WAITING_MAX >= FULL_ENOUGH or self._waiting_bytes / WAITING_BYTES_MAX >= FULL_ENOUGH
        return self._woken or full

    def _tell_gaps(self) -> None:
        now_s = time.monotonic()
        with self._changed:
            if not self._overflowed or now_s < self._gaps_due_s:
                return
            lost, self._overflowed = self._overflowed, 0
        self._gaps_due_s = now_s + GAPS_S
        self._tell(logging.WARNING, f"recording has gaps: the disk is too slow, {lost} messages were lost")

    def _turn(self, samples: list[Sample], go_on: bool) -> None:
        """Write the samples and flush them to disk, which removes them from the list: whatever fails afterwards, they
        are not lost. Start a new file if limits or a clock step require it."""
        if samples and abs(samples[0].clock_ns - self._clock_ns) > CLOCK_STEP_NS:
            self._end_file()
        if samples or (self._failure is not None and go_on):
            self._open(samples)
        if self._file is None:
            return
        for one in samples:
            self._file.write(one.name, one.topic.ros_type, one.payload, one.log_ns, one.publish_ns, one.publisher)
        self._file.flush()
        written = len(samples)
        if written:
            self._holds_samples = True
            with self._changed:
                self._counters["recorded"] += written
                self._in_hand -= written
            samples.clear()
            self._tell_going()
        aged = time.monotonic() - self._opened_s >= self._limits.file_seconds_max
        if not go_on or aged or self._file.size >= self._limits.file_bytes_max:
            self._end_file()
        elif written:
            self._store.make_room()

    def _end_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _open(self, samples: Sequence[Sample]) -> None:
        now_s = time.monotonic()
        if self._file is not None or (self._failure is not None and now_s < self._retry_s):
            return
        self._store.finish_unfinished()
        self._store.make_room()
        self._file = self._store.new_file()
        self._opened_s, self._holds_samples = now_s, False
        self._clock_ns = samples[0].clock_ns if samples else _utc_ahead_ns()
        with self._changed:
            standing = list(self._standing.values())
        # Repeat the latest samples of topics that are sent on change only, so that each file is self-contained.
        began_ns = min((one.log_ns for one in samples), default=time.time_ns())
        for one in standing:
            if one not in samples and (not samples or one.monotonic_ns <= samples[-1].monotonic_ns):
                self._file.write(one.name, one.topic.ros_type, one.payload, began_ns, one.publish_ns, one.publisher)
        if self._failure is not None:
            self._set_failure(None)

    def _forget_failure(self) -> None:
        """Once switched off: the disk may have room again by the time that it is switched on."""
        self._stopped = False
        with self._changed:
            self._failure = None
            self._counters["stopped"] = 0

    def _tell_going(self) -> None:
        """Report recovery only after samples were written: a disk may have room for a file's first bytes only."""
        if not self._stopped:
            return
        self._stopped = False
        with self._changed:
            self._counters["stopped"] = 0
        self._tell(logging.INFO, "recording again")

    def _fail(self, error: Exception, lost: int) -> None:
        """Keep the complete part of the file, report the failure once, and retry later."""
        if self._file is not None:
            file, self._file = self._file, None
            file.abandon()
            if not self._holds_samples:
                with suppress(OSError):
                    file.path.unlink()
        self._retry_s = time.monotonic() + RETRY_S
        first, self._stopped = not self._stopped, True
        reason = error.strerror if isinstance(error, OSError) else repr(error)
        self._set_failure(reason or str(error), lost)
        if first:
            self._tell(logging.ERROR, f"recording stopped: {self._failure}")

    def _set_failure(self, failure: str | None, lost: int = 0) -> None:
        with self._changed:
            self._failure = failure
            if failure is not None:
                self._counters["failures"] += 1
                self._counters["stopped"] = 1
                self._counters["lost"] += lost + len(self._waiting)
                self._in_hand = 0
                self._waiting.clear()
                self._waiting_bytes = 0


def _harmless(tell: Tell) -> Tell:
    """The same, except that what it raises ends no recording."""

    def told(level: int, text: str) -> None:
        try:
            tell(level, text)
        except Exception as error:
            log.warning("this could not be told: %r", error)

    return told


def _utc_ahead_ns() -> int:
    return time.time_ns() - time.monotonic_ns()


def _between_clock_steps(samples: Iterable[Sample]) -> list[list[Sample]]:
    """The samples split at clock steps: in one file, both sides of a step would appear on one timeline."""
    runs: list[list[Sample]] = []
    for sample in samples:
        if not runs or abs(sample.clock_ns - runs[-1][0].clock_ns) > CLOCK_STEP_NS:
            runs.append([])
        runs[-1].append(sample)
    return runs
