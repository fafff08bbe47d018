"""How things stand, when clocks are set and history comes late."""

from __future__ import annotations

import dataclasses

import pytest

from msgs import cdr, topics
from msgs.ground.feed import Incoming
from msgs.ground.fleet import Fleet
from msgs.topics import Topic

from ..conftest import pose_now

NOW_NS = 1_700_000_000_000_000_000
S, HOUR_NS = 1_000_000_000, 3_600_000_000_000
GID, OTHER_GID = bytes(range(16)), bytes(range(1, 17))


def incoming(topic: Topic, message: cdr.Payload, number: int, gid: bytes = GID, target: str | None = None) -> Incoming:
    key = topics.publication_key(topic, "uav1", target)
    attachment = topics.attachment(number, NOW_NS, gid)
    return Incoming("uav1", topic, target, key, message.encode(), attachment)


def event(text: str, stamp_ns: int, number: int, gid: bytes = GID) -> Incoming:
    return incoming(topics.EVENTS, cdr.Log(stamp_ns, 20, "uavpose_edge", text), number, gid)


def pose(stamp_ns: int, number: int, z_m: float = 300.0) -> Incoming:
    message = dataclasses.replace(pose_now(z_m), stamp_ns=stamp_ns)
    return incoming(topics.POSE, message, number, target="t0")


def told(fleet: Fleet) -> str:
    (row,) = fleet.rows(NOW_NS)
    return row.event


def test_an_event_after_the_vehicles_clock_was_set_back_is_told() -> None:
    fleet = Fleet()
    assert fleet.take(event("tracking", NOW_NS, 1), NOW_NS) is not None
    assert fleet.take(event("fault: no frame", NOW_NS - HOUR_NS, 2), NOW_NS + S) is not None
    assert told(fleet) == "fault: no frame"


def test_history_that_comes_after_the_present_is_not_news_and_a_restarted_daemons_first_word_is() -> None:
    fleet = Fleet()
    assert fleet.take(event("tracking", NOW_NS, 7), NOW_NS) is not None
    assert fleet.take(event("searching", NOW_NS - S, 6), NOW_NS) is None
    assert told(fleet) == "tracking"
    assert fleet.take(event("init", NOW_NS - HOUR_NS, 1, OTHER_GID), NOW_NS) is not None
    assert told(fleet) == "init"


def test_targets_of_before_our_clock_was_set_back_are_not_shown_for_as_long() -> None:
    fleet = Fleet()
    fleet.take(pose(NOW_NS, 1), NOW_NS)
    assert [len(row.targets) for row in fleet.rows(NOW_NS + S)] == [1]
    (row,) = fleet.rows(NOW_NS - HOUR_NS)
    assert (row.targets, row.pose_rate_hz) == ((), 0.0)


def test_how_fast_a_target_nears_is_not_taken_across_a_clock_that_was_set_back() -> None:
    fleet = Fleet()
    for k in range(20):
        fleet.take(pose(NOW_NS + k * S // 10, k + 1, 300.0 - 2.0 * k), NOW_NS + k * S // 10)
    back_ns = NOW_NS - HOUR_NS
    for k in range(20):
        fleet.take(pose(back_ns + k * S // 10, k + 21, 260.0 - 1.0 * k), back_ns + k * S // 10)
    (row,) = fleet.rows(back_ns + 2 * S)
    assert row.targets[0].closing_mps == pytest.approx(10.0, abs=0.5)
