"""What the zenoh link sends in lock-step: all of it, however full the line is."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zenoh

from edge import clock
from msgs import topics
from msgs.client import connect
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import make_report, make_track
from .test_zenoh_link import linked

PER_FRAME = {"uav1/target/t0/pose", "uav1/target/t0/odom", "uav1/target/detections", "uav1/tf"}


@pytest.fixture(params=[False, True], ids=["real time", "lock-step"])
def in_lockstep(request: pytest.FixtureRequest) -> Iterator[bool]:
    if request.param:
        clock.step_to(time.monotonic_ns())
    yield request.param
    clock.run_freely()


def test_what_a_player_waits_for_is_never_dropped_and_in_real_time_nothing_is_waited_for(in_lockstep: bool) -> None:
    endpoint = free_endpoint()
    when_full: dict[str, zenoh.CongestionControl] = {}

    def take(sample: zenoh.Sample) -> None:
        row = topics.parse_key(str(sample.key_expr), "uav1")
        if row is not None:
            when_full[topics.topic_name(row[0], "uav1", row[1])] = sample.congestion_control

    with linked(endpoint) as link, connect(endpoint) as session:
        handler = zenoh.handlers.Callback(take, indirect=False)
        session.declare_subscriber("0/uav1/**", handler)
        until(
            lambda: when_full.keys() >= PER_FRAME,
            lambda: link.publish(make_report(make_track(clock.monotonic_ns()))),
            what="a frame's messages",
        )
    expected = zenoh.CongestionControl.BLOCK if in_lockstep else zenoh.CongestionControl.DROP
    assert {name: when_full[name] for name in PER_FRAME} == dict.fromkeys(PER_FRAME, expected)
