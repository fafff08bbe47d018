"""The companion computer's load and memory, as the ground is told: ONBOARD_COMPUTER_STATUS."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from edge.links import computer_status
from edge.links.computer_status import ComputerReader, onboard_computer_status
from edge.links.mavlink_packing import Letter

from .mavlink_peer import Peer, linked, meet, on_the_wire


def test_the_own_computers_load_and_memory_are_told_where_asked_for() -> None:
    with linked(onboard_computer_status=True) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        status = peer.until(
            lambda m: m.get_type() == "ONBOARD_COMPUTER_STATUS" and m.cpu_combined[0] <= 100, "status with a load"
        )
    total_mib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    assert status.ram_total == pytest.approx(total_mib, rel=0.02)
    assert 0 < status.ram_usage < status.ram_total
    assert all(load <= 100 for load in status.cpu_cores[: min(os.cpu_count() or 1, 8)])
    assert abs(status.time_usec * 1e-6 - time.time()) < 60.0
    assert status.fan_speed == [2**15 - 1] * 4, "what is not known says so"


def test_a_load_is_the_share_of_the_time_since_it_was_last_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Linux counts: user, nice, system, idle, waiting for a disk, two kinds of interrupts, stolen."""
    monkeypatch.setattr(computer_status, "PROC", tmp_path)
    monkeypatch.setattr(computer_status, "THERMAL", tmp_path)
    (tmp_path / "meminfo").write_text("MemTotal: 2097152 kB\nMemFree: 1 kB\nMemAvailable: 524288 kB\n")
    (tmp_path / "uptime").write_text("4321.5 8000.0\n")
    (tmp_path / "thermal_zone0").mkdir()
    (tmp_path / "thermal_zone0" / "temp").write_text("47600\n")
    # Since boot, and a second later. The last two are of guests, who are counted as users too.
    before = {
        "cpu": "800 0 100 2100 0 0 0 0 0 0",
        "cpu0": "500 0 100 900 0 0 0 0 0 0",
        "cpu1": "300 0 0 1200 0 0 0 0 0 0",
    }
    now = {
        "cpu": "840 0 110 2240 10 0 0 0 20 0",
        "cpu0": "530 0 110 950 10 0 0 0 20 0",
        "cpu1": "310 0 0 1290 0 0 0 0 0 0",
    }
    reader, told = ComputerReader(), []
    for counts in (before, now):
        (tmp_path / "stat").write_text("".join(f"{name} {count}\n" for name, count in counts.items()) + "ctxt 9\n")
        (status,) = on_the_wire([Letter(onboard_computer_status(reader.read(), 1), 1, 191)])
        told.append((status.cpu_combined[0], status.cpu_cores[:3]))
        assert (status.uptime, status.ram_usage, status.ram_total) == (4_321_500, 1536, 2048)
        assert status.temperature_core[:2] == [48, 127]
    assert told == [(255, [255] * 3), (25, [40, 10, 255])]
