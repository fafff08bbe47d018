"""Watchdogs, systemd, stages, the log, the provider: what a stuck or limping daemon does."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import socket
import subprocess
import sys
import threading
import time
import tomllib
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from edge import threads
from edge.config import Config, ConfigFile
from edge.estimator.model import load_model
from edge.estimator.providers import NAMES, choose_provider
from edge.health import FIRST_FRAME_NS, Activity, Condition, Health, HealthState, Reason, judge
from edge.links.mavlink_link import MavlinkLink
from edge.logs import CountingHandler
from edge.outlets import Outlets, start_outlets
from edge.requests import RequestQueue
from edge.stages import STAGES, StageClock
from edge.status_board import StatusBoard
from edge.supervisor import Supervisor
from edge.systemd import Notifier
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, FrameMeta
from msgs import topics
from msgs.cdr import Log
from msgs.client import connect
from sim_replay.ports import free_port
from tests.waiting import until

from .flying import flying, toml, write_swaying_scene
from .toy_scene import K

STICKS_LATER = """
import sys, threading
from pathlib import Path
from edge import cli
from edge.estimator.estimator import Estimator
seen, track = [], Estimator.track
def stand_still(self, *arguments):
    seen.append(1)
    if len(seen) > 25 and Path(sys.argv[-1]).with_name("stick").exists():
        threading.Event().wait()
    return track(self, *arguments)
Estimator.track = stand_still
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_camera_that_never_gave_a_frame_is_a_fault_once_it_has_had_its_time() -> None:
    health = Health(wants_attitude=False)
    health.faults = (Reason("camera_lost", "camera lost: /dev/video0 does not open"),)
    begun = health.assess(5)
    assert (begun.state, begun.activity) == (HealthState.INIT, Activity.WAITING)
    assert health.assess(5 + FIRST_FRAME_NS).state is HealthState.INIT
    late = health.assess(6 + FIRST_FRAME_NS)
    assert (late.state, late.activity) == (HealthState.FAULT, Activity.WAITING)
    assert str(late) == "fault: waiting for the camera; camera lost: /dev/video0 does not open"
    health.no_frame_ns = 2 * FIRST_FRAME_NS
    assert health.assess(6 + FIRST_FRAME_NS).state is HealthState.INIT, "as the settings have it"


def test_a_loop_that_stands_still_ends_the_process_and_starves_systemd(
    tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    words, over = list[str](), threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(0.1)

        def hear() -> None:
            while not over.is_set():
                with contextlib.suppress(TimeoutError):
                    words.append(systemd.recv(4096).decode())

        manager = threading.Thread(target=hear)
        manager.start()
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "300000"}
        port, heard = free_port(), list[str]()
        text = toml(swaying, toy_model, port, "[health]\nloop_stuck_s = 5.0\n")
        try:
            with (
                flying(tmp_path, text, environment, program=("-c", STICKS_LATER)) as flight,
                connect(f"tcp/127.0.0.1:{port}") as ground,
            ):
                hear_event = zenoh.handlers.Callback(lambda s: heard.append(Log.decode(s.payload.to_bytes()).msg))
                ground.declare_subscriber(topics.subscription_key(topics.EVENTS, "uav1"), hear_event)
                (tmp_path / "stick").touch()
                said = flight.until("CRITICAL")
                assert flight.process.wait(timeout=60) == 70
                until(lambda: any("stood still" in text for text in heard), what="the last words on the ground")
        finally:
            over.set()
            manager.join()
    assert "the main loop has stood still for" in said
    assert "in wait (threading.py:" in said
    ready = words.index("READY=1")
    assert "WATCHDOG=1" not in words[:ready]
    assert "WATCHDOG=1" in words[ready:]
    assert any(word.startswith("STATUS=the main loop has stood still") for word in words)
    assert any(word.startswith("STATUS=") and "p50/p95/p99, dropped=" in word for word in words)
    assert "STOPPING=1" not in words
    # Fed every 0.1 s while it turned, 5 s before the end no more: the last word is not that it lives.
    assert words[-1] != "WATCHDOG=1"


FAILS_LATER = """
import sys
from pathlib import Path
from edge import cli
from edge.tracking.tracker import Tracker
update = Tracker.update
def fail(self, *arguments):
    if Path(sys.argv[-1]).with_name("fail").exists():
        raise ArithmeticError("no inverse")
    return update(self, *arguments)
Tracker.update = fail
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("breaks", "why", "code"),
    [("rgb", "rgb/[0-9]+.png is not a readable picture", 2), ("fail", r"an error of its own: Arith.*'no inverse'", 1)],
)
def test_a_daemon_that_cannot_go_on_says_so_to_the_ground(
    breaks: str, why: str, code: int, tmp_path: Path, toy_model: Path
) -> None:
    port, heard, scene = free_port(), list[str](), write_swaying_scene(tmp_path / "scene")
    with (
        flying(tmp_path, toml(scene, toy_model, port), program=("-c", FAILS_LATER)) as flight,
        connect(f"tcp/127.0.0.1:{port}") as ground,
    ):
        hear_event = zenoh.handlers.Callback(lambda s: heard.append(Log.decode(s.payload.to_bytes()).msg))
        ground.declare_subscriber(topics.subscription_key(topics.EVENTS, "uav1"), hear_event)
        if breaks == "fail":
            (tmp_path / "fail").touch()
        for picture in (scene / "rgb").iterdir() if breaks == "rgb" else ():
            picture.write_text("no picture")
        assert flight.process.wait(timeout=60) == code
        until(lambda: any(re.search(f"the daemon ends: .*{why}", text) for text in heard), what="the last words")


def test_a_daemon_told_to_stop_tells_systemd(tmp_path: Path, toy_model: Path, swaying: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind("\0uavpose-" + tmp_path.name)
        systemd.settimeout(20.0)
        environment = {"NOTIFY_SOCKET": "@uavpose-" + tmp_path.name}
        with flying(tmp_path, toml(swaying, toy_model, free_port()), environment) as flight:
            flight.process.terminate()
            word = ""
            while word != "STOPPING=1":
                word = systemd.recv(4096).decode()
                assert word != "WATCHDOG=1"  # systemd asked for none
            assert flight.process.wait(timeout=20) == 0


def test_without_systemd_nothing_is_said_and_nothing_fails() -> None:
    notifier = Notifier({"WATCHDOG_USEC": "soon"})
    notifier.ready()
    notifier.feed(1)
    notifier.close()


def test_systemd_s_watchdog_is_fed_twice_and_more_within_its_time(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "15000000"})
        fed_s = []
        for tenth in range(600):  # the loop turns ten times a second, for a minute
            notifier.feed(10**12 + tenth * 10**8)
            with contextlib.suppress(BlockingIOError):
                assert systemd.recv(100) == b"WATCHDOG=1"
                fed_s.append(tenth / 10)
        notifier.close()
    assert fed_s[0] == 0.0
    gaps_s = [after - before for before, after in pairwise([*fed_s, 60.0])]
    assert max(gaps_s) <= 7.5
    assert len(fed_s) < 60, "not at every turn"


def test_a_watchdog_meant_for_another_process_is_not_fed(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        address = str(tmp_path / "notify")
        notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"})
        notifier.feed(10**12)
        with pytest.raises(BlockingIOError):
            systemd.recv(100)


def test_a_link_whose_thread_has_ended_is_told(toy_model: Path) -> None:
    config = Config.model_validate({"camera": {"type": "sequence", "path": "/x"}, "mavlink": {"enabled": False}})
    camera = CameraInfo("x", (640, 480), K, None)
    board = StatusBoard(ConfigFile(Path("x.toml"), "", config), load_model(toy_model, 1), camera)
    supervisor = Supervisor(config.health, False, Outlets(None, None), board, dict, lambda _: ())
    ends = threading.Event()
    link = threading.Thread(target=ends.wait, name="mavlink")
    link.start()
    supervisor.ready()
    supervisor.turn()
    assert board.snapshot is not None
    assert not any("thread" in text for text in supervisor.snapshot().condition.texts)
    ends.set()
    link.join()
    deadline_s = time.monotonic() + 20
    while "the mavlink thread has ended" not in supervisor.snapshot().condition.texts and time.monotonic() < deadline_s:
        supervisor.turn()
    assert "the mavlink thread has ended" in supervisor.snapshot().condition.texts


def test_a_link_whose_thread_ended_before_the_daemon_was_ready_is_told(
    toy_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread ends as soon as it has started, while the model is still being warmed up."""
    monkeypatch.setattr(MavlinkLink, "_run", lambda _: None)
    text = '[camera]\ntype = "sequence"\npath = "/x"\n[mavlink]\nendpoints = ["udpout:127.0.0.1:14999"]\n'
    config = Config.model_validate(tomllib.loads(text + "[zenoh]\nenabled = false\n"))
    board = StatusBoard(
        ConfigFile(Path("x.toml"), text, config), load_model(toy_model, 1), CameraInfo("x", (640, 480), K, None)
    )
    with ExitStack() as cleanup:
        outlets = start_outlets(board, OwnShipBuffer(), RequestQueue(), lambda: None, cleanup)
        supervisor = Supervisor(config.health, False, outlets, board, dict, lambda _: ())
        until(lambda: "mavlink" not in threads.running())
        supervisor.ready()
        supervisor.turn()
        supervisor.turn()
        assert "the mavlink thread has ended" in supervisor.snapshot().condition.texts


def test_a_camera_that_is_gone_has_no_frame_rate() -> None:
    health, period_ns = Health(wants_attitude=False), 100_000_000
    for sequence in range(20):
        health.frame_done(sequence, {"total": 1}, (), has_attitude=False, now_ns=sequence * period_ns)
    last_ns = 19 * period_ns
    assert health.snapshot(last_ns, {}).frame_rate_hz == pytest.approx(10.0)
    gone = health.snapshot(last_ns + health.no_frame_ns + 1, {})
    assert (gone.condition.state, gone.frame_rate_hz) == (HealthState.FAULT, 0.0)


@pytest.mark.parametrize(
    ("placed", "told"),
    [
        ([False] * 5, []),  # no autopilot that has a position
        ([True] * 5, []),
        ([False, True, True, False], ["own position lost: targets relative to the own ship only"]),
        ([True, False, True], []),
    ],
)
def test_an_own_position_that_was_there_and_is_lost_is_told_of(placed: list[bool], told: list[str]) -> None:
    health, period_ns = Health(wants_attitude=True), 100_000_000
    for k, has_position in enumerate(placed):
        health.frame_done(k, {"total": 1}, (), True, k * period_ns, has_position)
    assert list(health.assess(len(placed) * period_ns).texts) == told
    health.frame_done(len(placed), {"total": 1}, (), False, len(placed) * period_ns)
    (without,) = health.assess(len(placed) * period_ns).reasons
    assert without.kind == "no_attitude", "which says it all"


def test_what_else_is_wrong_degrades_a_daemon_that_tracks() -> None:
    slow = Reason("slow", "slow: p95 90 ms from exposure to the links")
    searching = Condition(HealthState.DEGRADED, Activity.SEARCHING, (slow,))
    assert judge([], 10_000_000, 0.0, True, True, faults=(slow,)) == searching
    assert str(searching) == "degraded, searching: slow: p95 90 ms from exposure to the links"
    assert judge([], 900_000_000, 0.0, True, True, no_frame_ns=500_000_000).state is HealthState.FAULT
    assert judge([], 3_000_000_000, 0.0, True, True).reasons == (Reason("no_frame", "no frame for 3 s"),)
    (soon,) = judge([], 310_000_000, 0.0, True, True, no_frame_ns=300_000_000).reasons
    assert soon.text == "no frame for 0.3 s"
    assert [reason.kind for reason in judge([], 0, 0.3, False, True).reasons] == ["no_attitude", "drops"]


@given(st.lists(st.integers(0, 10**7), min_size=0, max_size=6), st.integers(0, 10**7), st.integers(0, 10**7))
def test_the_stages_of_a_frame_add_up_to_its_whole(steps_ns: list[int], capture_ns: int, wait_ns: int) -> None:
    now_ns = time.monotonic_ns()
    edges = [now_ns - 10**9 + sum(steps_ns[:k]) for k in range(len(steps_ns) + 1)]
    arrival_ns = edges[0] - wait_ns
    clock = StageClock(FrameMeta(0, arrival_ns - capture_ns, arrival_ns), edges[0])
    runs_ns = [(edges[k], edges[k + 1]) for k in range(0, len(edges) - 1, 2)]
    clock.estimated(runs_ns)
    clock.lap("track")
    stages = clock.stages_ns()
    assert set(stages) == set(STAGES) - {"publish"} - (set() if runs_ns else {"inference", "decode"})
    assert sum(ns for stage, ns in stages.items() if stage != "total") == stages["total"]
    assert stages.get("inference", 0) == sum(end - begin for begin, end in runs_ns)
    assert (stages["capture"], stages["wait"]) == (capture_ns, wait_ns)


def logged(times_and_words: list[tuple[float, int, str]], wall_s: float = 0.0) -> list[str]:
    """`wall_s`: by how much the wall clock is set back with each line."""
    stream, now_s = io.StringIO(), 0.0
    handler = CountingHandler(stream, lambda: now_s)
    for number, (told_s, level, words) in enumerate(times_and_words):
        now_s = told_s
        record = logging.LogRecord("edge.camera", level, "", 0, words, (), None)
        record.created = told_s - number * wall_s
        handler.emit(record)
    handler.close()
    return stream.getvalue().splitlines()


def test_a_fault_that_repeats_is_one_line_and_a_count() -> None:
    fault = [(k * 0.1, logging.WARNING, f"picture {k} cannot be read") for k in range(500)]
    lines = logged([*fault, (61.0, logging.INFO, "tracking")])
    assert lines == [
        "picture 0 cannot be read",
        "picture 499 cannot be read (499 more in 60 s)",
        "tracking",
    ]


def test_a_wall_clock_that_is_set_back_keeps_no_fault_out_of_the_log() -> None:
    fault = [(t_s, logging.WARNING, "camera lost") for t_s in (0.0, 61.0, 122.0)]
    assert logged(fault, wall_s=3600.0) == ["camera lost"] * 3


def test_other_faults_and_plain_news_are_all_written() -> None:
    told = [(0.0, logging.ERROR, "a"), (0.1, logging.ERROR, "b"), (0.2, logging.WARNING, "a"), (0.3, logging.INFO, "c")]
    assert logged([*told, (0.4, logging.INFO, "c")]) == ["a", "b", "a", "c", "c"]


@pytest.mark.parametrize("wanted", ["cuda", "tensorrt", "openvino"])
def test_a_provider_that_is_not_there_is_named_and_the_cpu_flies(toy_model: Path, wanted: str) -> None:
    model = load_model(toy_model, 1, provider=wanted)  # type: ignore[arg-type]
    model.warm_up()
    assert model.provider == "cpu"
    assert model.fallback_reason is not None
    assert NAMES[wanted][0] in model.fallback_reason  # type: ignore[index]


def test_a_provider_that_is_built_in_but_does_not_start_is_named() -> None:
    chosen = choose_provider("tensorrt", ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"])
    assert chosen.names == NAMES["tensorrt"]
    assert chosen.confirmed([*NAMES["tensorrt"]]).fallback_reason is None
    on_cuda = chosen.confirmed(["CUDAExecutionProvider", "CPUExecutionProvider"])
    assert on_cuda.provider == "cuda"
    assert on_cuda.fallback_reason is not None
    assert chosen.confirmed(["CPUExecutionProvider"]).provider == "cpu"


def test_an_unknown_provider_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text('[camera]\ntype = "sequence"\npath = "x"\n[model]\nprovider = "npu"\n')
    command = [sys.executable, "-m", "edge.cli", "check", "--config", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"{config}:5: [model] provider: " in done.stderr
