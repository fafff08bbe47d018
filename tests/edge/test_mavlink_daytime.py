"""A clock that is not the autopilot's is told of: receivers judge poses by its stamps."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import pytest

from edge.config import MavlinkSettings
from edge.links.mavlink_station import Station
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect

from .mavlink_peer import CAMERA, Peer, linked, meet

S = 1_000_000_000
ON_TIME: dict[int, float] = {}


def test_a_clock_hours_behind_is_told_to_the_operator() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)

        def hours_later() -> None:
            peer.send(dialect.MAVLink_system_time_message((time.time_ns() + 10_800 * S) // 1000, peer.boot_ms()))

        def says_so(message: Any) -> bool:
            return message.get_type() == "STATUSTEXT" and message.text.startswith("UTC here is 10800.0 s behind")

        text = peer.until(says_so, "text", hours_later)
        assert text.severity == dialect.MAV_SEVERITY_WARNING
        peer.settle(lambda: "utc_ahead_ms" in link.counters(), "count")
        assert link.counters()["utc_ahead_ms"] == pytest.approx(-10_800_000, abs=500)


def told(stamps_ahead_s: Iterable[float | None], late_s: dict[int, float] = ON_TIME) -> list[str]:
    """What is told of an autopilot that says each second that it is so much later than here; None: it says that it does
    not know. `late_s` after it was sent, by second, comes what the line held back."""
    station, mav = Station(MavlinkSettings(), OwnShipBuffer(), CAMERA, RequestQueue()), MAVLink(None, 1, 1)
    now_ns, here_ns, found = time.monotonic_ns(), time.time_ns(), []

    def tell(message: Any, at_ns: int) -> None:
        station.take(FrameReader(datagram=True).feed(message.pack(mav)), 0, at_ns)

    for second, ahead_s in enumerate(stamps_ahead_s):
        sent_ns = now_ns + second * S
        tell(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3), sent_ns)
        its_us = 0 if ahead_s is None else (here_ns + second * S + round(ahead_s * S)) // 1000
        stamp = dialect.MAVLink_system_time_message(its_us, 50_000 + second * 1000)
        arrived_ns = sent_ns + round(late_s.get(second, 0.0) * S)
        tell(stamp, arrived_ns)
        found += station.news(arrived_ns)
    return found


def test_of_a_clock_that_agrees_nothing_is_told() -> None:
    assert told([0.0] * 20) == told([0.6, -0.6] * 10) == []


def test_of_an_autopilot_that_does_not_know_the_time_nothing_is_told() -> None:
    since_start = [time.monotonic() - time.time() + second for second in range(20)]
    assert told([None] * 20) == told(since_start) == []


def test_one_stamp_alone_is_not_believed() -> None:
    assert told([0.0, 0.0, 3_000.0, 0.0, 3_000.0, 3_000.0, 0.0]) == []


def test_a_stamp_that_the_line_held_back_is_not_taken_for_another_time() -> None:
    assert told([0.0] * 20, late_s=dict.fromkeys(range(8, 20), 4.0)) == []


def test_it_is_told_once_and_again_when_it_happens_again_much_later() -> None:
    (once,) = told([-5.0] * 100)
    assert once.startswith("UTC here is 5.0 s ahead of the autopilot's")
    assert len(told([-5.0, -5.0, -5.0, 0.0, 0.0, 0.0] * 8)) == 1, "it goes to and fro"
    assert len(told([-5.0] * 30 + [0.0] * 60 + [5.0] * 30)) == 2
    assert len(told([-5.0] * 10 + [0.0] * 10 + [-3_600.0] * 100)) == 2, "set wrongly within a minute, and left so"


def test_the_difference_is_no_longer_counted_once_the_autopilot_has_rebooted() -> None:
    with linked() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        peer.send(dialect.MAVLink_system_time_message(time.time_ns() // 1000, peer.boot_ms()))
        peer.settle(lambda: "utc_ahead_ms" in link.counters(), "count")
        peer.boot_at_ns = time.monotonic_ns() - 1_000_000
        peer.send(dialect.MAVLink_system_time_message(0, peer.boot_ms()))  # it has no fix yet
        peer.settle(lambda: link.counters()["reboots"] == 1, "reboot")
        peer.settle(lambda: "utc_ahead_ms" not in link.counters(), "the count's end")
