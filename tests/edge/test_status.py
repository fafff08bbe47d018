from __future__ import annotations

import json
import re
import resource
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import zenoh

from edge.config import Config, ConfigFile
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.estimator.model import load_model
from edge.health import Activity, Condition, HealthSnapshot, HealthState, Percentiles, Reason
from edge.prometheus import RETRY_S, MetricsServer, metrics
from edge.stages import STAGES
from edge.status import ask, for_a_person, loopback_endpoints, status, works
from edge.status_board import StatusBoard, key_of
from edge.types import CameraInfo
from msgs import topics
from msgs.cdr import DiagnosticArray
from msgs.client import connect
from msgs.session import router_config
from sim_replay.ports import free_port
from tests.waiting import until

from .conftest import Cli
from .flying import Flight, flying, toml

SAMPLE = re.compile(r'^[a-z_]+(\{[a-z0-9_]+="[^"]*"(,[a-z0-9_]+="[^"]*")*\})? [-+0-9.e]+$')


@pytest.fixture(scope="module")
def ports() -> tuple[int, int]:
    return free_port(), free_port()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("daemon")


@pytest.fixture(scope="module")
def daemon(folder: Path, toy_model: Path, swaying: Path, ports: tuple[int, int]) -> Iterator[Flight]:
    more = f'[health]\nprometheus_port = {ports[1]}\n[vehicle]\nname = "kestrel"\n'
    with flying(folder, toml(swaying, toy_model, ports[0], more)) as flight:
        yield flight


def test_status_says_how_the_daemon_is(
    cli: Cli, daemon: Flight, folder: Path, toy_model: Path, ports: tuple[int, int]
) -> None:
    asked = cli("status", "--config", folder / "config.toml", "--json")
    assert asked.returncode == 0, asked.stderr
    answer = json.loads(asked.stdout)
    info = answer["info"]
    assert info["vehicle"] == "kestrel"
    assert info["pid"] == daemon.process.pid
    assert info["state"] in {state.value for state in HealthState}
    assert info["activity"] in {activity.value for activity in Activity}
    assert info["counters"]["captured"] > 0
    assert set(info["latency_ms"]) == set(STAGES)
    total, parts = info["latency_ms"]["total"], info["latency_ms"]
    assert max(parts[stage]["p50"] for stage in STAGES if stage != "total") <= total["p99"]
    assert answer["model"]["contract"]["name"] == "toy"
    assert answer["model"]["file"] == str(toy_model)
    assert answer["config"]["config"]["camera"]["fps"] == 10
    for_a_person = cli("status", "-e", f"tcp/127.0.0.1:{ports[0]}")
    assert for_a_person.returncode == 0
    assert for_a_person.stdout.startswith("kestrel  ")
    assert str(daemon.process.pid) in for_a_person.stdout


def test_status_without_a_daemon_says_so_and_fails(cli: Cli) -> None:
    asked = cli("status", "--connect", f"tcp/127.0.0.1:{free_port()}")
    assert asked.returncode == 1
    assert "no daemon answers at tcp/127.0.0.1" in asked.stdout
    assert "Traceback" not in asked.stderr


def test_of_several_vehicles_behind_one_router_status_wants_to_know_which(cli: Cli) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def answer(name: str, what: str) -> Callable[[zenoh.Query], None]:
        tree = {"vehicle": name, "state": "searching", "age_s": 0.1, "sha256": f"model of {name}"}

        def reply(query: zenoh.Query) -> None:
            query.reply(key_of(name, what), json.dumps(tree))

        return reply

    with zenoh.open(router_config([endpoint])) as router:
        for name, what in product(("uav1", "uav2"), ("info", "config", "model")):
            handler = zenoh.handlers.Callback(answer(name, what), indirect=False)
            router.declare_queryable(key_of(name, what), handler)
        asked = cli("status", "--connect", endpoint, "--json")
        assert asked.returncode == 2
        assert asked.stderr == f"uav1 and uav2 answer at {endpoint}: select one with --vehicle\n"
        asked = cli("status", "--connect", endpoint, "--vehicle", "uav2", "--json")
    answers = json.loads(asked.stdout)
    assert (asked.returncode, {one["vehicle"] for one in answers.values()}) == (0, {"uav2"})
    assert answers["model"]["sha256"] == "model of uav2"


@pytest.mark.parametrize("info", [b"{}", b"not JSON", b"[]", None])
def test_who_does_not_answer_like_a_daemon_is_none(info: bytes | None) -> None:
    """`info` alone, as from a daemon that ends in between, or something else, or an error."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def reply(query: zenoh.Query) -> None:
        if info is None:
            query.reply_err(b"not now")
        else:
            query.reply(key_of("uav1", "info"), info)

    with zenoh.open(router_config([endpoint])) as router:
        router.declare_queryable(key_of("uav1", "info"), zenoh.handlers.Callback(reply, indirect=False))
        assert ask(endpoint, "uav1") is None


DROPS, SILENT = Reason("drops", "12 % of frames dropped"), Reason("no_frame", "no frame for 3 s")
TRACKING = Condition(HealthState.TRACKING, Activity.TRACKING)


@pytest.mark.parametrize(
    ("condition", "age_s", "headline", "well"),
    [
        (None, 0.0, "starting", False),
        (TRACKING, 0.5, "tracking", True),
        (Condition(HealthState.SEARCHING, Activity.SEARCHING), 2.9, "searching", True),
        (
            Condition(HealthState.DEGRADED, Activity.TRACKING, (DROPS,)),
            0.5,
            "degraded, tracking: 12 % of frames dropped",
            True,
        ),
        (Condition(HealthState.INIT, Activity.WAITING), 0.5, "init", False),
        (
            Condition(HealthState.FAULT, Activity.WAITING, (SILENT, DROPS)),
            0.5,
            f"fault: {SILENT.text}; {DROPS.text}",
            False,
        ),
        (TRACKING, 3.0, "tracking", False),
    ],
)
def test_what_works_and_what_a_person_is_told_of_it(
    tmp_path: Path, toy_model: Path, stepped: int, condition: Condition | None, age_s: float, headline: str, well: bool
) -> None:
    config = Config.model_validate({"camera": {"type": "sequence", "path": "scene"}, "vehicle": {"name": "kestrel"}})
    camera = CameraInfo("nose", (320, 180), np.eye(3), None)
    board = StatusBoard(ConfigFile(tmp_path / "flight.toml", "", config), load_model(toy_model, 1), camera)
    if condition is not None:
        told_ns, latency_ms = stepped - round(age_s * 1e9), {"total": Percentiles(11.0, 12.5, 40.25)}
        board.snapshot = HealthSnapshot(told_ns, condition, 2, 29.97, {"dropped": 3, "frozen": 0}, latency_ms)
    answer = {"info": board.info(), "config": board.config(), "model": board.model_card()}
    assert works(answer["info"]) is well
    lines = for_a_person(json.loads(json.dumps(answer))).splitlines()
    assert lines[0] == f"kestrel  {headline}"
    assert [line.split() for line in lines[2:5]] == [
        ["camera", "nose", "320x180"],
        ["model", "toy", "fp32", board.model.sha256[:12], "on", "cpu"],
        ["config", str(tmp_path / "flight.toml")],
    ]
    stalled = "; 3 s OLD: the main loop has stalled" if age_s == 3.0 else ""
    figures = [
        *("  targets   2", f"  frames    30.0 a second{stalled}", ""),
        f"  {'stage':12} {'p50 ms':>8} {'p95 ms':>8} {'p99 ms':>8}",
        f"  {'total':12} {'11.00':>8} {'12.50':>8} {'40.25':>8}",
        *("", f"  {'dropped':40} {3:>12}"),
    ]
    assert lines[5:] == ([] if condition is None else figures)
    answer["model"]["fallback_reason"] = "no CUDA device"
    assert for_a_person(answer).splitlines()[3] == f"{lines[3]} (no CUDA device)"


def test_status_asks_on_loopback_where_the_daemon_listens_there(tmp_path: Path) -> None:
    listen = ["tcp/0.0.0.0:7448", "tcp/[::]:7449", "tcp/192.168.1.2:7450", "tcp/localhost:7451"]
    asked = loopback_endpoints(ZenohSettings(listen=listen))
    assert asked == ["tcp/127.0.0.1:7448", "tcp/[::1]:7449", "tcp/localhost:7451"]
    config = tmp_path / "flight.toml"
    for zenoh_keys, words in (
        ("enabled = false", r"\[zenoh\] enabled is false: the daemon cannot be queried"),
        ('listen = ["tcp/192.168.1.2:7450"]', r"\[zenoh\] listen has no loopback address to query; use --connect"),
    ):
        config.write_text(f'[camera]\ntype = "sequence"\npath = "{tmp_path}"\n[zenoh]\n{zenoh_keys}\n')
        with pytest.raises(InputError, match=words):
            status(config, None, None, as_json=True)
    with pytest.raises(InputError, match="a/b"):
        status(None, None, "a/b", as_json=True)


def test_status_refuses_what_is_no_address(cli: Cli) -> None:
    asked = cli("status", "--connect", "127.0.0.1")
    assert asked.returncode == 2
    assert "'127.0.0.1' is not tcp/HOST:PORT" in asked.stderr


@pytest.mark.usefixtures("daemon")
def test_another_vehicle_s_name_is_not_answered(
    folder: Path, ports: tuple[int, int], capsys: pytest.CaptureFixture[str]
) -> None:
    """As of a daemon that was given another name and not restarted: it is there all the same."""
    endpoint, words = f"tcp/127.0.0.1:{ports[0]}", f"kestrel and not merlin answers at tcp/127.0.0.1:{ports[0]}: "
    assert status(None, endpoint, "merlin", as_json=False) == 1
    assert capsys.readouterr().out.startswith(words)
    assert status(folder / "config.toml", None, "merlin", as_json=True) == 1
    assert json.loads(capsys.readouterr().out)["error"].startswith(words)


@pytest.mark.usefixtures("daemon")
def test_prometheus_reads_the_metrics(ports: tuple[int, int]) -> None:
    until(lambda: ask(f"tcp/127.0.0.1:{ports[0]}", "kestrel")["info"].get("state"), what="the first second's figures")
    with urllib.request.urlopen(f"http://127.0.0.1:{ports[1]}/metrics?debug=0", timeout=10) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        lines = answer.read().decode().splitlines()
    samples = [line for line in lines if not line.startswith("#")]
    assert all(SAMPLE.match(line) for line in samples)
    families = {re.split(r"[{ ]", line)[0] for line in samples}
    assert families == {line.split()[2] for line in lines if line.startswith("# TYPE")}
    states = [float(line.split()[-1]) for line in samples if line.startswith("uavpose_state{")]
    assert sorted(states) == [0.0] * (len(HealthState) - 1) + [1.0]
    activities = [float(line.split()[-1]) for line in samples if line.startswith("uavpose_activity{")]
    assert sorted(activities) == [0.0] * (len(Activity) - 1) + [1.0]
    for stage in STAGES:
        assert any(f'stage="{stage}",quantile="0.99"' in line for line in samples)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://127.0.0.1:{ports[1]}/etc/passwd", timeout=10)
    with pytest.raises(urllib.error.URLError, match="refused"):  # who listens everywhere listens there too
        urllib.request.urlopen(f"http://127.0.0.2:{ports[1]}/metrics", timeout=10)


def test_the_metrics_are_those_of_the_status_in_seconds(tmp_path: Path, toy_model: Path, stepped: int) -> None:
    config = Config.model_validate({"camera": {"type": "sequence", "path": "scene"}, "vehicle": {"name": "kestrel"}})
    camera = CameraInfo("nose", (320, 180), np.eye(3), None)
    board = StatusBoard(ConfigFile(tmp_path / "flight.toml", "", config), load_model(toy_model, 1), camera)
    facts = board.facts()
    start = [
        f'uavpose_info{{vehicle="kestrel",version="{facts["version"]}",model_sha256="{facts["model_sha256"]}"}} 1',
        "uavpose_uptime_seconds 0.0",
    ]
    assert [line for line in metrics(board).splitlines() if line[0] != "#"] == start
    condition = Condition(HealthState.DEGRADED, Activity.COASTING, (DROPS, SILENT))
    counters, latency_ms = {"dropped": 3, 'a "\\\n': 1}, {"total": Percentiles(11.0, 12.5, 40.25)}
    board.snapshot = HealthSnapshot(stepped - 250_000_000, condition, 2, 29.97, counters, latency_ms)
    lines = metrics(board).splitlines()
    assert [line for line in lines if line[0] != "#"] == [
        *start,
        *(f'uavpose_state{{state="{state.value}"}} {int(state.value == "degraded")}' for state in HealthState),
        *(f'uavpose_activity{{activity="{one.value}"}} {int(one.value == "coasting")}' for one in Activity),
        *("uavpose_reasons 2", 'uavpose_reason{kind="drops"} 1', 'uavpose_reason{kind="no_frame"} 1'),
        *("uavpose_tracks 2", "uavpose_frame_rate_hertz 29.97", "uavpose_snapshot_age_seconds 0.25"),
        *('uavpose_count{name="dropped"} 3', r'uavpose_count{name="a \"\\\n"} 1'),
        'uavpose_stage_seconds{stage="total",quantile="0.5"} 0.011000',
        'uavpose_stage_seconds{stage="total",quantile="0.95"} 0.012500',
        'uavpose_stage_seconds{stage="total",quantile="0.99"} 0.040250',
    ]
    families = list(dict.fromkeys(re.split(r"[{ ]", line)[0] for line in lines if line[0] != "#"))
    kinds = [f"# TYPE {name} {'untyped' if name == 'uavpose_count' else 'gauge'}" for name in families]
    assert [line for line in lines if line.startswith("# TYPE")] == kinds
    assert [line.split()[2] for line in lines if re.match(r"# HELP \w+ \w+", line)] == families


@pytest.fixture
def board(tmp_path: Path, toy_model: Path) -> StatusBoard:
    config = Config.model_validate({"camera": {"type": "sequence", "path": "scene"}})
    camera = CameraInfo("camera", (320, 180), np.eye(3), None)
    return StatusBoard(ConfigFile(tmp_path / "config.toml", "", config), load_model(toy_model, 1), camera)


@pytest.fixture
def metrics_port(board: StatusBoard) -> Iterator[int]:
    port = free_port()
    server = MetricsServer(board, port)
    yield port
    server.stop()


def test_a_port_for_metrics_is_one_server_s_until_it_stops(board: StatusBoard) -> None:
    port = free_port()
    server = MetricsServer(board, port)
    with pytest.raises(InputError, match=f"^port {port} of 127.0.0.1 cannot be served: Address already in use$"):
        MetricsServer(board, port)
    server.stop()
    MetricsServer(board, port).stop()


def test_a_reader_of_the_metrics_that_breaks_off_leaves_no_traceback_in_the_log(
    metrics_port: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with socket.create_connection(("127.0.0.1", metrics_port)) as reader:
        reader.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics_port}/metrics", timeout=10) as answer:
        assert b"uavpose_uptime_seconds" in answer.read()
    until(lambda: not any("process_request" in thread.name for thread in threading.enumerate()))
    assert capfd.readouterr().err == ""


def test_without_file_descriptors_a_reader_of_the_metrics_waits_and_the_server_does_not_spin(
    metrics_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried_s: list[float] = []
    accept = socket.socket.accept

    def noted(listening: socket.socket) -> tuple[socket.socket, object]:
        tried_s.append(time.monotonic())
        return accept(listening)

    monkeypatch.setattr(socket.socket, "accept", noted)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as reader:
        resource.setrlimit(resource.RLIMIT_NOFILE, (1, hard))  # 0 is too few for poll
        try:
            reader.connect(("127.0.0.1", metrics_port))
            until(lambda: len(tried_s) > 1)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert tried_s[1] - tried_s[0] > 0.5 * RETRY_S
        reader.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
        assert reader.recv(64).startswith(b"HTTP/1.0 200 OK")


@pytest.mark.usefixtures("daemon")
def test_diagnostics_carry_each_stage_and_the_model_s_hash(ports: tuple[int, int]) -> None:
    key = topics.subscription_key(topics.DIAGNOSTICS, "kestrel")
    with connect(f"tcp/127.0.0.1:{ports[0]}") as session, session.declare_subscriber(key) as subscriber:
        (status,) = DiagnosticArray.decode(subscriber.recv().payload.to_bytes()).status
    values = dict(status.values)
    assert len(values["model_sha256"]) == 64
    assert values["model_provider"] == "cpu"
    for stage in STAGES:
        assert float(values[f"latency_ms/{stage}/p95"]) >= 0.0


def test_passwords_in_addresses_are_not_told() -> None:
    from edge.addresses import no_password

    assert no_password("rtsp://pilot:secret@10.0.0.2:554/main") == "rtsp://***@10.0.0.2:554/main"
    assert no_password("rtsp://pilot:p@ss@10.0.0.2/main does not open") == "rtsp://***@10.0.0.2/main does not open"
    assert no_password("rtsp://u:it's@10.0.0.2/x") == "rtsp://***@10.0.0.2/x"
    assert no_password("rtsp://u:p q@10.0.0.2/x") == "rtsp://***@10.0.0.2/x"
    assert no_password("rtsp://10.0.0.2/a@b") == "rtsp://10.0.0.2/a@b"
    assert no_password("http://cam/video.cgi?user=pilot&pwd=se=cr%20et&size=hd lost") == (
        "http://cam/video.cgi?user=***&pwd=***&size=hd lost"
    )
    assert no_password("rtsp://cam/1?Access_Token=abc#1") == "rtsp://cam/1?Access_Token=***#1"
    assert no_password("rtsp://cam/1?channel=1&subtype=0") == "rtsp://cam/1?channel=1&subtype=0"


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("rtsp://u:p\"q'@cam/1", "rtsp://***@cam/1"),
        ('http://cam/x?token=a"b\\"c&size=hd', "http://cam/x?token=***&size=hd"),
        ("rtsp://cam/1", "rtsp://cam/1"),
    ],
)
def test_the_configuration_that_is_told_holds_no_password(tmp_path: Path, toy_model: Path, url: str, told: str) -> None:
    intrinsics = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 89.5, "width": 320, "height": 180}
    tree = {"camera": {"type": "stream", "url": url, "intrinsics": intrinsics}, "vehicle": {"name": "kestrel"}}
    config = Config.model_validate(tree)
    camera = CameraInfo("camera", (320, 180), np.eye(3), None)
    board = StatusBoard(ConfigFile(tmp_path / "config.toml", "", config), load_model(toy_model, 1), camera)
    answer = json.loads(json.dumps(board.config(), allow_nan=False))
    assert answer["file"] == str(tmp_path / "config.toml")
    assert answer["config"]["camera"]["url"] == told
    answer["config"]["camera"]["url"] = url
    assert Config.model_validate(answer["config"]) == config
