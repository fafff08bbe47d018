from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs.ground.keys import init_authority, issue
from tests.certificates import redate

from .conftest import Cli
from .flying import flying
from .toy_model import NO_NUMBER_GRAPH, ONE_PICTURE_GRAPH, write_toy_model

OFF = "[zenoh]\nenabled = false\n[mavlink]\nenabled = false\n"


@pytest.fixture
def text(scene: Path, toy_model: Path) -> str:
    """A configuration that flies."""
    return f'[camera]\ntype = "sequence"\npath = "{scene}"\nfps = 60\n[model]\npath = "{toy_model}"\n'


@pytest.fixture
def taken_ports() -> Iterator[tuple[int, int]]:
    """A TCP and a UDP port of the loopback that somebody else holds."""
    with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        tcp.listen()
        udp.bind(("127.0.0.1", 0))
        yield tcp.getsockname()[1], udp.getsockname()[1]


def refusal(cli: Cli, tmp_path: Path, text: str, command: str = "run") -> str:
    """What the command says of a configuration it refuses, with exit code 2 and without a traceback."""
    (tmp_path / "config.toml").write_text(text)
    done = cli(command, "--config", "config.toml")
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr.strip().splitlines()[-1]


def test_a_configuration_that_flies_is_checked_and_flown(cli: Cli, tmp_path: Path, text: str) -> None:
    mask = np.zeros((540, 960), np.uint8)
    mask[:, :96] = 255
    cv2.imwrite(str(tmp_path / "own.png"), mask)
    more = text.replace("[camera]\n", '[camera]\nreadout_ms = -21.5\nown_ship_mask = "own.png"\n')
    (tmp_path / "config.toml").write_text(more + "[target]\nwingspan_m = 20.1\nlength_m = 11\n" + OFF)
    checked = cli("check", "--config", "config.toml")
    assert checked.returncode == 0, checked.stderr
    assert "target   wingspan 20.1 m, length 11 m\n" in checked.stdout
    camera = "1920x1080, focal length 2000.0 x 2000.0 px, no distortion, own ship hides 10 %, rolling shutter, -21.5 ms"
    assert f"{camera}\n" in checked.stdout
    assert "toy fp32" in checked.stdout
    flown = cli("run", "--config", "config.toml")
    assert flown.returncode == 0, flown.stderr
    assert "captured=" in flown.stderr.splitlines()[-1]


def test_a_certificate_of_another_day_is_told_by_check_and_keeps_nobody_from_flying(
    cli: Cli, tmp_path: Path, text: str
) -> None:
    """A computer without a clock begins in the past, and the link comes up once it knows the time."""
    init_authority(tmp_path)
    issue(tmp_path, "uav1")
    begins, _ = redate(tmp_path, "uav1", begins_days=2, ends_days=9)
    text += "[mavlink]\nenabled = false\n[zenoh]\nlisten = []\n"
    text += 'tls = { root_ca = "ca.pem", certificate = "uav1.pem", private_key = "uav1.key" }\n'
    sentence = f"{tmp_path / 'uav1.pem'} is not valid before {begins:%Y-%m-%d}; today is "
    assert f"config.toml:11: [zenoh] tls: {sentence}" in refusal(cli, tmp_path, text, "check")
    flown = cli("run", "--config", "config.toml")
    assert flown.returncode == 0, flown.stderr
    assert sentence in flown.stderr
    assert "captured=" in flown.stderr.splitlines()[-1]


def test_a_certificate_of_another_name_than_the_vehicle_s_is_told_of(cli: Cli, tmp_path: Path, text: str) -> None:
    """The router drops all that comes under a name that is not the certificate's, and says nothing."""
    init_authority(tmp_path)
    issue(tmp_path, "uav2")
    text += "[mavlink]\nenabled = false\n[zenoh]\nlisten = []\nconnect = ['tls/127.0.0.1:1']\n"
    text += 'tls = { root_ca = "ca.pem", certificate = "uav2.pem", private_key = "uav2.key" }\n'
    sentence = f"{tmp_path / 'uav2.pem'} is that of uav2, not uav1's: a router with [access] drops what uav1 sends"
    (tmp_path / "config.toml").write_text(text)
    checked, flown, looked = (cli(command, "--config", "config.toml") for command in ("check", "run", "doctor"))
    assert (checked.returncode, flown.returncode) == (0, 0), checked.stderr + flown.stderr
    assert all(sentence in told for told in (checked.stdout, flown.stderr, looked.stdout))
    (tmp_path / "config.toml").write_text(text + "[vehicle]\nname = 'uav2'\n")
    assert "certificate" not in cli("check", "--config", "config.toml").stdout.replace(str(tmp_path), "")


def test_a_certificate_of_another_day_for_the_camera_is_told_by_check(
    cli: Cli, tmp_path: Path, toy_model: Path
) -> None:
    init_authority(tmp_path)
    issue(tmp_path, "uav1")
    _, ends = redate(tmp_path, "uav1", begins_days=-9, ends_days=-2)
    text = (
        '[camera]\ntype = "zenoh"\ntopic = "nose/image"\nconnect = "tls/127.0.0.1:1"\n'
        'tls = { root_ca = "ca.pem", certificate = "uav1.pem", private_key = "uav1.key" }\n'
        "intrinsics = { fx = 900, fy = 900, cx = 320, cy = 240, width = 640, height = 480 }\n"
        f'[model]\npath = "{toy_model}"\n'
    )
    sentence = f"{tmp_path / 'uav1.pem'} expired on {ends:%Y-%m-%d}; today is "
    assert f"config.toml:5: [camera] tls: {sentence}" in refusal(cli, tmp_path, text + OFF, "check")


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_model_that_does_not_do_is_named(cli: Cli, tmp_path: Path, text: str, toy_model: Path, command: str) -> None:
    corrupt, strange, single, nan = (tmp_path / f"{name}.onnx" for name in ("corrupt", "strange", "single", "nan"))
    corrupt.write_bytes(toy_model.read_bytes()[:300])
    write_toy_model(strange, metadata='{"version": 99}')
    write_toy_model(single, graph=ONE_PICTURE_GRAPH)
    write_toy_model(nan, graph=NO_NUMBER_GRAPH)
    for path, reason in (
        (tmp_path / "none.onnx", "No such file"),
        (corrupt, "not a loadable ONNX file"),
        (strange, "contract version 99"),
        (single, "does not run at 256x256 with several pictures at once"),
        (nan, "output score is not finite"),
    ):
        sentence = refusal(cli, tmp_path, text.replace(str(toy_model), str(path)) + OFF, command)
        assert sentence.startswith("config.toml:6: [model] path: ")
        assert path.name in sentence
        assert reason in sentence


def test_an_unknown_key_is_named(cli: Cli, tmp_path: Path, text: str) -> None:
    assert refusal(cli, tmp_path, text + OFF + "baud = 1\n") == "config.toml:11: [mavlink] baud: unknown key"


def test_intrinsics_for_another_resolution_are_refused(cli: Cli, tmp_path: Path, text: str) -> None:
    intrinsics = "[camera.intrinsics]\nfx = 800\nfy = 800\ncx = 320\ncy = 240\nwidth = 640\nheight = 480\n"
    sentence = refusal(cli, tmp_path, text + intrinsics + OFF)
    assert sentence.startswith("config.toml:7: [camera] intrinsics: ")
    assert "640x480" in sentence
    assert "1920x1080" in sentence


def test_a_size_asked_of_a_device_that_its_calibration_is_not_for_is_refused_though_it_is_not_plugged_in(
    cli: Cli, tmp_path: Path
) -> None:
    text = (
        '[camera]\ntype = "device"\ndevice = "/dev/video-none"\nwidth = 640\nheight = 480\n'
        "[camera.intrinsics]\nfx = 2000\nfy = 2000\ncx = 959.5\ncy = 539.5\nwidth = 1920\nheight = 1080\n"
    )
    sentence = refusal(cli, tmp_path, text, "check")
    assert "are for 1920x1080 pixels, but [camera] width and height ask for 640x480" in sentence


def test_a_device_that_is_not_plugged_in_is_told_as_the_picture_that_is_asked_of_it(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(
        '[camera]\ntype = "device"\ndevice = "/dev/video-none"\nwidth = 960\nheight = 540\n[camera.intrinsics]\n'
        "fx = 2000\nfy = 2000\ncx = 959.5\ncy = 539.5\nwidth = 1920\nheight = 1080\ndistortion = [-0.1, 0, 0, 0, 0]\n"
    )
    checked = cli("check", "--config", "config.toml")
    assert checked.returncode == 0, checked.stderr
    told = "/dev/video-none: 960x540, focal length 1000.0 x 1000.0 px, 5 distortion coefficients; not reachable now"
    assert told in checked.stdout


def test_a_model_and_a_calibration_that_are_not_there_are_both_named(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(
        '[camera]\ntype = "device"\nintrinsics = { file = "none.yaml" }\n[model]\npath = "none.onnx"\n'
    )
    done = cli("check", "--config", "config.toml")
    assert done.returncode == 2
    model, camera = done.stderr.splitlines()
    assert model.startswith("config.toml:5: [model] path: ")
    assert camera.startswith("config.toml:3: [camera] intrinsics: ")


def test_a_calibration_that_is_not_there_is_named(cli: Cli, tmp_path: Path) -> None:
    sentence = refusal(cli, tmp_path, '[camera]\ntype = "device"\nintrinsics = { file = "none.yaml" }\n', "check")
    place = f"config.toml:3: [camera] intrinsics: calibration {tmp_path / 'none.yaml'}"
    assert sentence == f"{place} cannot be read: No such file or directory"


def test_a_calibration_with_another_minus_sign_is_named(cli: Cli, tmp_path: Path, text: str) -> None:
    (tmp_path / "nose.yaml").write_text(
        "image_width: 1920\nimage_height: 1080\n"
        "camera_matrix: {rows: 3, cols: 3, data: [2000, 0, 959.5, 0, 2000, 539.5, 0, 0, 1]}\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [\N{MINUS SIGN}0.03, 0.001, 0, 0, 0]\n",
        encoding="utf-8",
    )
    sentence = refusal(cli, tmp_path, text + '[camera.intrinsics]\nfile = "nose.yaml"\n' + OFF, "check")
    place = f"config.toml:7: [camera] intrinsics: calibration {tmp_path / 'nose.yaml'}: distortion_coefficients"
    assert sentence == f"{place} holds '\N{MINUS SIGN}0.03' in place of a number"


def test_an_unreadable_video_is_named(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    (tmp_path / "flight.mp4").write_bytes(b"no video" * 100)
    intrinsics = "[camera.intrinsics]\nfx = 800\nfy = 800\ncx = 320\ncy = 240\nwidth = 640\nheight = 480\n"
    camera = '[camera]\ntype = "file"\npath = "flight.mp4"\n' + intrinsics
    sentence = refusal(cli, tmp_path, camera + f'[model]\npath = "{toy_model}"\n' + OFF)
    assert sentence.startswith("config.toml:3: [camera] path: ")
    assert "flight.mp4 is not a readable video" in sentence


def test_a_zenoh_port_that_is_taken_is_named(cli: Cli, tmp_path: Path, text: str, taken_ports: tuple[int, int]) -> None:
    endpoint = f"tcp/127.0.0.1:{taken_ports[0]}"
    links = f'[zenoh]\nlisten = ["{endpoint}"]\n[mavlink]\nenabled = false\n'
    sentence = refusal(cli, tmp_path, text + links)
    assert sentence == f"config.toml:8: [zenoh] listen: {endpoint} is in use: does another daemon run?"


def test_a_mavlink_port_that_is_taken_is_named(
    cli: Cli, tmp_path: Path, text: str, taken_ports: tuple[int, int]
) -> None:
    links = f'[zenoh]\nenabled = false\n[mavlink]\nendpoints = ["udpin:127.0.0.1:{taken_ports[1]}"]\n'
    sentence = refusal(cli, tmp_path, text + links)
    assert sentence.startswith("config.toml:10: [mavlink] endpoints: ")
    assert str(taken_ports[1]) in sentence


def test_a_port_for_prometheus_that_is_taken_is_named(
    cli: Cli, tmp_path: Path, text: str, taken_ports: tuple[int, int]
) -> None:
    sentence = refusal(cli, tmp_path, text + OFF + f"[health]\nprometheus_port = {taken_ports[0]}\n")
    assert sentence.startswith(f"config.toml:12: [health] prometheus_port: port {taken_ports[0]} of 127.0.0.1 cannot")


def test_a_command_that_a_person_interrupts_ends_without_a_traceback(tmp_path: Path, text: str) -> None:
    links = '[zenoh]\nlisten = ["tcp/127.0.0.1:0"]\n[mavlink]\nendpoints = ["udpin:127.0.0.1:0"]\n'
    (tmp_path / "config.toml").write_text(text + links)
    command = [sys.executable, "-m", "edge.cli", "doctor", "--config", "config.toml"]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell starts what runs in its background with SIGINT ignored, and these tests may run there.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as doctor:
        assert doctor.stdout is not None
        assert any("can listen on" in line for line in doctor.stdout)  # it now listens for an autopilot, for seconds
        doctor.send_signal(signal.SIGINT)
        _, said = doctor.communicate(timeout=60)
    assert doctor.returncode == 130
    assert "Traceback" not in said


@pytest.mark.parametrize("command", ["check", "doctor"])
def test_a_command_whose_words_nobody_reads_ends_without_a_traceback(tmp_path: Path, text: str, command: str) -> None:
    (tmp_path / "config.toml").write_text(text + OFF)
    read_end, write_end = os.pipe()
    os.close(read_end)  # as `| head` does when it has enough
    arguments = [sys.executable, "-m", "edge.cli", command, "--config", "config.toml"]
    done = subprocess.run(arguments, cwd=tmp_path, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("command", ["check", "doctor"])
def test_output_that_a_full_disk_does_not_take_is_a_sentence(tmp_path: Path, text: str, command: str) -> None:
    (tmp_path / "config.toml").write_text(text + OFF)
    words = [sys.executable, "-u", "-m", "edge.cli", command, "--config", str(tmp_path / "config.toml")]
    with open("/dev/full", "w") as full:
        told = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (told.returncode, told.stderr) == (2, "standard output: cannot be written: No space left on device\n")


def test_a_command_without_a_standard_output_does_its_work_all_the_same(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.toml").write_text(text + OFF)
    command = f"{shlex.quote(sys.executable)} -m edge.cli check --config config.toml >&-"  # as some supervisors do
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("encoding", ["iso8859-1", "ascii"])
def test_a_terminal_without_our_characters_gets_the_others(
    cli: Cli, tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", encoding)
    folder = tmp_path / "полёт"
    folder.mkdir()
    (folder / "config.toml").write_text(text + OFF)
    checked = cli("check", "--config", folder / "config.toml")
    assert (checked.returncode, checked.stderr) == (0, "")
    assert f"{tmp_path}/\\u043f" in checked.stdout
    (folder / "config.toml").write_text(text.replace("toy.onnx", "none.onnx") + OFF)
    looked = cli("doctor", "--config", folder / "config.toml")
    assert (looked.returncode, looked.stderr) == (1, "")
    assert "\\u2192 set [model] path to a file" in looked.stdout
    assert looked.stdout.endswith("1 failed\n")


def test_a_signing_key_that_the_disk_has_no_room_for_leaves_no_empty_file(tmp_path: Path) -> None:
    keygen = f"{shlex.quote(sys.executable)} -m edge.cli keygen --out mavlink.key"
    for limit, code, words in (
        ("ulimit -f 0", 2, "mavlink.key cannot be written: File too large\n"),
        ("true", 0, ""),
    ):
        done = subprocess.run(["sh", "-c", f"{limit}; exec {keygen}"], cwd=tmp_path, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (code, words)
    assert (tmp_path / "mavlink.key").stat().st_size == 32


def test_nobody_is_told_of_a_flight_by_the_library_that_runs_the_network(
    cli: Cli, tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ONNX Runtime's telemetry begins with a number for the machine and a store of what is to be sent."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    for variable in ("XDG_CACHE_HOME", "ORT_DISABLE_TELEMETRY", "CI"):
        monkeypatch.delenv(variable, raising=False)
    (tmp_path / "config.toml").write_text(text + OFF)
    assert cli("check", "--config", "config.toml").returncode == 0
    assert list(home.rglob("*")) == []


HANG_UP_WHILE_IMPORTING = """
import importlib.abc, os, signal, sys

class HangUp(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "edge.daemon":
            os.kill(os.getpid(), signal.SIGHUP)

sys.meta_path.insert(0, HangUp())
from edge.cli import main
sys.exit(main())
"""


def test_a_reload_asked_of_a_daemon_that_is_still_starting_does_not_end_it(tmp_path: Path, text: str) -> None:
    with flying(tmp_path, text + OFF, program=("-c", HANG_UP_WHILE_IMPORTING)) as flight:
        flight.until("stopped: ")
        assert flight.process.wait(60) == 0


def test_the_daemon_needs_no_torch_and_nothing_of_the_trainer_or_the_replay() -> None:
    code = (
        "import sys, edge.daemon, edge.check, edge.bench.measure, edge.cli\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('torch', 'onnx', 'trainer', 'sim_replay')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
