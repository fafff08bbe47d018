"""Returns freed memory to the system. glibc keeps it, in a pool for each of up to 8 threads a core: over hours, and
reload by reload, the process would grow by what it does not use."""

from __future__ import annotations

import ctypes
import threading
from contextlib import suppress

PERIOD_S = 600.0


def return_memory() -> None:
    """Once, from any thread: allocations of the others wait for the pool that is being looked through."""
    with suppress(OSError, AttributeError):  # a C library without this function
        ctypes.CDLL(None).malloc_trim(0)


class MemoryKeeper:
    """A thread that does so periodically, from `start` to `stop`. Not at a lower priority: a busy host could then
    suspend it while it holds a pool that the loop needs."""

    def __init__(self, period_s: float = PERIOD_S) -> None:
        self._period_s = period_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="memory", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _keep(self) -> None:
        while not self._stopping.wait(self._period_s):
            return_memory()
