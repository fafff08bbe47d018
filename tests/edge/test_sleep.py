"""A computer that sleeps and wakes: by the monotonic clock nothing has grown older meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge import clock
from edge.cameras.source import SourceLost
from edge.cameras.stream import StreamSource
from edge.clock import SLEPT_NS, SleepWatch
from edge.config_camera import StreamCamera
from edge.daemon import Pipeline
from edge.estimator.model import load_model
from edge.types import Estimate, Frame, FrameMeta, TrackState
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .looping import HELD, PERIOD_NS, Gated, frame, looping
from .mavlink_peer import Peer, meet
from .mavlink_peer import linked as mavlink
from .reports import make_report, make_track
from .test_stamps import INTRINSICS, Fed
from .test_zenoh_link import linked as zenoh
from .toy_scene import SIZE_WH, K

HOUR_NS = 3_600_000_000_000
Sleep = Callable[[int], None]


@pytest.fixture
def sleep(monkeypatch: pytest.MonkeyPatch) -> Sleep:
    """Let the computer have slept for so many nanoseconds more."""
    slept_ns = [5 * HOUR_NS]
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns[0])
    return lambda ns: slept_ns.__setitem__(0, slept_ns[0] + ns)


def empty(index: int) -> Frame:
    time_ns = frame(0, HELD).meta.capture_ns + index * PERIOD_NS
    return Frame(FrameMeta(index, time_ns, time_ns), np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8), K)


def hold(loop: Pipeline) -> None:
    """A sure target, and an own attitude that would do for the next frame."""
    for index in range(6):
        loop._process(frame(index, HELD))
    loop._own_ship.add_attitude(empty(5).meta.capture_ns, [1.0, 0.0, 0.0, 0.0], np.zeros(3))


def test_what_was_known_before_the_computer_slept_is_not_told_when_it_wakes(toy_model: Path, sleep: Sleep) -> None:
    with looping(Gated(load_model(toy_model, 1))) as (loop, ear, _):
        hold(loop)
        (track,) = ear.reports[-1].tracks
        assert track.state is TrackState.CONFIRMED
        told = len(ear.reports)
        sleep(HOUR_NS)
        loop._process(empty(6))  # may have waited in the camera's buffer
        assert len(ear.reports) == told
        loop._process(empty(7))
        assert ear.reports[-1].tracks == ()
        assert ear.reports[-1].own_ship is None


def test_a_frame_that_the_computer_slept_over_is_not_told(
    toy_model: Path, sleep: Sleep, monkeypatch: pytest.MonkeyPatch
) -> None:
    gated = Gated(load_model(toy_model, 1))
    with looping(gated) as (loop, ear, _):
        hold(loop)
        told, track = len(ear.reports), gated.track

        def track_asleep(*seen: Any) -> list[Estimate | None]:
            sleep(HOUR_NS)
            return track(*seen)

        monkeypatch.setattr(gated, "track", track_asleep)
        loop._process(frame(6, HELD))
        assert len(ear.reports) == told


def test_a_report_that_the_computer_slept_over_in_a_link_is_not_sent(sleep: Sleep) -> None:
    with mavlink() as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        sleep(HOUR_NS)
        link.publish(make_report(make_track(time.monotonic_ns(), track_id=5)))
        until(lambda: link.counters().get("held_up") == 1, what="withholding")
        link.publish(make_report(make_track(time.monotonic_ns(), track_id=6)))
        assert peer.named("TARGET_RELATIVE").id == 6
    with zenoh(free_endpoint()) as link:
        sleep(HOUR_NS)
        link.publish(make_report(make_track(time.monotonic_ns())))
        until(lambda: link.counters().get("too_late") == 1, what="withholding")
        assert "sent_pose" not in link.counters()
        link.publish(make_report(make_track(time.monotonic_ns())))
        until(lambda: link.counters().get("sent_pose") == 1, what="the next report")


def test_telemetry_that_waited_in_a_socket_while_the_computer_slept_is_not_taken_for_that_of_now(
    toy_model: Path, sleep: Sleep
) -> None:
    """The loop may wake first: what it forgets must not come back from the link's socket."""
    level = Rotation.identity()
    with (
        looping(Gated(load_model(toy_model, 1))) as (loop, _, _),
        mavlink(own_ship=loop._own_ship) as (link, own_ship),
        Peer(link.ports[0]) as peer,
    ):
        meet(link, peer)
        before_ms = peer.boot_ms()
        sleep(HOUR_NS)
        loop._process(empty(0))
        peer.attitude(level, before_ms)
        until(lambda: link.counters().get("received_ATTITUDE_QUATERNION") == 1, what="the attitude of before")
        assert own_ship.at(time.monotonic_ns()) is None
        peer.boot_at_ns -= HOUR_NS
        peer.settle(lambda: own_ship.at(time.monotonic_ns()) is not None, "own attitude", lambda: peer.attitude(level))


def test_what_waited_in_a_stream_while_the_computer_slept_is_not_told_as_that_of_now(
    sleep: Sleep, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server sends on waking what it could not send before: frames an hour old, at the decoder's speed."""
    awake, waited = 60, 30
    arrivals_ns = [*(k * PERIOD_NS for k in range(awake)), *((awake + k / 10) * PERIOD_NS for k in range(waited))]
    times_ns = iter(arrivals_ns)
    monkeypatch.setattr("edge.cameras.live.time", SimpleNamespace(monotonic_ns=lambda: round(next(times_ns))))
    source = StreamSource(StreamCamera(type="stream", url="udp://127.0.0.1:9", intrinsics=INTRINSICS))
    monkeypatch.setattr(source, "_connect", lambda: Fed([k * PERIOD_NS / 1e6 for k in range(awake + waited)]))
    sleep(HOUR_NS)  # before it was opened: nothing had waited
    source.open()
    while source.read(threading.Event()).meta.sequence < awake - 1:
        pass
    sleep(HOUR_NS)
    with pytest.raises(SourceLost, match=r"the computer has slept for 3600\.0 s"):
        source.read(threading.Event())


def test_a_computer_that_is_held_up_has_not_slept(sleep: Sleep) -> None:
    watch, told = SleepWatch(), []
    for ns in (0, SLEPT_NS - 1, -200_000_000, 200_000_000, SLEPT_NS, 0):
        sleep(ns)
        told.append(watch.slept_ns())
    assert told == [0, 0, 0, 0, SLEPT_NS, 0]


def test_this_computer_has_slept_no_longer_than_it_is_up() -> None:
    assert -1_000_000_000 < clock.asleep_ns() < time.clock_gettime_ns(time.CLOCK_BOOTTIME)
