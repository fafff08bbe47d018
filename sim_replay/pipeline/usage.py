"""Resource usage of a process so far, from Linux's /proc."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

_UTIME, _STIME = 11, 12  # of /proc/PID/stat, counted after the command's closing parenthesis


@dataclass(frozen=True)
class Usage:
    time_ns: int  # monotonic
    cpu_s: float  # of all its threads since it started
    waited_s: float  # runnable while other processes had the cores, all its threads
    rss_mb: float  # 10^6 bytes
    descriptors: int  # open
    threads: int


def usage_of(pid: int) -> Usage:
    """Raises OSError if the process no longer exists."""
    proc = Path("/proc") / str(pid)
    fields = (proc / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    pages = int((proc / "statm").read_text(encoding="utf-8").split()[1])
    cpu_s = (int(fields[_UTIME]) + int(fields[_STIME])) / os.sysconf("SC_CLK_TCK")
    tasks = list((proc / "task").iterdir())
    waited_ns = sum(_waited_ns(task) for task in tasks)
    rss_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    descriptors = len(list((proc / "fd").iterdir()))
    return Usage(time.monotonic_ns(), cpu_s, waited_ns * 1e-9, rss_mb, descriptors, len(tasks))


def _waited_ns(task: Path) -> int:
    """0 for a thread that has just ended, or if the kernel keeps no such count."""
    try:
        return int((task / "schedstat").read_text(encoding="utf-8").split()[1])
    except (OSError, IndexError):
        return 0
