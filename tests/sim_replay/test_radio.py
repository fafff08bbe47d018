"""Bad radios: what a channel does to packets, and that no late pose is shown as good on any of them."""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_replay.radio.channel import NARROW, OUTAGE, UDP_HEADER_BYTES, Channel, Lane
from sim_replay.radio.fleet import fly_fleet
from sim_replay.radio.rig import Transport
from sim_replay.radio.run import register
from sim_replay.radio.trial import Ledger, Plan, outcome_of, play
from sim_replay.radio.vehicle import content_age_s, range_m

PACKETS = st.lists(st.tuples(st.integers(1, 1400), st.floats(0.0, 0.2)), min_size=1, max_size=60)
CHANNELS = st.builds(
    Channel,
    name=st.just("any"),
    rate_bps=st.floats(1e4, 1e7),
    delay_s=st.floats(0.0, 0.3),
    jitter_s=st.floats(0.0, 0.1),
    loss=st.floats(0.0, 0.5),
)


def times(packets: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """(size, when it is given to the lane)"""
    at = itertools.accumulate(gap_s for _, gap_s in packets)
    return [(size, now_s) for (size, _), now_s in zip(packets, at, strict=True)]


@settings(max_examples=50)
@given(CHANNELS, PACKETS, st.integers(0, 99))
def test_datagrams_keep_their_order_take_at_least_the_delay_and_never_outrun_the_line(
    channel: Channel, packets: list[tuple[int, float]], seed: int
) -> None:
    lane = Lane(channel, seed)
    out = [(size, now_s, lane.datagram(size, now_s)) for size, now_s in times(packets)]
    came = [(size, now_s, due_s) for size, now_s, due_s in out if due_s is not None]
    assert [due_s for *_, due_s in came] == sorted(due_s for *_, due_s in came)
    assert channel.rate_bps is not None
    for size, now_s, due_s in came:
        least_s = channel.delay_s + 8 * (size + UDP_HEADER_BYTES) / channel.rate_bps
        assert least_s <= due_s - now_s + 1e-9
        assert due_s - now_s <= least_s + channel.queue_s + channel.jitter_s + 1e-9
    if came:
        bits = sum(8 * (size + UDP_HEADER_BYTES) for size, *_ in came)
        assert bits / channel.rate_bps <= came[-1][2] - came[0][1] + 1e-9


@settings(max_examples=50)
@given(CHANNELS, PACKETS, st.integers(0, 99))
def test_a_stream_loses_nothing_and_waits_for_what_is_sent_again(
    channel: Channel, packets: list[tuple[int, float]], seed: int
) -> None:
    whole, lossy = (Lane(replace(channel, loss=loss, jitter_s=0.0), seed) for loss in (0.0, channel.loss))
    given_at = times(packets)
    clean_s = [whole.segment(size, now_s) for size, now_s in given_at]
    dues_s = [lossy.segment(size, now_s) for size, now_s in given_at]
    assert dues_s == sorted(dues_s)
    assert all(due_s >= least_s - 1e-9 for due_s, least_s in zip(dues_s, clean_s, strict=True))


def test_the_share_of_packets_lost_is_the_channel_s() -> None:
    lane = Lane(Channel("any", loss=0.05), seed=3)
    lost = sum(lane.datagram(400, float(n)) is None for n in range(10_000))
    assert 400 < lost < 600


@given(st.floats(1.7e9, 1.9e9), st.floats(0.0, 200.0))
def test_a_range_tells_when_its_target_was_exposed(exposed_s: float, age_s: float) -> None:
    assert content_age_s(range_m(exposed_s), exposed_s + age_s) == pytest.approx(age_s, abs=1e-5)


@pytest.mark.parametrize("transport", ["quic", "tls"])
def test_after_an_outage_poses_come_again_and_no_late_one_is_ever_shown(transport: Transport) -> None:
    # Back in 2.0 to 3.3 s over QUIC: a call that begins in the silence is repeated after one second and two more.
    outcome = play(Plan(replace(OUTAGE, outage_s=3.0), transport, "watch", seconds=15.0, fps=10.0, seed=5))
    assert outcome.gap_max_s >= 2.5
    assert outcome.back_s is not None
    assert outcome.shown > 20
    assert outcome.late_shown == 0


def test_on_a_link_that_everything_together_overfills_a_watcher_still_gets_poses_and_none_too_late() -> None:
    outcome = play(Plan(NARROW, "quic", "watch", seconds=6.0, fps=10.0, seed=5))
    assert outcome.delivered > 0.4
    assert outcome.late_shown == 0


def test_a_pose_is_late_by_what_it_tells_and_not_by_its_stamp() -> None:
    now_ns = 1_700_000_000_000_000_000
    ledger = Ledger()
    for sequence, age_s in enumerate((0.1, 0.9, 1.2), start=7):
        ledger.show(range_m(now_ns / 1e9 - age_s), sequence, now_ns)
    outcome = outcome_of(Plan(NARROW, max_age_s=1.0), ledger, 10, 0, None, now_ns / 1e9, 0.0)
    assert (outcome.late_shown, outcome.sent, outcome.delivered) == (1, 4, 0.75)
    assert outcome.age_max_s == pytest.approx(1.2, abs=1e-5)


def test_a_link_that_never_comes_back_has_a_gap_to_the_end() -> None:
    ledger, began_s = Ledger(), 1_700_000_000.0
    for sequence in range(1, 21):
        now_s = began_s + 0.1 * sequence
        ledger.show(range_m(now_s), sequence, round(now_s * 1e9))
    outcome = outcome_of(Plan(OUTAGE, fps=10.0), ledger, 90, 0, began_s + 6.0, began_s + 9.0, 0.0)
    assert outcome.back_s is None
    assert outcome.gap_max_s == pytest.approx(7.0, abs=1e-3)


def test_each_of_several_vehicles_on_one_router_gets_through() -> None:
    outcome = fly_fleet(3, seconds=3.0, fps=10.0)
    assert outcome.delivered_min > 0.8
    assert outcome.late_shown == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--vehicles", "100"], "--vehicles: '100' is not an integer from 1 to 64\n"),
        (["--vehicles", "many"], "--vehicles: 'many' is not an integer from 1 to 64\n"),
        (["--seconds", "long"], "--seconds: 'long' is not a positive number up to 3600\n"),
    ],
)
def test_a_number_of_the_fleet_that_cannot_be_is_told_with_its_limits(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    with pytest.raises(SystemExit):
        parser.parse_args(["fleet", *words])
    assert capsys.readouterr().err.endswith(said)
