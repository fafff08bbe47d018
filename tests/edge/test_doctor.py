"""`uavpose-edge doctor` on real cameras, links, models and folders, as its user reads it."""

from __future__ import annotations

import json
import os
import pty
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
import zenoh

from edge.config import Config, load_config
from edge.doctor import camera_as_told
from edge.doctor_links import link_findings, running_daemon
from edge.health import Activity, Condition, Health, HealthSnapshot, HealthState, Reason
from edge.links.signing_key import write_new_key
from edge.reload import load_configured
from edge.status import ask
from edge.status_board import StatusBoard, key_of
from edge.types import CameraInfo
from msgs.mavlink import MAVLink, dialect
from msgs.session import TlsFiles, router_config
from sim_replay.ports import free_port
from tests.waiting import until

from .conftest import Cli
from .flying import flying, toml
from .mavlink_peer import DEADLINE_S
from .test_cameras_stream import UdpCamera
from .test_zenoh_config import make_keys


def findings(cli: Cli, tmp_path: Path, text: str) -> tuple[int, dict[str, dict[str, Any]]]:
    """The exit code and what was found, by what was looked at."""
    (tmp_path / "config.toml").write_text(text)
    done = cli("doctor", "--config", "config.toml", "--json")
    assert "Traceback" not in done.stderr
    answer = json.loads(done.stdout)
    assert answer["well"] == (done.returncode == 0)
    for finding in answer["findings"]:
        assert bool(finding["advice"]) == (finding["verdict"] != "good")
    return done.returncode, {finding["what"]: finding for finding in answer["findings"]}


def test_a_machine_that_can_fly_is_told_so(cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path) -> None:
    more = f'[recorder]\nenabled = true\nfolder = "{tmp_path}"\nfree_min_mb = 1\n'
    code, found = findings(cli, tmp_path, toml(swaying, toy_model, free_port(), more))
    assert [f for f in found.values() if f["verdict"] == "wrong"] == []
    assert code == 0
    assert set(found) >= {"processor", "cores", "clock", "disk", "camera", "model", "zenoh"}
    assert "1920x1080" in found["camera"]["says"]
    assert "toy fp32" in found["model"]["says"]


def test_each_fault_is_found_at_once_with_what_to_do(cli: Cli, tmp_path: Path) -> None:
    port = free_port()
    intrinsics = "{ fx = 900, fy = 900, cx = 320, cy = 240, width = 640, height = 480 }"
    text = (
        f'[camera]\ntype = "device"\ndevice = "/dev/video-none"\nintrinsics = {intrinsics}\n'
        '[model]\npath = "none.onnx"\n'
        '[recorder]\nenabled = true\nfolder = "/proc/none"\n'
        f'[zenoh]\nlisten = ["tcp/127.0.0.1:{port}"]\nconnect = ["tcp/127.0.0.1:{free_port()}"]\n'
        '[mavlink]\nendpoints = ["serial:/dev/ttyNone:57600"]\n'
    )
    code, found = findings(cli, tmp_path, text)
    assert code == 1
    assert {what for what, finding in found.items() if finding["verdict"] == "wrong"} == {
        "camera", "model", "disk", "mavlink",
    }  # fmt: skip
    assert found["camera"]["says"] == "/dev/video-none does not exist"
    assert "none.onnx" in found["model"]["says"]
    assert found["mavlink"]["says"] == "/dev/ttyNone does not exist"
    assert found["ground"]["verdict"] == "poor"  # the daemon flies without it


def test_an_endpoint_that_another_holds_and_a_silent_autopilot_are_found(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as scraped:
        text = toml(swaying, toy_model, taken.getsockname()[1]).partition("[mavlink]")[0]
        text += '[mavlink]\nendpoints = ["udpin:127.0.0.1:0", "tcpout:autopilot.invalid:5760"]\n'
        text += f"[health]\nprometheus_port = {scraped.getsockname()[1]}\n"
        code, found = findings(cli, tmp_path, text)
    assert code == 1
    assert "cannot listen on" in found["zenoh"]["says"]
    assert "stop the program" in found["zenoh"]["advice"]
    assert "no heartbeat" in found["mavlink"]["says"]
    assert "host 'autopilot.invalid' cannot be resolved" in found["host"]["says"]
    assert "127.0.0.1 cannot be served: Address already in use" in found["prometheus"]["says"]
    assert "stop the program" in found["prometheus"]["advice"]


def test_a_radio_that_is_unplugged_does_not_hide_whether_the_autopilot_is_heard(tmp_path: Path) -> None:
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3).pack(MAVLink(None, 1, 1))
    with socket.socket(type=socket.SOCK_DGRAM) as autopilot, ThreadPoolExecutor() as pool:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(DEADLINE_S)
        pool.submit(lambda: autopilot.sendto(beat, autopilot.recvfrom(300)[1]))
        there = f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"
        tree = {
            "camera": {"type": "sequence", "path": "scene"},
            "zenoh": {"enabled": False},
            "mavlink": {"endpoints": [f"serial:{tmp_path}/radio:57600", there]},
        }
        found = [(one.verdict, one.says) for one in link_findings(Config.model_validate(tree), None)]
    assert found == [("wrong", f"{tmp_path}/radio does not exist"), ("good", f"{there}: heartbeat received")]


@pytest.mark.parametrize(
    ("host", "said"),
    [("ground..local", "host 'ground..local' cannot be resolved"), ("192.0.2.1", "Cannot assign requested address")],
)
def test_an_address_that_is_none_of_ours_is_not_taken_for_an_endpoint_that_another_holds(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path, host: str, said: str
) -> None:
    text = toml(swaying, toy_model, free_port()).partition("[mavlink]")[0]
    text = text.replace("127.0.0.1", "192.0.2.1") + f'[mavlink]\nendpoints = ["udpin:{host}:14550"]\n'
    code, found = findings(cli, tmp_path, text)
    assert code == 1
    assert said in found["mavlink"]["says"]
    assert "Cannot assign requested address" in found["zenoh"]["says"]
    for what in ("mavlink", "zenoh"):
        assert found[what]["advice"] == "use an address of this computer, or 0.0.0.0 for all of them"


def test_a_serial_port_that_another_program_holds_is_not_taken_for_a_silent_autopilot(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    text = toml(swaying, toy_model, free_port()).partition("[mavlink]")[0]
    held, port = pty.openpty()
    with serial.Serial(os.ttyname(port), exclusive=True):
        code, found = findings(cli, tmp_path, text + f'[mavlink]\nendpoints = ["serial:{os.ttyname(port)}:57600"]\n')
    assert (code, found["mavlink"]["says"]) == (1, f"{os.ttyname(port)} is used by another program")
    assert f"fuser -v {os.ttyname(port)}" in found["mavlink"]["advice"]
    for descriptor in (held, port):
        os.close(descriptor)
    _, found = findings(cli, tmp_path, text + '[mavlink]\nendpoints = ["serial:/dev/null:57600"]\n')
    assert "serial:/dev/null:57600 does not open" in found["mavlink"]["says"]


def test_a_configuration_that_is_wrong_is_told_as_everywhere(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("[camera]\ntype = 'film'\n")
    done = cli("doctor", "--config", "config.toml")
    assert done.returncode == 2
    assert "config.toml:1: [camera]: type must be one of" in done.stderr


def test_a_disk_that_only_the_ground_s_command_would_write_to_is_looked_at_too(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    text = toml(swaying, toy_model, free_port(), '[recorder]\nfolder = "/proc/none"\n')
    code, found = findings(cli, tmp_path, text)
    assert (code, found["disk"]["verdict"]) == (0, "poor")
    assert "requested by the ground" in found["disk"]["says"]
    _, found = findings(cli, tmp_path, text.replace("[mavlink]", "commands = false\n[mavlink]"))
    assert "disk" not in found


NONE: dict[str, Any] = {"info": {}}


def test_a_camera_that_the_running_daemon_has_is_not_taken_for_a_broken_one(
    cli: Cli, tmp_path: Path, toy_model: Path
) -> None:
    port, asked_at = free_port(socket.SOCK_DGRAM), free_port()  # the first is one program's alone to read
    intrinsics = "{ fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }"
    text = (
        f'[camera]\ntype = "stream"\nurl = "udp://127.0.0.1:{port}"\nintrinsics = {intrinsics}\n'
        f'[model]\npath = "{toy_model}"\nthreads = 1\n'
        f'[zenoh]\nlisten = ["tcp/0.0.0.0:{asked_at}"]\n[mavlink]\nenabled = false\n'
    )
    encoder = UdpCamera(port, fps=20)
    encoder.start()
    try:
        with flying(tmp_path, text):
            until(lambda: (ask(f"tcp/127.0.0.1:{asked_at}", "uav1") or NONE)["info"].get("frame_rate_hz"))
            asked = [findings(cli, tmp_path, text)]
            # An encoder that had to wait for the processor is a camera whose pictures come in bursts.
            until(lambda: asked[-1][0] == 0, lambda: asked.append(findings(cli, tmp_path, text)), what="all well")
    finally:
        encoder.stop.set()
        encoder.join()
    _, found = asked[-1]
    assert [f for f in found.values() if f["verdict"] == "wrong"] == []
    assert found["camera"]["verdict"] == "good"
    assert "320x180" in found["camera"]["says"]
    assert "running (process " in found["daemon"]["says"]


def test_what_the_running_daemon_says_of_its_links_is_taken(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    asked_at = free_port()
    links = f'endpoints = ["udpin:127.0.0.1:0", "serial:{tmp_path}/none:57600"]\n'
    text = toml(swaying, toy_model, asked_at).replace("enabled = false\n", links)
    assert links in text

    def lacks_attitude() -> bool:
        running = ask(f"tcp/127.0.0.1:{asked_at}", "uav1") or NONE
        return "no_attitude" in running["info"].get("reason_kinds", ())

    with flying(tmp_path, text):
        until(lacks_attitude)
        code, found = findings(cli, tmp_path, text)
        aligned = cli("align", "--config", "config.toml")
    assert (code, found["daemon"]["verdict"]) == (1, "wrong")
    assert "no own attitude" in found["daemon"]["says"]
    assert "autopilot" in found["daemon"]["advice"]
    assert (aligned.returncode, "a daemon is running (process " in aligned.stderr) == (2, True)


def test_a_daemon_that_was_started_with_other_values_is_told_by_its_name(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    text = toml(swaying, toy_model, free_port())
    other = f'[vehicle]\nname = "uav2"\n{text.replace("fps = 10", "fps = 11")}'
    with flying(tmp_path, text):
        _, as_started = findings(cli, tmp_path, text)
        asked = [findings(cli, tmp_path, other)]
        # A daemon that has to wait for the processor has faults of its own.
        until(lambda: asked[-1][0] == 0, lambda: asked.append(findings(cli, tmp_path, other)), what="all else well")
        _, in_flight = findings(cli, tmp_path, f"{text}[target]\nwingspan_m = 11.0\nlength_m = 8.3\n")
    _, found = asked[-1]
    assert found["config"]["verdict"] == "poor"
    assert "runs as uav1, with other values than the file of [vehicle] name, [camera] fps" in found["config"]["says"]
    assert "restart" in found["config"]["advice"]
    assert "[target] wingspan_m, [target] length_m" in in_flight["config"]["says"]
    assert "systemctl reload" in in_flight["config"]["advice"]
    assert "reported by the running daemon" in found["camera"]["says"]
    assert "config" not in as_started


def test_a_daemon_that_is_starting_is_not_told_as_well(tmp_path: Path, toy_model: Path, swaying: Path) -> None:
    (tmp_path / "config.toml").write_text(toml(swaying, toy_model, free_port()))
    file = load_config(tmp_path / "config.toml")
    info = CameraInfo("nose", (320, 180), np.eye(3), None)
    running = StatusBoard(file, load_configured(file), info).info()
    found = [*(one for one, _ in camera_as_told(running)), *link_findings(file.config, running)]
    told = ("poor", "the daemon is still starting", "run doctor again in a few seconds")
    assert [(one.what, one.verdict, one.says, one.advice) for one in found] == [("camera", *told), ("daemon", *told)]


@pytest.mark.parametrize(
    ("kinds", "verdict", "advice"),
    [
        (("camera_frozen", "no_camera", "no_frame"), "good", ""),  # told of the camera
        (("no_frame", "drops"), "poor", "`uavpose-edge status`"),
        (("drops", "no_attitude"), "wrong", "check that the autopilot is on"),
    ],
)
def test_what_a_running_daemon_says_of_itself_is_judged_by_its_kind(
    tmp_path: Path, toy_model: Path, swaying: Path, kinds: tuple[str, ...], verdict: str, advice: str
) -> None:
    (tmp_path / "config.toml").write_text(toml(swaying, toy_model, free_port()))
    file = load_config(tmp_path / "config.toml")
    board = StatusBoard(file, load_configured(file), CameraInfo("nose", (320, 180), np.eye(3), None))
    reasons = tuple(Reason(kind, f"{kind} is told") for kind in kinds)
    board.snapshot = HealthSnapshot(1, Condition(HealthState.DEGRADED, Activity.SEARCHING, reasons), 0, 10.0, {}, {})
    (found,) = link_findings(file.config, board.info())
    assert (found.what, found.verdict, found.advice[: max(len(advice), 1)]) == ("daemon", verdict, advice)
    told = "; ".join(reason.text for reason in reasons if "camera" not in reason.kind and "frame" not in reason.kind)
    assert found.says.endswith(f"state degraded: {told}" if told else "; its links are not tested by this command")


@pytest.mark.parametrize("secure", [False, True], ids=["tcp", "tls"])
def test_links_that_work_are_told_as_good_and_those_that_are_off_not_at_all(tmp_path: Path, secure: bool) -> None:
    grounds, metrics = make_keys(tmp_path) if secure else None, free_port()
    files = TlsFiles(tmp_path / "ca.pem", tmp_path / "uav1.pem", tmp_path / "uav1.key") if secure else None
    ground, listen = (f"{'tls' if secure else 'tcp'}/127.0.0.1:{free_port()}" for _ in range(2))
    tls = {"tls": asdict(files)} if files is not None else {}

    def found(**sections: Any) -> list[tuple[str, str, str]]:
        tree = {"camera": {"type": "sequence", "path": "scene"}, "mavlink": {"enabled": False}, **sections}
        return [(one.what, one.verdict, one.says) for one in link_findings(Config.model_validate(tree), None)]

    with zenoh.open(router_config([ground], tls=grounds)):
        both = found(zenoh={"listen": [listen], "connect": [ground], **tls}, health={"prometheus_port": metrics})
        alone = found(zenoh={"listen": [], "connect": [ground], **tls})
    assert both == [
        ("zenoh", "good", f"can listen on {listen}"),
        ("ground", "good", f"{ground} answers"),
        ("prometheus", "good", f"port {metrics} of 127.0.0.1 is free"),
    ]
    assert alone == [("zenoh", "good", "no address to listen on"), both[1]]
    assert found(zenoh={"enabled": False}) == []


@pytest.mark.parametrize("secure", [False, True], ids=["tcp", "tls"])
def test_of_several_daemons_that_answer_the_one_of_this_configuration_is_looked_at(
    tmp_path: Path, secure: bool
) -> None:
    """As where a router of the ground runs beside the daemon."""
    endpoint = f"{'tls' if secure else 'tcp'}/127.0.0.1:{free_port()}"
    files = make_keys(tmp_path) if secure else None

    def answer(name: str, what: str) -> Callable[[zenoh.Query], None]:
        return lambda query: query.reply(key_of(name, what), json.dumps({"vehicle": name}))

    links: dict[str, Any] = {"listen": [endpoint], **({"tls": asdict(files)} if files is not None else {})}
    tree = {"camera": {"type": "sequence", "path": "scene"}, "zenoh": links}
    with zenoh.open(router_config([endpoint], tls=files)) as router:
        for name, what in product(("uav1", "uav2"), ("info", "config", "model")):
            handler = zenoh.handlers.Callback(answer(name, what), indirect=False)
            router.declare_queryable(key_of(name, what), handler)
        for name in ("uav1", "uav2"):
            running = running_daemon(Config.model_validate({**tree, "vehicle": {"name": name}}))
            assert running is not None
            assert running["info"] == {"vehicle": name}
        assert running_daemon(Config.model_validate({**tree, "zenoh": {**links, "enabled": False}})) is None
    assert running_daemon(Config.model_validate(tree)) is None


@pytest.mark.parametrize(
    ("counters", "kept", "wrong"),
    [
        ({"mavlink_received_HEARTBEAT": 9, "recorder_stopped": 0}, "mavlink.timestamp", {}),
        ({"mavlink_received_HEARTBEAT": 9, "recorder_stopped": 1}, "mavlink.timestamp", {"recorder": "cannot record"}),
        ({"mavlink_sent_HEARTBEAT": 9}, "none/key", {"daemon": "no heartbeat", "signing": "cannot be written"}),
    ],
)
def test_what_a_running_daemon_lacks_without_a_camera_is_told_too(
    tmp_path: Path, toy_model: Path, swaying: Path, counters: dict[str, int], kept: str, wrong: dict[str, str]
) -> None:
    write_new_key(tmp_path / "key")
    links = f'[mavlink]\nsigning_key = "key"\nsigning_state = "{kept}"\n'
    text = toml(swaying, toy_model, free_port()).replace("[mavlink]\nenabled = false\n", links)
    (tmp_path / "config.toml").write_text(text)
    file = load_config(tmp_path / "config.toml")
    board = StatusBoard(file, load_configured(file), CameraInfo("nose", (320, 180), np.eye(3), None))
    board.snapshot = Health(wants_attitude=True).snapshot(1, counters)
    found = {one.what: one for one in link_findings(file.config, board.info())}
    assert {what for what, one in found.items() if one.verdict != "good"} == set(wrong)
    for what, words in wrong.items():
        assert (found[what].verdict, words in found[what].says) == ("wrong", True), found[what].says
