"""Compares a flight with the budgets. Pure functions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from edge.config import MavlinkSettings
from edge.health import WINDOW_FRAMES
from edge.stages import STAGES
from sim_replay.pipeline.flight import Flight

SETTLE_S = 1.0  # after the sequence restarts: the target has jumped and must be re-acquired
FLAT_FROM_MINUTES = 60.0
MINUTE_NS = 60_000_000_000
FAST_ABOVE_HZ = 31.0
SENT_MAX_HZ = MavlinkSettings().target_relative_rate_hz
PERCENTS = {"p50": 50, "p95": 95, "p99": 99}


@dataclass(frozen=True)
class Budget:
    """One row of the budget table; `met` is None if this flight cannot decide it."""

    name: str
    limit: float
    value: float | None
    unit: str
    met: bool | None


def report(flight: Flight, fps: float, period_s: float, minutes: float) -> dict[str, Any]:
    """JSON's types; milliseconds, 10^6 bytes, seconds; null where there is no data."""
    latency = mavlink_latency_ms(flight, fps, period_s)
    stages = stage_latency_ms([record["values"] for record in flight.diagnostics], fps)
    counters = last_counters(flight)
    memory = memory_mb(flight)
    cold_start_s = first_pose_s(flight)
    result = {
        "minutes": minutes,
        "fps": fps,
        "captured": counters.get("captured"),
        "dropped": counters.get("dropped"),
        "dropped_tracking": dropped_tracking(flight, counters.get("dropped"), fps, period_s),
        "poses_mavlink": len(flight.targets),
        "poses_zenoh": len(flight.poses_ns),
        "poses_withheld": poses_withheld(flight, fps, period_s),
        **{name: counters.get(name) for name in ("mavlink_tracks_withheld", "zenoh_tracks_withheld")},
        "capture_to_mavlink_ms": latency,
        "stages_ms": stages,
        **cpu(flight, counters.get("captured")),
        "memory_mb": memory,
        "cold_start_s": cold_start_s,
    }
    return {**result, "budgets": [asdict(budget) for budget in budgets(result)]}


def budgets(result: dict[str, Any]) -> list[Budget]:
    """The design's budget table, filled in from one flight."""
    steady = result["capture_to_mavlink_ms"]["steady"]
    memory = result["memory_mb"]
    growth = memory.get("growth_per_hour")
    p50_ms = _budget("capture to MAVLink, tracking, p50", 15.0, steady.get("p50"), "ms")
    fast = result["fps"] > FAST_ABOVE_HZ  # has its own budget, and none for the median
    return [
        *([] if fast else [p50_ms]),
        _budget("capture to MAVLink, tracking, p99", 33.0 if fast else 25.0, steady.get("p99"), "ms"),
        _budget("poses withheld by MAVLink, tracking", 0.0, result["poses_withheld"], ""),
        _budget("inference in the loop, p50 (track)", 8.0, result["stages_ms"].get("inference", {}).get("p50"), "ms"),
        _budget("frames dropped, tracking", 0.0, result["dropped_tracking"], ""),
        _budget("resident memory, largest", 400.0, memory.get("max"), "MB"),
        Budget("resident memory, growth an hour", 1.0, growth, "MB", None)
        if result["minutes"] < FLAT_FROM_MINUTES
        else _budget("resident memory, growth an hour", 1.0, growth, "MB"),
        _budget("cold start to first pose", 3.0, result["cold_start_s"], "s"),
    ]


def _budget(name: str, limit: float, value: float | None, unit: str) -> Budget:
    return Budget(name, limit, value, unit, None if value is None else value <= limit)


def mavlink_latency_ms(flight: Flight, fps: float, period_s: float) -> dict[str, dict[str, float]]:
    """From exposure to arrival at the autopilot: `all`, and `steady` without SETTLE_S after each restart."""
    exposures_utc_ns = [record["capture_utc_us"] * 1000 for record in flight.targets]
    ms = [
        (record["received_ns"] - (utc_ns - flight.utc_minus_monotonic_ns)) * 1e-6
        for record, utc_ns in zip(flight.targets, exposures_utc_ns, strict=True)
    ]
    frames = _frames(flight, exposures_utc_ns, fps)
    steady = [value for value, frame in zip(ms, frames, strict=True) if _is_steady(frame, fps, period_s)]
    return {"all": _percentiles(ms), "steady": _percentiles(steady)}


def dropped_tracking(flight: Flight, dropped: int | None, fps: float, period_s: float) -> int | None:
    """How many of the `dropped` frames, at most, were dropped while tracking: no more than there are frames without a
    pose at the subscriber, from the first that has one to the last, without SETTLE_S after each restart."""
    if not dropped:
        return dropped
    had = set(_frames(flight, flight.poses_utc_ns, fps))
    flown = range(min(had), max(had) + 1) if had else range(0)
    return min(dropped, sum(frame not in had for frame in flown if _is_steady(frame, fps, period_s)))


def poses_withheld(flight: Flight, fps: float, period_s: float) -> int | None:
    """Poses that the subscriber received and the autopilot did not: too old for MAVLink, whose limit is the lower one.
    Latencies do not include them.

    Without SETTLE_S after each restart, where coasting tracks are withheld too; None at a frame rate above that of
    TARGET_RELATIVE. The daemon's own `mavlink_tracks_withheld` also counts unconfirmed tracks.
    """
    if fps > SENT_MAX_HZ:
        return None
    told_utc_ns = [record["capture_utc_us"] * 1000 for record in flight.targets]
    had, told = (Counter(_frames(flight, stamps, fps)) for stamps in (flight.poses_utc_ns, told_utc_ns))
    first, last = min(told, default=0), max(had, default=0)
    if told:  # the daemon's end may have cut off MAVLink a little sooner than zenoh
        last = max(*told, last - round(SETTLE_S * fps))
    flown = range(first, last + 1)
    missed = had - told
    return sum(count for frame, count in missed.items() if frame in flown and _is_steady(frame, fps, period_s))


def _frames(flight: Flight, exposures_utc_ns: Iterable[int], fps: float) -> Iterator[int]:
    """The number of each pose's frame, counted on through the rounds."""
    start_utc_ns = flight.start_at_ns + flight.utc_minus_monotonic_ns
    return (round((utc_ns - start_utc_ns) * 1e-9 * fps) for utc_ns in exposures_utc_ns)


def _is_steady(frame: int, fps: float, period_s: float) -> bool:
    # In frames: as a time, the first of a round may seem to be just before it, by a rounding error or as stamps are of
    # whole microseconds.
    return frame % round(period_s * fps) / fps >= SETTLE_S


def stage_latency_ms(diagnostics: Sequence[dict[str, str]], fps: float) -> dict[str, dict[str, float]]:
    """By stage: the median of the windows' p50, the largest of their p95 and p99.

    `diagnostics` arrive once per second and cover the last WINDOW_FRAMES: only non-overlapping windows count.
    """
    step = max(round(WINDOW_FRAMES / fps), 1)
    windows = list(diagnostics)[::-1][::step]
    found = {}
    for stage in STAGES:
        told = {name: list(_numbers(windows, f"latency_ms/{stage}/{name}")) for name in PERCENTS}
        if all(told.values()):
            found[stage] = {"p50": float(np.median(told["p50"])), "p95": max(told["p95"]), "p99": max(told["p99"])}
    return found


def last_counters(flight: Flight) -> dict[str, int]:
    """The daemon's own, as last received over zenoh."""
    if not flight.diagnostics:
        return {}
    return {name: int(text) for name, text in flight.diagnostics[-1]["values"].items() if text.isdecimal()}


def memory_mb(flight: Flight) -> dict[str, Any]:
    """Resident memory; its growth is the slope of the second half. Empty: too few samples.

    Memory varies by whole images: `floor_by_minute`, 10th percentiles, shows whether it grew by steps or steadily.
    """
    rss = np.array([usage.rss_mb for usage in flight.usage])
    if len(rss) < 4:
        return {}
    half = len(rss) // 2
    hours = np.array([usage.time_ns for usage in flight.usage[half:]]) / 3.6e12
    slope = float(np.polyfit(hours - hours[0], rss[half:], 1)[0])
    minutes = (np.array([usage.time_ns for usage in flight.usage]) - flight.usage[0].time_ns) // MINUTE_NS
    return {
        "first": float(rss[0]),
        "last": float(rss[-1]),
        "max": float(rss.max()),
        "growth_per_hour": slope,
        "floor_by_minute": [float(np.percentile(rss[minutes == minute], 10)) for minute in np.unique(minutes)],
    }


def cpu(flight: Flight, captured: int | None) -> dict[str, float | None]:
    """Cores that the daemon kept busy and cores that it waited for while others had them, on average; processor time
    per frame. Image decoding is included in all of them."""
    if len(flight.usage) < 2:
        return {"cpu_cores": None, "cpu_cores_waited_for": None, "cpu_ms_per_frame": None}
    first, last = flight.usage[0], flight.usage[-1]
    elapsed_s, cpu_s = (last.time_ns - first.time_ns) * 1e-9, last.cpu_s - first.cpu_s
    return {
        "cpu_cores": cpu_s / elapsed_s,
        "cpu_cores_waited_for": (last.waited_s - first.waited_s) / elapsed_s,
        "cpu_ms_per_frame": 1e3 * cpu_s / captured if captured else None,
    }


def first_pose_s(flight: Flight) -> float | None:
    """From the start of the process to ready, and from the first exposure to the first pose at the autopilot."""
    if flight.ready_ns is None or not flight.targets:
        return None
    first_ns = min(record["received_ns"] for record in flight.targets)
    return (flight.ready_ns - flight.started_ns + first_ns - flight.start_at_ns) * 1e-9


def table(result: dict[str, Any]) -> str:
    """As readable text."""
    return "\n".join(_lines(result))


def _lines(result: dict[str, Any]) -> Iterator[str]:
    yield f"{'':40} {'budget':>8} {'value':>8}"
    words = {True: "met", False: "MISSED", None: "not judged"}
    for budget in result["budgets"]:
        value = "-" if budget["value"] is None else f"{budget['value']:.1f}"
        yield f"{budget['name']:40} {budget['limit']:8g} {value:>8} {budget['unit']:3} {words[budget['met']]}"
    yield ""
    yield f"{'latency, ms':40} {'p50':>8} {'p95':>8} {'p99':>8}"
    rows = {f"capture to MAVLink, {name}": ms for name, ms in result["capture_to_mavlink_ms"].items()}
    for name, ms in {**rows, **result["stages_ms"]}.items():
        if ms:
            yield f"{name:40} {ms['p50']:8.2f} {ms['p95']:8.2f} {ms['p99']:8.2f}"
    yield ""
    poses = result["poses_mavlink"]
    yield f"{result['captured']} frames captured, {result['dropped']} dropped; {poses} poses at the autopilot"
    if result["poses_withheld"]:
        yield f"{result['poses_withheld']} more were too old to be sent to it: latencies to MAVLink exclude them"
    if result["cpu_cores"] is not None:
        waited = result["cpu_cores_waited_for"]
        yield f"{result['cpu_cores']:.2f} cores busy, {waited:.2f} waited for while other processes used them"
        if waited > result["cpu_cores"]:
            yield "The machine was busy with other work: latencies and drops are due to its load, not to the daemon."


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {}
    return {name: float(np.percentile(values, percent)) for name, percent in PERCENTS.items()}


def _numbers(records: Iterable[dict[str, str]], key: str) -> Iterator[float]:
    return (float(record[key]) for record in records if key in record)
