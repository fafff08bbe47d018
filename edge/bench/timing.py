"""Timed calls, taken in turns, so that other load on the machine affects all of them alike."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

UNTIMED_ROUNDS = 2
LOOK_S, QUIET_WITHIN_S = 0.001, 2.0
WARM_S = 0.02  # by then the kernel has moved threads that began on one core to cores of their own
OUR_THREADS = Path("/proc/self/task")
Key = TypeVar("Key")


@dataclass(frozen=True)
class Milliseconds:
    """Of one call. p10 is the time of the code with the machine to itself, p50 and p99 the times as they occurred.

    `cpu` is the processor time of all its threads until it returns (median), to which other processes do not add.
    """

    p10: float
    p50: float
    p99: float
    cpu: float


def time_in_turns(
    calls: Mapping[Key, Callable[[], object]],
    rounds: int,
    on_round: Callable[[int], None],
    warm: Collection[Key] = (),
) -> dict[Key, Milliseconds]:
    """Each call once per round, in the same order, after UNTIMED_ROUNDS warm-up rounds, and never beside threads of the
    call before. Those of `warm` are first repeated for WARM_S, untimed."""
    durations_ns: dict[Key, list[tuple[int, int]]] = {key: [] for key in calls}
    for turn in range(UNTIMED_ROUNDS + rounds):
        for key, call in calls.items():
            wait_until_quiet()
            if key in warm:
                _repeat(call)
            cpu_start_ns, start_ns = time.process_time_ns(), time.perf_counter_ns()
            call()
            taken_ns = time.perf_counter_ns() - start_ns
            durations_ns[key].append((taken_ns, time.process_time_ns() - cpu_start_ns))
        on_round(turn + 1)
    return {key: _milliseconds(values[UNTIMED_ROUNDS:]) for key, values in durations_ns.items()}


def wait_until_quiet() -> None:
    """Wait until no other thread of this process runs or waits for a processor, at most QUIET_WITHIN_S: those of some
    engines spin for tens of milliseconds after a call, longer beside other load."""
    give_up_s = time.monotonic() + QUIET_WITHIN_S
    time.sleep(LOOK_S)
    while _others_run() and time.monotonic() < give_up_s:
        time.sleep(LOOK_S)


def _others_run() -> bool:
    own = str(threading.get_native_id())
    return any(_runs(thread / "stat") for thread in OUR_THREADS.glob("*") if thread.name != own)


def _runs(stat: Path) -> bool:
    """From proc_pid_stat(5): the state follows the name, which is in parentheses."""
    with suppress(OSError):  # it has ended meanwhile
        return stat.read_text(errors="replace").rpartition(")")[2].split()[0] == "R"
    return False


def _repeat(call: Callable[[], object]) -> None:
    until_s = time.monotonic() + WARM_S
    while time.monotonic() < until_s:
        call()


def _milliseconds(durations_ns: Sequence[tuple[int, int]]) -> Milliseconds:
    """Of (wall, CPU) times."""
    wall_ms, cpu_ms = np.array(durations_ns, dtype=np.float64).T / 1e6
    p10, p50, p99 = np.percentile(wall_ms, [10, 50, 99])
    return Milliseconds(float(p10), float(p50), float(p99), float(np.median(cpu_ms)))
