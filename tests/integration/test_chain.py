"""The whole chain as a user runs it: the demo's own command, real processes, sockets and sessions, under junk."""

from __future__ import annotations

import contextlib
import json
import random
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import pytest
import zenoh

from msgs import topics
from msgs.client import connect
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.play import last_counters
from sim_replay.ports import free_port
from tests.waiting import until

BIN = Path(sys.executable).parent
DEMO_S = 400.0  # seconds of flight; then a busy machine takes minutes to write the film and the report
END_S = 60.0
JUNK_PER_KIND = 40
JUNK_PERIOD_S = 0.02  # spread over the frames of the demo

pytestmark = pytest.mark.timeout(DEMO_S + 100.0)


@dataclass(frozen=True)
class DemoRun:
    exit_code: int
    out: Path
    text: str
    score: dict[str, Any]


def written_config(out: Path, process: subprocess.Popen[str]) -> dict[str, Any]:
    """What the demo wrote for its daemon; empty as long as it has not."""
    assert process.poll() is None, "the demo ended too early"
    try:
        config = tomllib.loads((out / "config.toml").read_text())
    except (FileNotFoundError, tomllib.TOMLDecodeError):
        return {}
    return config if "mavlink" in config else {}


def meet(out: Path, process: subprocess.Popen[str]) -> tuple[dict[str, Any], zenoh.Session]:
    """The configuration of the demo's daemon, and a session with it.

    A demo whose daemon was not ready in time begins again, with another configuration.
    """
    met = []

    def attempt() -> None:
        if config := written_config(out, process):
            with contextlib.suppress(ConnectionError):
                met.append((config, connect(config["zenoh"]["listen"][0])))

    until(lambda: met, attempt, what="the demo's daemon")
    return met[0]


def open_session(endpoint: str) -> zenoh.Session:
    opened: list[zenoh.Session] = []

    def attempt() -> None:
        with contextlib.suppress(ConnectionError):
            opened.append(connect(endpoint))

    until(lambda: opened, attempt, what=f"a session with {endpoint}")
    return opened[0]


def send_junk_in_flight(out: Path, process: subprocess.Popen[str]) -> None:
    """Junk once frames are played."""
    while True:
        config, session = meet(out, process)
        with session:
            if plays(session, config, out, process):
                send_junk(session, int(config["mavlink"]["endpoints"][0].rpartition(":")[2]))
                return


def plays(session: zenoh.Session, config: dict[str, Any], out: Path, process: subprocess.Popen[str]) -> bool:
    """Whether the daemon of this configuration tells of frames, or the demo begins again since it was late."""
    frames: list[str] = []
    take = zenoh.handlers.Callback(lambda sample: frames.append(str(sample.key_expr)), indirect=False)
    subscriber = session.declare_subscriber(topics.subscription_key(topics.DETECTIONS, "uav1"), take)
    until(lambda: frames or written_config(out, process) != config, what="a frame")
    subscriber.undeclare()
    return bool(frames)


def send_junk(session: zenoh.Session, mavlink_port: int) -> None:
    """Random datagrams at the MAVLink port and random payloads on pose keys."""
    chance, address = random.Random(5), ("127.0.0.1", mavlink_port)
    key = topics.publication_key(topics.POSE, "uav1", "t9")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        for _ in range(JUNK_PER_KIND):
            link.sendto(chance.randbytes(chance.randrange(1, 10_000)), address)
            # A first byte of MAVLink 2 makes the parser believe a frame begins.
            link.sendto(b"\xfd" + chance.randbytes(chance.randrange(1, 300)), address)
            session.put(key, chance.randbytes(chance.randrange(0, 500)))
            time.sleep(JUNK_PERIOD_S)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> DemoRun:
    out = tmp_path_factory.mktemp("demo") / "out"
    command = [BIN / "uavpose-replay", "demo", "--out", out]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        send_junk_in_flight(out, process)
        text, _ = process.communicate(timeout=DEMO_S)
    finally:
        process.terminate()  # where it has not ended: it takes its processes with it
    score_file = out / "score.json"
    assert score_file.exists(), text
    return DemoRun(process.returncode, out, text, json.loads(score_file.read_text()))


def test_the_demo_succeeds_and_both_peers_got_poses(demo: DemoRun) -> None:
    assert demo.exit_code == 0, demo.text
    assert demo.score["mavlink_received"]["TARGET_RELATIVE"] > 0
    assert demo.score["zenoh_received"]["uav1/target/t0/pose"] > 0


def test_the_score_is_complete(demo: DemoRun) -> None:
    score, overall = demo.score, demo.score["overall"]
    assert overall["frames"] == len(list((BUNDLED_SEQUENCE / "rgb").iterdir()))
    assert 0 < score["poses"] <= overall["frames"] * 2
    assert 0 < overall["recall"] <= 1
    for name in ("rotation_error_deg", "translation_error_m", "depth_error_rel"):
        assert overall[name]["mean"] >= 0
        assert overall[name]["median"] >= 0
    assert 0 <= overall["pose_10deg_5pct"] <= overall["recall"]
    assert set(score["by_airframe"]) == {"twin_boom_inverted_v"}
    assert 0 < score["latency_ms"]["p50"] <= score["latency_ms"]["p95"] <= score["latency_ms"]["p99"]
    assert score["dropped_frames"] >= 0
    assert set(score["model"]) >= {"name", "file", "sha256", "precision", "acquire_score_min", "track_score_min"}


def test_the_autopilot_heard_the_daemon_as_a_component_of_its_vehicle(demo: DemoRun) -> None:
    received = demo.score["mavlink_received"]
    assert {"HEARTBEAT", "TIMESYNC", "CAMERA_TRACKING_IMAGE_STATUS", "TARGET_RELATIVE"} <= set(received)
    assert demo.score["mavlink_refused"] == {}


def test_poses_in_ned_say_that_own_attitude_was_used(demo: DemoRun) -> None:
    assert demo.score["zenoh_received"]["uav1/target/t0/odom"] > 0


def test_junk_at_the_mavlink_port_was_counted_and_survived(demo: DemoRun) -> None:
    counters = last_counters((demo.out / "daemon.log").read_text())
    refused = sum(count for name, count in counters.items() if name.startswith("mavlink_refused_"))
    # A datagram may be lost before the daemon's socket, never after it.
    assert refused >= JUNK_PER_KIND
    assert counters["mavlink_sent_TARGET_RELATIVE"] >= demo.score["mavlink_received"]["TARGET_RELATIVE"] > 0


def test_junk_on_zenoh_was_refused_by_the_client_and_counted(demo: DemoRun) -> None:
    assert demo.score["zenoh_received"]["uav1/target/t9/pose"] == JUNK_PER_KIND
    assert sum(demo.score["zenoh_refused"].values()) >= JUNK_PER_KIND


def test_pictures_are_written(demo: DemoRun) -> None:
    picture = cv2.imread(str(demo.out / "overlay.png"))
    assert picture is not None
    assert picture.shape == (1080, 1920, 3)
    video = cv2.VideoCapture(str(demo.out / "overlay.mp4"))
    frames = 0
    while video.grab():
        frames += 1
    assert frames == demo.score["overall"]["frames"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_demo_that_is_told_to_stop_takes_its_processes_with_it(number: signal.Signals, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [BIN / "uavpose-replay", "demo", "--out", out]
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
        # Whoever runs the tests under nohup hands down that SIGHUP is ignored.
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    config, session = meet(out, process)
    with session:
        process.send_signal(number)
        assert process.wait(timeout=END_S) == 130
    with pytest.raises(ConnectionError):
        connect(config["zenoh"]["listen"][0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", int(config["mavlink"]["endpoints"][0].rpartition(":")[2])))


@pytest.fixture
def running_daemon(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A daemon that plays the bundled sequence for ever, met once it has said how it is."""
    ports = [free_port(), free_port(socket.SOCK_DGRAM)]
    config = tmp_path / "config.toml"
    config.write_text(
        f'[camera]\ntype = "sequence"\npath = "{BUNDLED_SEQUENCE}"\nloop = true\n'
        f'[zenoh]\nlisten = ["tcp/127.0.0.1:{ports[0]}"]\n'
        f'[mavlink]\nendpoints = ["udpin:127.0.0.1:{ports[1]}"]\n'
    )
    process = subprocess.Popen([BIN / "uavpose-edge", "run", "--config", config], stderr=subprocess.DEVNULL)
    with open_session(f"tcp/127.0.0.1:{ports[0]}") as session:
        key = topics.subscription_key(topics.DIAGNOSTICS, "uav1")
        with session.declare_subscriber(key) as diagnostics:
            diagnostics.recv()
    yield process
    process.kill()
    process.wait()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_daemon(running_daemon: subprocess.Popen[bytes], number: signal.Signals) -> None:
    running_daemon.send_signal(number)
    assert running_daemon.wait(timeout=END_S) == 0


def test_the_subscriber_is_built_on_msgs_alone() -> None:
    program = (
        "import sys; import sim_replay.subscriber; "
        "print(*sorted(m for m in sys.modules if m.split('.')[0] in "
        "('edge', 'trainer', 'sim_replay', 'cv2', 'onnxruntime', 'pymavlink', 'torch')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["sim_replay", "sim_replay.subscriber"]


def test_the_demo_needs_neither_torch_nor_gl() -> None:
    program = "import sys; import sim_replay.cli; print(*({'torch', 'moderngl', 'onnx', 'trainer'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_bad_input_is_told_in_a_sentence_with_exit_code_2(tmp_path: Path) -> None:
    command = [BIN / "uavpose-replay", "demo", "--out", tmp_path / "out", "--model", tmp_path / "missing.onnx"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "missing.onnx" in done.stderr
    assert "Traceback" not in done.stderr
