"""Detects drift in a long flight: memory, descriptors, threads, log, drops, age and poses, early against late. Pure.

The first quarter is left out: caches fill, allocators grow, links come up. The rest is divided into thirds, and the
last is compared with the first. Medians are compared, so that one outlier is no trend; for memory the minimum, which
a leak raises and a temporary allocation for an image does not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msgs.geometry import Array
from sim_replay.pipeline.flight import Flight

WARM_UP_SHARE = 0.25
SAMPLES_MIN = 12  # fewer show no trend
# Three and a half 1080p images: a busy machine holds more of them at once than an idle one, and the
# allocator keeps the memory of the largest number so far.
MEMORY_MB = 22.0
FLOOR_QUANTILE = 0.1
DESCRIPTORS, THREADS = 3.0, 2.0
LOG_BYTES_PER_MINUTE = 6000.0
DROPPED_SHARE = 0.01  # of the frames of a third
AGE_GROWTH, AGE_MS = 0.5, 10.0


@dataclass(frozen=True)
class Trend:
    """One quantity, early and late; `grows` is None if this flight cannot decide it."""

    name: str
    unit: str
    early: float | None
    late: float | None
    allowed: float | None  # the maximum of `late`
    grows: bool | None


def trends(flight: Flight, fps: float) -> list[Trend]:
    """All of them, from SAMPLES_MIN samples or more.

    Age and drops are not judged if the daemon waited for other processes longer than it ran itself.
    """
    samples = flight.usage
    times_ns = np.array([sample.time_ns for sample in samples])
    early, late = _thirds(times_ns)
    third_min = (early[1] - early[0]) / 60e9

    def medians(values: Sequence[float], times: Array) -> tuple[float | None, float | None]:
        return _within(np.median, values, times, early), _within(np.median, values, times, late)

    resident_mb = [sample.rss_mb for sample in samples]
    memory = (_within(_floor, resident_mb, times_ns, early), _within(_floor, resident_mb, times_ns, late))
    descriptors = medians([sample.descriptors for sample in samples], times_ns)
    threads = medians([sample.threads for sample in samples], times_ns)
    log_times = np.array([heard_ns for heard_ns, _ in flight.logged])
    logged = [_within(np.sum, [size for _, size in flight.logged], log_times, part) or 0.0 for part in (early, late)]
    per_minute = (logged[0] / third_min, logged[1] / third_min)
    busy = samples[-1].waited_s - samples[0].waited_s > samples[-1].cpu_s - samples[0].cpu_s
    drops = tuple(_dropped(flight, part) for part in (early, late))
    ages_ms, age_times = _ages_ms(flight)
    age = medians(ages_ms, age_times)
    frames = third_min * 60.0 * fps
    return [
        _trend("memory", "MB", memory, lambda value: value + MEMORY_MB),
        _trend("open descriptors", "", descriptors, lambda value: value + DESCRIPTORS),
        _trend("threads", "", threads, lambda value: value + THREADS),
        _trend("log", "bytes/min", per_minute, lambda value: 2.0 * value + LOG_BYTES_PER_MINUTE),
        _trend("frames dropped", "", drops, lambda value: 2.0 * value + DROPPED_SHARE * frames, judged=not busy),
        _trend("age at the autopilot, p50", "ms", age, lambda a: (1 + AGE_GROWTH) * a + AGE_MS, judged=not busy),
    ]


def silences(flight: Flight) -> list[str]:
    """A sentence for each peer that received no pose at all, or none late."""
    _, late = _thirds(np.array([sample.time_ns for sample in flight.usage]))
    received = {"autopilot": [record["received_ns"] for record in flight.targets], "subscriber": flight.poses_ns}
    told = []
    for name, times_ns in received.items():
        if not times_ns:
            told.append(f"the {name} received no pose")
        elif max(times_ns) < late[0]:
            after_s = (max(times_ns) - flight.start_at_ns) * 1e-9
            told.append(f"the {name} received {len(times_ns)} poses, the last after {after_s:.0f} s")
    return told


def table(found: Sequence[Trend], minutes: float) -> str:
    """As readable text."""
    words = {True: "GROWS", False: "flat", None: "not judged"}
    lines = [f"{minutes:g} minutes{'':20} {'early':>10} {'late':>10} {'allowed':>10}"]
    for trend in found:
        cells = (("-" if value is None else f"{value:.1f}") for value in (trend.early, trend.late, trend.allowed))
        lines.append(f"{trend.name:30} {' '.join(f'{cell:>10}' for cell in cells)} {trend.unit:9} {words[trend.grows]}")
    return "\n".join(lines)


def _thirds(times_ns: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """The first and the last third after the warm-up, each (from, to)."""
    first, last = float(times_ns[0]), float(times_ns[-1])
    first += WARM_UP_SHARE * (last - first)
    length = (last - first) / 3.0
    return (first, first + length), (last - length, last)


def _floor(values: Array) -> np.floating:
    return np.float64(np.quantile(values, FLOOR_QUANTILE))


def _within(
    of: Callable[[Array], np.floating], values: Sequence[float], times: Array, part: tuple[float, float]
) -> float | None:
    """`of` the values whose times lie in a part; None if there are none."""
    inside = np.array(values, dtype=np.float64)[(times >= part[0]) & (times <= part[1])] if len(values) else np.zeros(0)
    return float(of(inside)) if inside.size else None


def _dropped(flight: Flight, part: tuple[float, float]) -> float | None:
    """Frames dropped in a part, by the daemon's own count."""
    counted = [
        int(record["values"].get("dropped", 0))
        for record in flight.diagnostics
        if part[0] <= record["stamp_utc_ns"] - flight.utc_minus_monotonic_ns <= part[1]
    ]
    return float(counted[-1] - counted[0]) if len(counted) > 1 else None


def _ages_ms(flight: Flight) -> tuple[list[float], Array]:
    """Age of each TARGET_RELATIVE on arrival, and its arrival time."""
    received = np.array([record["received_ns"] for record in flight.targets], dtype=np.float64)
    captured = [record["capture_utc_us"] * 1000 - flight.utc_minus_monotonic_ns for record in flight.targets]
    return [(r["received_ns"] - c) * 1e-6 for r, c in zip(flight.targets, captured, strict=True)], received


def _trend(
    name: str,
    unit: str,
    values: Sequence[float | None],
    allowed: Callable[[float], float],
    judged: bool = True,
) -> Trend:
    early, late = values
    if early is None or late is None:
        return Trend(name, unit, early, late, None, None)
    limit = allowed(early)
    return Trend(name, unit, early, late, limit, late > limit if judged else None)
