"""Timed calls, taken in turns, so that other load on the machine affects all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

UNTIMED_ROUNDS = 2
Key = TypeVar("Key")


@dataclass(frozen=True)
class Milliseconds:
    """Of one call. p10 is the time of the code with the machine to itself, p50 and p99 the times as they occurred.

    `cpu` is the processor time of all its threads (median), to which other processes do not add.
    """

    p10: float
    p50: float
    p99: float
    cpu: float


def time_in_turns(
    calls: Mapping[Key, Callable[[], object]], rounds: int, on_round: Callable[[int], None]
) -> dict[Key, Milliseconds]:
    """Each call once per round, in the same order, after UNTIMED_ROUNDS warm-up rounds."""
    durations_ns: dict[Key, list[tuple[int, int]]] = {key: [] for key in calls}
    for turn in range(UNTIMED_ROUNDS + rounds):
        for key, call in calls.items():
            cpu_start_ns, start_ns = time.process_time_ns(), time.perf_counter_ns()
            call()
            taken_ns = time.perf_counter_ns() - start_ns
            durations_ns[key].append((taken_ns, time.process_time_ns() - cpu_start_ns))
        on_round(turn + 1)
    return {key: _milliseconds(values[UNTIMED_ROUNDS:]) for key, values in durations_ns.items()}


def _milliseconds(durations_ns: Sequence[tuple[int, int]]) -> Milliseconds:
    """Of (wall, CPU) times."""
    wall_ms, cpu_ms = np.array(durations_ns, dtype=np.float64).T / 1e6
    p10, p50, p99 = np.percentile(wall_ms, [10, 50, 99])
    return Milliseconds(float(p10), float(p50), float(p99), float(np.median(cpu_ms)))
