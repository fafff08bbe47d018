"""What `uavpose-edge doctor` says of a camera, by its own look or by the running daemon's."""

from __future__ import annotations

import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edge.config import load_config
from edge.doctor import ADVICE_NO_STREAM, _camera, camera_as_told, shortfalls
from msgs.publish import TopicPublisher
from sim_replay.ports import free_port

from . import pictures
from .conftest import Cli
from .test_cameras_live import message, router


def test_a_camera_whose_stamps_do_not_advance_has_no_rate(tmp_path: Path) -> None:
    """As of a driver that stamps in whole seconds."""
    port, over = free_port(), threading.Event()
    intrinsics = "{ fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }"
    (tmp_path / "config.toml").write_text(
        '[camera]\ntype = "zenoh"\ntopic = "nose/image/compressed"\n'
        f'connect = "tcp/127.0.0.1:{port}"\nintrinsics = {intrinsics}\n'
    )

    def publish(publisher: TopicPublisher, stamp_ns: int) -> None:
        index = count()
        while not over.wait(0.02):
            publisher.put(message(next(index), stamp_ns=stamp_ns))

    with router(port) as publisher, ThreadPoolExecutor() as pool:
        pool.submit(publish, publisher, time.time_ns())
        try:
            ((found, rate_hz),) = _camera(load_config(tmp_path / "config.toml"))
        finally:
            over.set()
    assert (found.says.partition(";")[0], rate_hz) == ("nose/image/compressed: 320x180", None)


def test_a_mask_of_the_own_ship_that_the_daemon_would_refuse_is_told(tmp_path: Path, scene: Path) -> None:
    (tmp_path / "config.toml").write_text(f'[camera]\ntype = "sequence"\npath = "{scene}"\nown_ship_mask = "own.png"\n')
    ((found, rate_hz),) = _camera(load_config(tmp_path / "config.toml"))
    assert (found.verdict, rate_hz) == ("wrong", None)
    assert f"{tmp_path}/own.png cannot be read" in found.says


@pytest.mark.parametrize(("level", "told", "advice"), [(3, "the picture is dark", "cap"), (120, "", "")])
def test_a_covered_lens_is_told(tmp_path: Path, level: float, told: str, advice: str) -> None:
    (tmp_path / "images").mkdir()
    for index in range(20):
        noise = np.random.default_rng(index).normal(level, 2.0, (180, 320, 3)).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{index:02d}.png"), noise)
    intrinsics = "{ fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }"
    (tmp_path / "config.toml").write_text(
        f'[camera]\ntype = "folder"\npath = "images"\nfps = 10\nintrinsics = {intrinsics}\n'
    )
    ((found, _),) = _camera(load_config(tmp_path / "config.toml"))
    assert found.verdict == ("poor" if told else "good")
    assert told in found.says
    assert advice in found.advice


class Driver:
    """In place of cv2.VideoCapture: `given_hz` pictures a second, stamped in UTC or on our clock, some torn."""

    def __init__(self, given_hz: float, utc: bool, torn_every: int) -> None:
        self._given_hz, self._utc, self._torn_every = given_hz, utc, torn_every
        self._grabbed, self._taken_ms = 0, 0.0

    def __call__(self, device: str, api: int) -> Driver:
        return self

    def isOpened(self) -> bool:
        return True

    def set(self, prop: int, value: float) -> bool:
        return True

    def get(self, prop: int) -> float:
        size = {cv2.CAP_PROP_FRAME_WIDTH: pictures.SIZE_WH[0], cv2.CAP_PROP_FRAME_HEIGHT: pictures.SIZE_WH[1]}
        return self._taken_ms if prop == cv2.CAP_PROP_POS_MSEC else size.get(prop, 0.0)

    def grab(self) -> bool:
        time.sleep(1 / self._given_hz)
        self._taken_ms = time.time() * 1e3 if self._utc else time.monotonic() * 1e3
        self._grabbed += 1
        return True

    def retrieve(self) -> tuple[bool, Any]:
        torn = self._torn_every > 0 and self._grabbed % self._torn_every == 0
        return not torn, None if torn else pictures.picture(self._grabbed % 8)

    def release(self) -> None:
        pass


@pytest.mark.parametrize(
    ("driver", "verdict", "words", "advice"),
    [
        (Driver(20, utc=False, torn_every=0), "good", "320x180", ""),
        (
            Driver(12, utc=True, torn_every=0),
            "poor",
            "impossible timestamps replaced by the arrival time",
            "latency_ms",
        ),
        (Driver(24, utc=False, torn_every=2), "poor", "images could not be decoded", "cable"),
        (Driver(7, utc=False, torn_every=0), "poor", "[camera] fps is 12, but only ", "light"),
    ],
)
def test_a_device_with_wrong_stamps_torn_pictures_or_half_its_rate_is_not_told_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driver: Driver, verdict: str, words: str, advice: str
) -> None:
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", driver)
    monkeypatch.setattr("edge.doctor.LIVE_FRAMES", 10)
    monkeypatch.setattr("edge.doctor.WATCHED_S", 1.3)
    (tmp_path / "config.toml").write_text(
        '[camera]\ntype = "device"\ndevice = "/dev/null"\nfps = 12\nwidth = 320\nheight = 180\n'
        "intrinsics = { fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }\n"
    )
    ((found, rate_hz),) = _camera(load_config(tmp_path / "config.toml"))
    assert (found.verdict, words in found.says, advice in found.advice) == (verdict, True, True), found
    assert rate_hz is not None


class Absent(BaseHTTPRequestHandler):
    """Of a server that has nothing."""

    def do_GET(self) -> None:
        self.send_error(404)


def test_the_advice_on_a_stream_that_does_not_open_shows_what_its_server_answers(
    cli: Cli, tmp_path: Path, toy_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = re.search(r"(OPENCV_FFMPEG_LOGLEVEL)=(\d+)", ADVICE_NO_STREAM)
    assert told is not None
    with ThreadingHTTPServer(("127.0.0.1", 0), Absent) as server, ThreadPoolExecutor() as pool:
        pool.submit(server.serve_forever)
        (tmp_path / "config.toml").write_text(
            f'[camera]\ntype = "stream"\nurl = "http://127.0.0.1:{server.server_port}/none"\n'
            "intrinsics = { fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }\n"
            f'[model]\npath = "{toy_model}"\n[zenoh]\nenabled = false\n[mavlink]\nenabled = false\n'
        )
        try:
            before = cli("doctor", "--config", "config.toml")
            monkeypatch.setenv(*told.groups())
            after = cli("doctor", "--config", "config.toml")
        finally:
            server.shutdown()
    assert ADVICE_NO_STREAM in before.stdout
    assert "404 Not Found" not in before.stdout + before.stderr
    assert "404 Not Found" in after.stdout + after.stderr


def test_a_tenth_of_bad_pictures_and_four_fifths_of_the_rate_are_tolerated() -> None:
    counted = {"captured": 50, "camera_unstamped": 5, "camera_undecodable": 5}
    assert list(shortfalls(counted, 24.0, 30.0)) == []
    assert list(shortfalls({"captured": 50}, 5.0, None)) == []  # a recording; too little seen to judge the rate
    assert list(shortfalls({"captured": 50}, None, 30.0)) == []
    counted = {"captured": 50, "camera_unstamped": 6, "camera_undecodable": 6}
    assert [kind for kind, _ in shortfalls(counted, 23.9, 30.0)] == [
        "camera_unstamped", "camera_undecodable", "camera_slow",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("camera_stamps", "timestamp"),
        ("camera_frozen", "moves"),
        ("camera_dark", "cap"),
        ("camera_fixed_places", "own_ship_mask"),
        ("camera_damaged", "rtsp_transport"),
        ("camera_lost", "plugged in"),
        ("no_frame", "plugged"),
    ],
)
def test_each_fault_of_a_camera_that_the_daemon_has_gets_its_own_advice(kind: str, advice: str) -> None:
    running = {
        "camera": "/dev/video0",
        "state": "degraded",
        "reason_kinds": ["drops", kind],
        "reasons": ["3 % of frames dropped", "so it is"],
    }
    ((found, _),) = camera_as_told(running)
    assert (found.verdict, found.says, advice in found.advice) == (
        "wrong",
        "reported by the running daemon: so it is",
        True,
    )
