"""How often messages go, for any rhythm of frames."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.links.allowance import Allowance
from edge.links.mavlink_schedule import RESUMED_HZ, Schedule

MESSAGE = 275
GAPS_NS = st.lists(st.integers(1_000_000, 400_000_000), min_size=1, max_size=200)


@given(hz=st.floats(0.5, 50.0), gaps_ns=GAPS_NS)
def test_a_rate_is_never_exceeded_and_kept_where_frames_are_quicker(hz: float, gaps_ns: list[int]) -> None:
    schedule, now_ns, sent_ns = Schedule({MESSAGE: hz}), 0, []
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        if schedule.due(MESSAGE, 0, now_ns):
            sent_ns.append(now_ns)
    interval_ns = 1e9 / hz
    span_ns = now_ns - gaps_ns[0]
    assert len(sent_ns) <= span_ns / interval_ns + 2.2
    # Each waits for its time, and then for the next frame.
    slowest_ns = interval_ns + max(gaps_ns)
    assert len(sent_ns) >= span_ns / slowest_ns - 1
    assert sent_ns[0] == gaps_ns[0], "the first is due at once"


@given(gaps_ns=GAPS_NS)
def test_targets_have_a_rhythm_each_and_off_is_off(gaps_ns: list[int]) -> None:
    schedule, now_ns = Schedule({MESSAGE: 10.0}), 0
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        assert schedule.due(MESSAGE, 0, now_ns) == schedule.due(MESSAGE, 1, now_ns)
        assert not schedule.due(MESSAGE + 1, 0, now_ns), "what is not scheduled never goes"
    schedule.set_rate(MESSAGE, 0.0)
    assert not schedule.due(MESSAGE, 0, now_ns + 10**12)
    schedule.ask_once(MESSAGE, now_ns + 10**12)
    assert [schedule.due(MESSAGE, 0, now_ns + 10**12) for _ in range(2)] == [True, False]
    assert schedule.due(MESSAGE, 1, now_ns + 10**12), "one request is for all targets of a frame"
    assert not schedule.due(MESSAGE, 2, now_ns + 10**12 + 1)
    schedule.set_rate(MESSAGE, None)
    assert schedule.due(MESSAGE, 0, now_ns + 2 * 10**12)


@given(
    at_once=st.integers(1, 20),
    period_ns=st.integers(1_000_000, 10**9),
    gaps_ns=GAPS_NS,
    began_ns=st.integers(0, 10**15),
)
def test_what_is_allowed_is_so_many_at_once_and_one_a_period(
    at_once: int, period_ns: int, gaps_ns: list[int], began_ns: int
) -> None:
    allowance, now_ns = Allowance(at_once, period_ns), began_ns
    assert [allowance.take(now_ns) for _ in range(at_once)] == [True] * at_once
    went = 0
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        went += sum(allowance.take(now_ns) for _ in range(3))
    assert went <= (now_ns - began_ns) / period_ns + 1
    now_ns += (at_once + 1) * period_ns
    assert [allowance.take(now_ns) for _ in range(at_once + 1)] == [True] * at_once + [False]


def sent_in_10_s(schedule: Schedule, from_s: int) -> int:
    return sum(schedule.due(MESSAGE, 0, from_s * 10**9 + ms * 1_000_000) for ms in range(10_000))


def test_what_is_resumed_keeps_its_rate_and_comes_back_at_the_default_where_it_was_off() -> None:
    schedule = Schedule({MESSAGE: 10.0})
    schedule.set_rate(MESSAGE, 2.0)
    schedule.set_rate(MESSAGE, RESUMED_HZ)
    assert 19 <= sent_in_10_s(schedule, 0) <= 21
    schedule.set_rate(MESSAGE, 0.0)
    assert sent_in_10_s(schedule, 10) == 0
    schedule.set_rate(MESSAGE, RESUMED_HZ)
    assert 98 <= sent_in_10_s(schedule, 20) <= 102


def test_a_rate_that_is_raised_holds_from_now_on() -> None:
    schedule = Schedule({MESSAGE: 10.0})
    schedule.set_rate(MESSAGE, 0.1)
    assert schedule.due(MESSAGE, 0, 0)
    schedule.set_rate(MESSAGE, 50.0)
    sent = [ms for ms in range(1, 101) if schedule.due(MESSAGE, 0, ms * 1_000_000)]
    assert 4 <= len(sent) <= 6


@pytest.mark.parametrize("hz", [0.1, 1.0, 2.0, 5.0, 10.0])
@pytest.mark.parametrize("fps", [30, 60, 120, 200])
def test_over_many_frames_a_rate_is_what_was_asked(hz: float, fps: int) -> None:
    schedule = Schedule({MESSAGE: hz})
    frames = round(100 / hz * fps)
    sent = sum(schedule.due(MESSAGE, 0, frame * 1_000_000_000 // fps) for frame in range(frames))
    assert 98 <= sent <= 102
