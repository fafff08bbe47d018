"""`uavpose-edge doctor` on real cameras, links, models and folders, as its user reads it."""

from __future__ import annotations

import json
import os
import pty
import pwd
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from edge.config import load_config
from edge.doctor import camera_as_told
from edge.doctor_links import link_findings
from edge.doctor_machine import clock_finding, cpu_finding, disk_finding
from edge.health import Health
from edge.links.signing_key import write_new_key
from edge.reload import load_configured
from edge.status import ask
from edge.status_board import StatusBoard
from edge.types import CameraInfo
from sim_replay.faults.rig import can_mount
from sim_replay.ports import free_port
from tests.waiting import until

from .conftest import Cli
from .flying import flying, toml
from .test_cameras_stream import UdpCamera


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


@pytest.mark.parametrize(
    ("cpuinfo", "machine", "verdict"),
    [
        ("flags\t\t: fpu avx2 avx512_vnni\n", "x86_64", "good"),
        ("flags\t\t: fpu avx2 avx_vnni\n", "x86_64", "good"),
        ("flags\t\t: fpu avx2\n", "x86_64", "poor"),
        ("Features\t: fp asimd asimddp\n", "aarch64", "good"),  # Cortex-A76, Raspberry Pi 5
        ("Features\t: fp asimd\n", "aarch64", "poor"),  # Cortex-A72, Raspberry Pi 4
        ("Features\t: fp asimd\n", "riscv64", "poor"),
    ],
)
def test_the_processor_s_eight_bit_instructions_are_looked_for(cpuinfo: str, machine: str, verdict: str) -> None:
    assert cpu_finding(cpuinfo, machine).verdict == verdict


def test_the_clock_is_judged_by_what_the_kernel_says() -> None:
    assert clock_finding(0).verdict == "good"
    assert "chrony" in clock_finding(5).advice
    assert clock_finding(-1).verdict == "poor"


def test_a_disk_without_room_is_wrong(tmp_path: Path) -> None:
    assert disk_finding(tmp_path / "not" / "yet", 0, from_start=True).verdict == "good"
    assert "MB free" in disk_finding(tmp_path, 10**18, from_start=True).says
    file = tmp_path / "file"
    file.write_text("")
    found = disk_finding(file / "folder", 0, from_start=True)
    assert (found.verdict, "cannot be written" in found.says) == ("wrong", True)


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
    assert (code, found["daemon"]["verdict"]) == (1, "wrong")
    assert "no own attitude" in found["daemon"]["says"]
    assert "autopilot" in found["daemon"]["advice"]


def test_a_daemon_that_was_started_with_other_values_is_told_by_its_name(
    cli: Cli, tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    text = toml(swaying, toy_model, free_port())
    with flying(tmp_path, text):
        _, as_started = findings(cli, tmp_path, text)
        code, found = findings(cli, tmp_path, f'[vehicle]\nname = "uav2"\n{text.replace("fps = 10", "fps = 11")}')
    assert (code, found["config"]["verdict"]) == (0, "poor")
    assert "runs as uav1, with other values than the file of [vehicle] name, [camera] fps" in found["config"]["says"]
    assert "restart" in found["config"]["advice"]
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


NO_ROOT_LOOKS = """
import os
from pathlib import Path
from edge.doctor_machine import disk_finding
from edge.findings import device_fault
if os.geteuid() == 0:  # who may everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
print(*(device_fault(Path("{path}"), "video") or ["may be used"]), sep="\\n")
print(disk_finding(Path("{path}"), 0, from_start=True).line())
"""


def nobody() -> str:
    """Who looks in `looked_at_by_nobody`."""
    return pwd.getpwuid(os.geteuid() or 65534).pw_name


def looked_at_by_nobody(folder: Path, path: str) -> str:
    """What is said of `path`, from `folder`, as a device and as a folder for recordings."""
    folder.chmod(0o755)
    command = [sys.executable, "-c", NO_ROOT_LOOKS.replace("{path}", path)]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout


@pytest.mark.parametrize(
    ("mode", "words"),
    [(0o000, "usermod -aG video {user},"), (0o444, "is not readable and writable"), (0o666, "may be used")],
)
def test_a_device_without_permission_names_the_group_and_who_lacks_it(tmp_path: Path, mode: int, words: str) -> None:
    """With `sudo -u uavpose`, $USER of the person who follows the advice is another."""
    device = tmp_path / "video0"
    device.touch()
    device.chmod(mode)
    assert words.format(user=nobody()) in looked_at_by_nobody(tmp_path, "video0")


@pytest.mark.parametrize("path", ["home/rec", "home/rec/deep", "home/none", "link"])
def test_what_lies_in_a_folder_that_may_not_be_entered_is_told_as_forbidden(tmp_path: Path, path: str) -> None:
    (tmp_path / "home" / "rec").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "home" / "rec")
    (tmp_path / "home").chmod(0o000)
    said = looked_at_by_nobody(tmp_path, path)
    (tmp_path / "home").chmod(0o755)  # or pytest, where it is not root, cannot remove it
    assert f"{path} is not readable" in said
    assert f"namei -l {path}" in said
    assert f"WRONG  disk         {path} cannot be written by this user" in said


ADVICE_FOLDER = "`sudo install -d -o {user} 'my rec'`"


@pytest.mark.parametrize(("mode", "words"), [(0o777, "GB free"), (0o555, ADVICE_FOLDER), (0o333, ADVICE_FOLDER)])
def test_a_recorder_s_folder_must_be_one_to_write_and_to_look_into(tmp_path: Path, mode: int, words: str) -> None:
    folder = tmp_path / "my rec"
    folder.mkdir()
    folder.chmod(mode)
    said = looked_at_by_nobody(tmp_path, "my rec")
    folder.chmod(0o755)
    assert words.format(user=nobody()) in said


ON_A_READ_ONLY_DISK = 'mount -t tmpfs -o ro tmpfs "$1" && exec "$2" -c "$3" "$1"'
LOOK_AT_DISK = """
import sys
from pathlib import Path
from edge.doctor_machine import disk_finding
print(disk_finding(Path(sys.argv[1]) / "rec", 0, from_start=True).line())
"""


def test_a_disk_that_is_mounted_read_only_is_not_taken_for_one_that_others_own(tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")
    mounting = ["unshare", "--map-root-user", "--mount", "sh", "-c", ON_A_READ_ONLY_DISK, "sh", str(tmp_path)]
    said = subprocess.run([*mounting, sys.executable, LOOK_AT_DISK], capture_output=True, text=True, check=True).stdout
    assert f"WRONG  disk         {tmp_path}/rec is on a disk that is mounted read-only" in said
    assert "$USER" not in said
