"""How a test waits for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

WITHIN_S = 60.0  # what a test waits for takes well under a second, but the machine may be busy
LOOK_EVERY_S = 0.01


def until(
    condition: Callable[[], object],
    act: Callable[[], object] | None = None,
    *,
    what: str = "a condition",
    within_s: float = WITHIN_S,
) -> None:
    """Return once `condition` holds, acting before each further look. Fails, naming `what`, after `within_s`."""
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"waited {within_s:.0f} s in vain for {what}"
        if act is not None:
            act()
        time.sleep(LOOK_EVERY_S)


def runs(pid: int) -> bool:
    """Whether the process has not ended; one that nobody has waited for yet has (Linux: state Z of /proc/PID/stat)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
