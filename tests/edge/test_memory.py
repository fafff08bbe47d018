"""Memory that the daemon no longer uses goes back to the system while it flies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FREED = """
import ctypes, os
from edge.memory import MemoryKeeper
from tests.waiting import until

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def resident_mb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

blocks = [libc.malloc(100_000) for _ in range(1000)]
for block in blocks:
    ctypes.memset(block, 1, 100_000)
for block in blocks[:-1]:  # the last one keeps the heap from shrinking by itself
    libc.free(block)
before_mb = resident_mb()
keeper = MemoryKeeper(period_s=0.01)
keeper.start()
until(lambda: resident_mb() < before_mb - 80.0, what="memory to be returned", within_s=20.0)
keeper.stop()
"""


def test_what_was_freed_below_memory_in_use_is_returned_to_the_system() -> None:
    """In a process of its own, whose heap nobody else cuts up."""
    done = subprocess.run(
        [sys.executable, "-c", FREED], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
