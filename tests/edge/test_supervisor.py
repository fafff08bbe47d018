"""What the loop tells of itself where each part is well and the whole is not."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge import clock
from edge.config import Config, ConfigFile, HealthSettings
from edge.estimator.model import load_model
from edge.health import Activity, Condition, HealthSnapshot, HealthState
from edge.outlets import LEVELS, Outlets
from edge.status_board import StatusBoard
from edge.supervisor import Supervisor
from edge.types import CameraInfo

from .reports import make_report, make_track
from .toy_scene import SIZE_WH, K

AGES = {"mavlink": 200.0, "zenoh": 500.0}  # the defaults
FPS, PERIOD_NS = 25, 40_000_000


def supervised(toy_model: Path, outlets: Outlets, links: dict[str, dict[str, bool]]) -> Supervisor:
    config = Config.model_validate({"camera": {"type": "sequence", "path": "/scene"}, **links})
    board = StatusBoard(
        ConfigFile(Path("c.toml"), "", config), load_model(toy_model, 1), CameraInfo("toy", SIZE_WH, K, 30.0)
    )
    return Supervisor(config.health, True, outlets, board, lambda: {}, lambda _: ())


def after_frames(supervisor: Supervisor, latency_ms: int) -> Condition:
    """What is said after three frames that took so long from their exposure."""
    for index in range(3):
        now_ns = time.monotonic_ns()
        report = make_report(sequence=index, now_ns=now_ns - latency_ms * 1_000_000)
        supervisor.frame_done(report, {"total": latency_ms * 1_000_000})
        supervisor.turn()
    return supervisor.snapshot().condition


@pytest.mark.parametrize(
    ("latency_ms", "links_on", "withheld"),
    [
        (150, {"mavlink", "zenoh"}, set()),
        (300, {"mavlink", "zenoh"}, {"mavlink"}),
        (600, {"mavlink", "zenoh"}, {"mavlink", "zenoh"}),
        (300, {"zenoh"}, set()),
    ],
)
def test_a_camera_so_late_that_its_poses_are_withheld_is_no_good_state(
    toy_model: Path, latency_ms: int, links_on: set[str], withheld: set[str]
) -> None:
    links = {name: {"enabled": name in links_on} for name in AGES}
    supervisor = supervised(toy_model, Outlets(None, None), links)
    condition = after_frames(supervisor, latency_ms)
    assert {reason.kind for reason in condition.reasons} == {f"{link}_too_old" for link in withheld}
    assert (condition.state is HealthState.DEGRADED) == bool(withheld)
    for link in withheld:
        assert f"{latency_ms} ms from the exposure, [{link}] max_age_ms {AGES[link]:g}" in str(condition)


@pytest.mark.parametrize(("latency_ms", "kinds"), [(150, {"slow"}), (50, set())])
def test_slower_than_the_settings_allow_is_no_good_state(toy_model: Path, latency_ms: int, kinds: set[str]) -> None:
    supervisor = supervised(toy_model, Outlets(None, None), {})
    supervisor.apply(HealthSettings(latency_max_ms=100.0))
    condition = after_frames(supervisor, latency_ms)
    assert {reason.kind for reason in condition.reasons} == kinds
    assert (condition.state is HealthState.DEGRADED) == bool(kinds)


def test_what_frames_lack_of_the_own_ship_is_told(toy_model: Path) -> None:
    supervisor, whole = supervised(toy_model, Outlets(None, None), {}), make_report().own_ship
    assert whole is not None
    by_globe, by_ned = replace(whole, t_ned_body_m=None, v_ned_body_mps=None), replace(whole, lat_lon_alt=None)
    nowhere = replace(by_globe, lat_lon_alt=None)
    lacks = [(whole, []), (by_globe, []), (by_ned, []), (nowhere, ["no_position"]), (None, ["no_attitude"])]
    for index, (own_ship, kinds) in enumerate(lacks):
        supervisor.frame_done(replace(make_report(sequence=index), own_ship=own_ship), {"total": 1})
        supervisor.turn()
        assert [reason.kind for reason in supervisor.snapshot().condition.reasons] == kinds


@pytest.mark.parametrize(("no_frame_s", "state"), [(0.5, HealthState.FAULT), (1.5, HealthState.SEARCHING)])
def test_no_frame_for_longer_than_the_settings_allow_is_a_fault(
    toy_model: Path, stepped: int, no_frame_s: float, state: HealthState
) -> None:
    supervisor = supervised(toy_model, Outlets(None, None), {})
    supervisor.apply(HealthSettings(no_frame_s=no_frame_s))
    supervisor.frame_done(make_report(now_ns=stepped), {"total": 10_000_000})
    clock.step_to(stepped + 1_000_000_000)
    assert supervisor.snapshot().condition.state is state


@pytest.mark.parametrize(("score", "activity"), [(0.6, Activity.SEARCHING), (0.9, Activity.TRACKING)])
def test_a_bird_is_not_tracked(toy_model: Path, score: float, activity: Activity) -> None:
    supervisor = supervised(toy_model, Outlets(None, None), {})
    now_ns = time.monotonic_ns()
    supervisor.frame_done(make_report(make_track(now_ns, score=score), now_ns=now_ns), {"total": 10_000_000})
    assert supervisor.snapshot().condition.activity is activity
    assert supervisor.snapshot().tracks == (activity is Activity.TRACKING)


def test_how_long_the_links_take_to_stop_does_not_change_the_last_state(toy_model: Path, stepped: int) -> None:
    supervisor = supervised(toy_model, Outlets(None, None), {})
    clock.step_to(stepped + PERIOD_NS)
    supervisor.frame_done(make_report(now_ns=stepped), {"total": PERIOD_NS})
    last = supervisor.snapshot().condition
    assert last.state is HealthState.SEARCHING
    supervisor.stopping()
    clock.step_to(stepped + 10_000_000_000)
    assert supervisor.snapshot().condition == last


class Kept(Outlets):
    """Keeps the times of what goes out as diagnostics, each turn's state, and the events."""

    def __init__(self) -> None:
        super().__init__(None, None)
        self.times_ns: list[int] = []
        self.states: list[HealthState] = []
        self.events: list[tuple[int, str]] = []

    def publish_diagnostics(self, snapshot: HealthSnapshot) -> None:
        self.times_ns.append(snapshot.time_ns)

    def set_health(self, condition: Condition) -> None:
        self.states.append(condition.state)

    def event(self, level: int, text: str) -> None:
        self.events.append((level, text))

    def tell(self, condition: Condition) -> None:
        self.event(LEVELS.get(condition.state, logging.INFO), str(condition))


def test_each_turn_has_a_state_and_each_change_and_target_is_told_once_to_the_links_and_the_log(
    toy_model: Path, stepped: int, caplog: pytest.LogCaptureFixture
) -> None:
    outlets = Kept()
    supervisor = supervised(toy_model, outlets, {})
    supervisor.apply(HealthSettings(latency_max_ms=100.0))
    caplog.set_level(logging.INFO)
    for turn in range(6 * FPS):  # frames for 2 s, from the third on with a target, then none
        now_ns = stepped + turn * PERIOD_NS
        clock.step_to(now_ns)
        if turn < 2 * FPS:
            tracks = (make_track(now_ns),) if turn >= 2 else ()
            supervisor.frame_done(make_report(*tracks, sequence=turn, now_ns=now_ns), {"total": 10_000_000})
        supervisor.turn()
    S = HealthState
    assert outlets.states == [S.SEARCHING] * 2 + [S.TRACKING] * (4 * FPS - 2) + [S.FAULT] * (2 * FPS)
    told = [
        (logging.INFO, "searching"),
        (logging.INFO, "target 0 acquired at 240 m"),
        (logging.INFO, "tracking"),
        (logging.ERROR, "fault: no frame for 2 s"),
    ]
    assert outlets.events == told
    logged = [(record.levelno, record.getMessage()) for record in caplog.records]
    assert [one for one in logged if one in told] == told
    assert [text for _, text in logged if text.startswith("first frame")] == [
        "first frame done, 10 ms after its exposure"
    ]


def test_counters_and_latency_go_out_each_second_and_to_the_log_each_ten(
    toy_model: Path, stepped: int, caplog: pytest.LogCaptureFixture
) -> None:
    outlets = Kept()
    supervisor = supervised(toy_model, outlets, {})
    caplog.set_level(logging.INFO)
    for frame in range(25 * FPS):  # 25 s
        now_ns = stepped + frame * PERIOD_NS
        clock.step_to(now_ns)
        supervisor.frame_done(make_report(sequence=frame, now_ns=now_ns), {"total": 10_000_000})
        supervisor.turn()
    gaps_ns = np.diff(outlets.times_ns)
    assert len(outlets.times_ns) == 25
    assert np.all(np.abs(gaps_ns - 1_000_000_000) <= PERIOD_NS)
    assert sum("p50/p95/p99" in message for message in caplog.messages) == 3
