"""`uavpose-edge align` as a process, between a camera whose stamps are late and an autopilot."""

from __future__ import annotations

import csv
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.align.collect import collect
from edge.align.fit import UnknownError
from edge.config import load_config
from edge.errors import InputError
from msgs.cdr import CompressedImage
from msgs.publish import TopicPublisher
from sim_replay.ports import free_port
from sim_replay.telemetry import COLUMNS

from .conftest import Cli
from .panorama import Panorama
from .test_cameras_live import router

SIZE_WH, FPS = (320, 180), 15
K = np.array([[250.0, 0.0, 159.5], [0.0, 250.0, 89.5], [0.0, 0.0, 1.0]])
FORWARD_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
LATE_S, ON_THE_WAY_S = 0.06, 0.02
ROLL_DEG, PITCH_DEG, YAW_DEG = 4.0, -12.0, 25.0
FLOWN_S = 60.0


def attitude(t_s: np.ndarray) -> Rotation:
    """Turned by hand, to and fro about all axes, unevenly."""
    waves = ((0.31, 0.53, 0.2), (0.41, 0.63, 1.1), (0.23, 0.57, 2.0))
    angles = [
        a * (np.sin(6.28 * f * t_s + p) + np.sin(6.28 * g * t_s))
        for a, (f, g, p) in zip((0.15, 0.12, 0.2), waves, strict=True)
    ]
    return Rotation.from_euler("ZYX", np.stack(angles[::-1], axis=-1))


def write_telemetry(path: Path) -> None:
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        for t_s in np.arange(0.0, FLOWN_S, 0.01):
            q = np.roll(attitude(np.array([t_s])).as_quat()[0], 1)
            turn = (attitude(np.array([t_s - 1e-4])).inv() * attitude(np.array([t_s + 1e-4]))).as_rotvec()[0] / 2e-4
            rows.writerow([round(t_s * 1e9), *q, *turn, 0, 0, -50, 0, 0, 0, 47.0, 8.0, 500.0])


def film(publisher: TopicPublisher, start_ns: int, over: threading.Event) -> None:
    """Pictures of each moment, stamped too late."""
    panorama, utc_ns = Panorama(K, SIZE_WH), time.time_ns() - time.monotonic_ns()
    mount = Rotation.from_euler("ZYX", [YAW_DEG, PITCH_DEG, ROLL_DEG], degrees=True) * Rotation.from_matrix(FORWARD_CAM)
    number = 0
    while not over.is_set():
        number = max(number + 1, int((time.monotonic_ns() - start_ns) / 1e9 * FPS))
        exposed_s = number / FPS
        image = panorama.picture(attitude(np.array([exposed_s]))[0] * mount)
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        there_ns = start_ns + round((exposed_s + LATE_S + ON_THE_WAY_S) * 1e9)
        over.wait(max(0.0, (there_ns - time.monotonic_ns()) / 1e9))
        stamp_ns = start_ns + utc_ns + round((exposed_s + LATE_S) * 1e9)
        publisher.put(CompressedImage(stamp_ns, "camera_optical_frame", "jpeg", jpeg).encode())


@contextmanager
def turned_by_hand(folder: Path, camera_port: int, mavlink_port: int) -> Iterator[None]:
    """A camera on zenoh and an autopilot on UDP, of one vehicle."""
    write_telemetry(folder / "telemetry.csv")
    start_ns, over = time.monotonic_ns(), threading.Event()
    command = [sys.executable, "-m", "sim_replay.autopilot", "--telemetry", str(folder / "telemetry.csv")]
    command += ["--endpoint", f"127.0.0.1:{mavlink_port}", "--start-at-ns", str(start_ns)]
    with router(camera_port) as publisher, subprocess.Popen(command, stdout=subprocess.DEVNULL) as autopilot:
        camera = threading.Thread(target=film, args=(publisher, start_ns, over))
        camera.start()
        try:
            yield
        finally:
            over.set()
            autopilot.terminate()
            camera.join()


def config(camera_port: int, mavlink_port: int, camera: str = "", more: str = "") -> str:
    return (
        f'[camera]\ntype = "zenoh"\ntopic = "nose/image/compressed"\nconnect = "tcp/127.0.0.1:{camera_port}"\n'
        "intrinsics = { fx = 250, fy = 250, cx = 159.5, cy = 89.5, width = 320, height = 180 }\n"
        f'{camera}[mavlink]\nendpoints = ["udpin:127.0.0.1:{mavlink_port}"]\n{more}[zenoh]\nenabled = false\n'
    )


def test_mount_and_latency_are_those_of_the_camera(cli: Cli, tmp_path: Path) -> None:
    camera_port, mavlink_port = free_port(), free_port()
    configured = "[mount]\npitch_deg = -10.0\n"
    (tmp_path / "flight.toml").write_text(config(camera_port, mavlink_port, "latency_ms = 10.0\n", configured))
    with turned_by_hand(tmp_path, camera_port, mavlink_port):
        done = cli("align", "--config", "flight.toml", "--seconds", "8", "--json")
    assert done.returncode == 0, done
    found = json.loads(done.stdout)
    mount, latency, focal = found["mount"], found["latency"], found["focal"]
    for axis, true_deg in (("roll", ROLL_DEG), ("pitch", PITCH_DEG), ("yaw", YAW_DEG)):
        assert abs(mount[f"{axis}_deg"] - true_deg) < mount["sure_deg"][axis] < 0.5
    assert mount["configured_deg"]["pitch"] == -10.0
    assert abs(latency["ms"] - 1e3 * LATE_S) < latency["sure_ms"]
    assert latency["configured_ms"] == 10.0
    assert focal["fits"]


def test_ctrl_c_ends_the_turning_and_says_what_is_missing(tmp_path: Path) -> None:
    camera_port, mavlink_port = free_port(), free_port()
    (tmp_path / "flight.toml").write_text(config(camera_port, mavlink_port))
    command = [sys.executable, "-m", "edge.cli", "align", "--config", str(tmp_path / "flight.toml")]
    with (
        turned_by_hand(tmp_path, camera_port, mavlink_port),
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        assert any("turn the vehicle now" in line for line in process.stderr)
        process.send_signal(signal.SIGINT)
        said = process.stdout.read()
    assert process.returncode == 1
    assert said.startswith("nothing is known: the camera's turn was seen only ")


@pytest.mark.parametrize(
    ("camera", "mavlink", "why"),
    [
        ('mount = "gimbal"', "", "flight.toml:4: [camera] mount: a camera on a gimbal"),
        ("", "enabled = false", "flight.toml:7: [mavlink] enabled: the autopilot's attitude is needed"),
        ("", "", "Address already in use"),
    ],
)
def test_what_cannot_be_measured_as_configured_is_refused(
    tmp_path: Path, scene: Path, camera: str, mavlink: str, why: str
) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        text = f'[camera]\ntype = "sequence"\npath = "{scene}"\n{camera}\n\n'
        text += f'[mavlink]\n{mavlink}\nendpoints = ["{endpoint}"]\n[zenoh]\nenabled = false\n'
        (tmp_path / "flight.toml").write_text(text)
        with pytest.raises(InputError, match=re.escape(why)):
            collect(load_config(tmp_path / "flight.toml"), 10.0, threading.Event)


def test_without_an_autopilot_that_is_said(tmp_path: Path, scene: Path) -> None:
    text = f'[camera]\ntype = "sequence"\npath = "{scene}"\nfps = 100\n[zenoh]\nenabled = false\n'
    (tmp_path / "flight.toml").write_text(f'{text}[mavlink]\nendpoints = ["udpin:127.0.0.1:0"]\n')
    with pytest.raises(UnknownError, match="no attitude came: check that the autopilot is on"):
        collect(load_config(tmp_path / "flight.toml"), 10.0, threading.Event)
