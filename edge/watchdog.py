"""Ends the process if its main loop is stuck: a daemon that exits is restarted, a stuck one would stay silent."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger(__name__)

LOOKS_PER_LIMIT = 10
LAST_WORDS_S = 2.0  # at most; depends on how long the links take to send the last event
EXIT_STUCK = 70


class Watchdog:
    """Armed after warm-up, on the monotonic clock. Code that never releases the GIL stops this thread too; then
    systemd's watchdog, fed by the loop only, ends the process. Time during which this thread itself was held up does
    not count: the host was stalled, and a restart would only lose the tracks."""

    def __init__(self, limit_s: float, last_words: Callable[[str], None]) -> None:
        self._limit_ns = round(limit_s * 1e9)
        self._last_words = last_words
        self._beat_ns = 0

    def beat(self, now_ns: int) -> None:
        """The loop has completed an iteration. Costs one assignment."""
        self._beat_ns = now_ns

    @contextmanager
    def armed(self) -> Iterator[None]:
        """Watch the calling thread until the block ends."""
        self._beat_ns = time.monotonic_ns()
        disarmed = threading.Event()
        watched = threading.get_ident()
        thread = threading.Thread(target=self._watch, args=(watched, disarmed), name="watchdog", daemon=True)
        thread.start()
        try:
            yield
        finally:
            disarmed.set()
            thread.join()

    def _watch(self, watched: int, disarmed: threading.Event) -> None:
        period_ns = self._limit_ns // LOOKS_PER_LIMIT
        beat_ns, held_up_ns, looked_ns = self._beat_ns, 0, time.monotonic_ns()
        while not disarmed.wait(period_ns / 1e9):
            now_ns = time.monotonic_ns()
            if self._beat_ns != beat_ns:
                beat_ns, held_up_ns = self._beat_ns, 0
            held_up_ns += max(now_ns - looked_ns - period_ns, 0)
            looked_ns = now_ns
            still_ns = now_ns - beat_ns - held_up_ns
            if still_ns > self._limit_ns:
                self._end(f"the main loop has stood still for {still_ns / 1e9:.1f} s {_place(watched)}: ending")

    def _end(self, sentence: str) -> None:
        log.critical("%s", sentence)
        # A link that hangs together with the loop must not prevent the process from ending.
        last_words = [
            threading.Thread(target=self._last_words, args=(sentence,), daemon=True),
            threading.Thread(target=logging.shutdown, daemon=True),
        ]
        for thread in last_words:
            thread.start()
        for thread in last_words:
            thread.join(LAST_WORDS_S)
        os._exit(EXIT_STUCK)


def _place(thread: int) -> str:
    frame = sys._current_frames().get(thread)
    if frame is None:
        return "somewhere"
    return f"in {frame.f_code.co_name} ({os.path.basename(frame.f_code.co_filename)}:{frame.f_lineno})"
