"""Status of the companion computer: read from Linux, sent as ONBOARD_COMPUTER_STATUS (390)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs.mavlink import dialect

PROC, THERMAL = Path("/proc"), Path("/sys/class/thermal")
CORES_MAX, TEMPERATURES_MAX = 8, 8
UNKNOWN_8, UNKNOWN_INT8, UNKNOWN_INT16, UNKNOWN_32 = 2**8 - 1, 2**7 - 1, 2**15 - 1, 2**32 - 1


@dataclass(frozen=True)
class ComputerStatus:
    uptime_ms: int
    cores_percent: tuple[int, ...]  # busy since the previous reading; empty at the first
    total_percent: int | None
    ram_used_mib: int
    ram_total_mib: int
    temperatures_degc: tuple[int, ...]


class ComputerReader:
    """Loads are averages between two readings. Raises OSError or ValueError if Linux does not provide the data."""

    def __init__(self) -> None:
        self._jiffies: dict[str, tuple[int, int]] = {}  # by core: busy, all

    def read(self) -> ComputerStatus:
        jiffies = _jiffies((PROC / "stat").read_text())
        loads = {name: _percent(self._jiffies[name], now) for name, now in jiffies.items() if name in self._jiffies}
        self._jiffies = jiffies
        memory_kib = dict(_memory_lines((PROC / "meminfo").read_text()))
        uptime_s = float((PROC / "uptime").read_text().split()[0])
        return ComputerStatus(
            round(uptime_s * 1000),
            tuple(load for name, load in loads.items() if name != "cpu"),
            loads.get("cpu"),
            (memory_kib["MemTotal"] - memory_kib["MemAvailable"]) // 1024,
            memory_kib["MemTotal"] // 1024,
            tuple(_temperatures_degc()),
        )


def _temperatures_degc() -> list[int]:
    found = []
    for zone in sorted(THERMAL.glob("thermal_zone*/temp"))[:TEMPERATURES_MAX]:
        try:
            found.append(max(min(round(int(zone.read_text()) / 1000), UNKNOWN_INT8 - 1), -128))
        except (OSError, ValueError):
            continue  # an inactive thermal zone
    return found


def onboard_computer_status(status: ComputerStatus, utc_us: int) -> Any:
    """ONBOARD_COMPUTER_STATUS (390); unknown values are marked by the largest value of their field."""
    total = UNKNOWN_8 if status.total_percent is None else status.total_percent
    return dialect.MAVLink_onboard_computer_status_message(
        utc_us,
        status.uptime_ms % 2**32,
        0,
        _filled(status.cores_percent[:CORES_MAX], CORES_MAX, UNKNOWN_8),
        [total] + [UNKNOWN_8] * 9,
        [UNKNOWN_8] * 4,
        [UNKNOWN_8] * 10,
        UNKNOWN_INT8,
        _filled(status.temperatures_degc, TEMPERATURES_MAX, UNKNOWN_INT8),
        [UNKNOWN_INT16] * 4,
        status.ram_used_mib,
        status.ram_total_mib,
        *([UNKNOWN_32] * 4 for _ in range(3)),
        *([UNKNOWN_32] * 6 for _ in range(5)),
    )


def _filled(values: tuple[int, ...], count: int, unknown: int) -> list[int]:
    return [*values, *[unknown] * (count - len(values))]


def _jiffies(stat: str) -> dict[str, tuple[int, int]]:
    rows = (line.split() for line in stat.splitlines() if line.startswith("cpu"))
    found = {}
    for name, *counts in rows:
        numbers = [int(count) for count in counts[:8]]  # the rest, guest time, is included in user time
        found[name] = (sum(numbers) - numbers[3] - numbers[4], sum(numbers))
    return found


def _percent(before: tuple[int, int], now: tuple[int, int]) -> int:
    elapsed = now[1] - before[1]
    return min(max(round(100 * (now[0] - before[0]) / elapsed), 0), 100) if elapsed > 0 else 0


def _memory_lines(meminfo: str) -> list[tuple[str, int]]:
    rows = (line.split() for line in meminfo.splitlines())
    return [(row[0].rstrip(":"), int(row[1])) for row in rows if len(row) > 1]
