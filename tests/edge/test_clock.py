"""The daemon's clocks set against each other."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge import clock
from edge.clock import UtcClock

UTC_AHEAD_NS = 1_700_000_000_000_000_000
READING_NS = 200


@given(
    held_up_ns=st.lists(st.integers(0, 200_000_000), min_size=16, max_size=16),
    at_ease=st.integers(0, 4),
    age_ns=st.integers(-(10**10), 10**10),
)
def test_being_held_up_between_two_readings_falsifies_no_stamp(
    held_up_ns: list[int], at_ease: int, age_ns: int
) -> None:
    now_ns, readings = 10**12, 0

    def read() -> int:
        nonlocal now_ns, readings
        if not 1 + 3 * at_ease <= readings < 1 + 3 * (at_ease + 1):
            now_ns += held_up_ns[min(readings, 15)]
        now_ns += READING_NS
        readings += 1
        return now_ns

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clock, "monotonic_ns", read)
        patch.setattr(clock, "utc_ns", lambda: read() + UTC_AHEAD_NS)
        utc_clock = UtcClock()
        at_ns = now_ns + age_ns
        assert abs(utc_clock.monotonic_ns(at_ns + UTC_AHEAD_NS) - at_ns) <= 2 * READING_NS
        assert utc_clock.monotonic_ns(utc_clock.utc_ns(at_ns)) == at_ns


@pytest.mark.parametrize("step_ns", [-400_000_000, 300_000_000, -3 * 86_400 * 10**9, 2_000_000])
def test_utc_that_is_set_stamps_the_very_next_frame(monkeypatch: pytest.MonkeyPatch, step_ns: int) -> None:
    now_ns, ahead_ns = 10**12, UTC_AHEAD_NS
    monkeypatch.setattr(clock, "monotonic_ns", lambda: now_ns)
    monkeypatch.setattr(clock, "utc_ns", lambda: now_ns + ahead_ns)
    utc_clock = UtcClock()
    for _ in range(10):
        assert utc_clock.utc_ns(now_ns) == now_ns + ahead_ns
        now_ns += 33_000_000
    ahead_ns += step_ns
    assert utc_clock.utc_ns(now_ns) == now_ns + ahead_ns
    assert utc_clock.monotonic_ns(now_ns + ahead_ns) == now_ns


def test_being_held_up_is_not_taken_for_utc_that_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns, held_up_ns = 10**12, 0

    def read() -> int:
        nonlocal now_ns
        now_ns += READING_NS + held_up_ns
        return now_ns

    monkeypatch.setattr(clock, "monotonic_ns", read)
    monkeypatch.setattr(clock, "utc_ns", lambda: read() + UTC_AHEAD_NS)
    utc_clock = UtcClock()
    told_ns = utc_clock.utc_ns(0)
    held_up_ns = 150_000_000
    assert utc_clock.utc_ns(0) == told_ns


def test_the_hosts_clocks_agree_with_themselves() -> None:
    before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    told_ns = UtcClock().monotonic_ns(utc_ns)
    assert before_ns - 5_000_000 <= told_ns <= after_ns + 5_000_000
