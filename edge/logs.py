"""The daemon's log: one line a fault, and a count in place of its repetitions."""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TextIO

REPEAT_S = 60.0
FAULTS_REMEMBERED = 64
FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
# OpenCV and ffmpeg write lines of their own, past any counting: one for each try to open a camera, many for each
# picture that a radio spoiled. Whoever looks into a fault sets these variables otherwise.
QUIET = {"OPENCV_LOG_LEVEL": "ERROR", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
_NUMBER = re.compile(r"\d+(\.\d+)?")


@dataclass
class _Fault:
    since_s: float
    last: logging.LogRecord
    repeated: int = 0


class CountingHandler(logging.StreamHandler[TextIO]):
    """Writes a warning or an error at once, the same one (logger, level, words but for their numbers) again only as a
    count after REPEAT_S. What is below a warning is written as it comes.

    `now_s` counts the time between them: not a record's own, which is of a clock that may be set back.
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
        super().close()

    def _tell_count(self, fault: _Fault) -> None:
        if not fault.repeated:
            return
        text = f"{fault.last.getMessage()} ({fault.repeated} more in {REPEAT_S:.0f} s)"
        again = logging.makeLogRecord({**fault.last.__dict__, "msg": text, "args": (), "exc_info": None})
        super().emit(again)


def set_up_logging() -> None:
    """Everything from INFO on to standard error. To be called before OpenCV is imported."""
    for variable, level in QUIET.items():
        os.environ.setdefault(variable, level)
    handler = CountingHandler(sys.stderr)
    logging.basicConfig(level=logging.INFO, format=FORMAT, handlers=[handler])
