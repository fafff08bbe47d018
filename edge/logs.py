"""The daemon's log: one line per fault, with repetitions counted; no thread waits for the reader of the log."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import queue
import re
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TextIO

REPEAT_S = 60.0
FAULTS_REMEMBERED = 64
LINES_WAITING = 1000
DRAIN_S = 1.0
FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
JOURNAL_FORMAT = "%(levelname)s %(name)s: %(message)s"  # the journal has a time of its own
# Of syslog.
PRIORITIES = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4}
INFORMATION = 6
# OpenCV and ffmpeg write their own lines, which are not counted: one for each attempt to open a camera, many for each
# corrupted picture. For debugging, set these variables differently.
QUIET = {"OPENCV_LOG_LEVEL": "ERROR", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
_NUMBER = re.compile(r"\d+(\.\d+)?")


class PatientStream(io.TextIOBase):
    """Writes to a stream in its own thread, so that a stalled reader (a journal, a paused terminal, a full pipe) does
    not block the threads that log. Lines are queued meanwhile; if there are too many, the newest are lost."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._waiting: queue.Queue[str | threading.Event] = queue.Queue(LINES_WAITING)
        self._lost = 0  # in total; changed by the writing threads only, so that no count is lost
        threading.Thread(target=self._work, name="log", daemon=True).start()

    def write(self, text: str) -> int:
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self._lost += 1
        return len(text)

    def drain(self) -> None:
        """Return when everything is written, or after DRAIN_S."""
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(written)
            written.wait(DRAIN_S)

    def _work(self) -> None:
        told = 0
        while True:
            line = self._waiting.get()
            if isinstance(line, threading.Event):
                line.set()
                continue
            lost = self._lost - told
            told += lost
            said = f"{lost} lines of the log were lost: nobody read it\n" if lost else ""
            with contextlib.suppress(OSError, ValueError):  # no reader, or the stream is closed
                self._stream.write(said + line)
                self._stream.flush()


@dataclass
class _Fault:
    since_s: float
    last: logging.LogRecord
    repeated: int = 0


class CountingHandler(logging.StreamHandler[TextIO]):
    """Writes a warning or an error at once; repetitions (same logger, level and words, ignoring numbers) only as a
    count after REPEAT_S. Lower levels are written unchanged.

    `now_s` measures the time between them; records' own times are from a clock that may be set back.
    """

    def __init__(self, stream: TextIO, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._now_s = now_s
        self._faults: dict[tuple[str, int, str], _Fault] = {}

    def emit(self, record: logging.LogRecord) -> None:
        now_s = self._now_s()
        for key, fault in list(self._faults.items()):
            if now_s - fault.since_s >= REPEAT_S:
                self._tell_count(fault)
                del self._faults[key]
        if record.levelno >= logging.WARNING:
            key = (record.name, record.levelno, _NUMBER.sub("#", record.getMessage()))
            known = self._faults.get(key)
            if known is not None:
                known.repeated, known.last = known.repeated + 1, record
                return
            if len(self._faults) < FAULTS_REMEMBERED:
                self._faults[key] = _Fault(now_s, record)
        super().emit(record)

    def close(self) -> None:
        for fault in self._faults.values():
            self._tell_count(fault)
        self._faults.clear()
        if isinstance(self.stream, PatientStream):
            self.stream.drain()
        super().close()

    def _tell_count(self, fault: _Fault) -> None:
        if not fault.repeated:
            return
        text = f"{fault.last.getMessage()} ({fault.repeated} more in {REPEAT_S:.0f} s)"
        again = logging.makeLogRecord({**fault.last.__dict__, "msg": text, "args": (), "exc_info": None})
        super().emit(again)


class JournalFormatter(logging.Formatter):
    """Begins each line with its priority, by which `journalctl -p` selects (sd-daemon(3))."""

    def __init__(self) -> None:
        super().__init__(JOURNAL_FORMAT)

    def format(self, record: logging.LogRecord) -> str:
        priority = f"<{PRIORITIES.get(record.levelno, INFORMATION)}>"
        return priority + super().format(record).replace("\n", f"\n{priority}")


def _is_journal(stream: TextIO) -> bool:
    """Whether systemd connected this stream to its journal: it says which one (systemd.exec(5))."""
    try:
        opened = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{opened.st_dev}:{opened.st_ino}"


def set_up_logging() -> None:
    """Log everything from INFO on to standard error. To be called before OpenCV is imported."""
    if sys.stderr is None:  # it was closed: libraries would write to whatever is opened next and takes its number
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = os.fdopen(2, "w", closefd=False)
    for variable, level in QUIET.items():
        os.environ.setdefault(variable, level)
    handler = CountingHandler(PatientStream(sys.stderr))  # type: ignore[arg-type]
    handler.setFormatter(JournalFormatter() if _is_journal(sys.stderr) else logging.Formatter(FORMAT))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
