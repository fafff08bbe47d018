"""What a person is told of a camera is true of the pictures that come, not of those that were expected."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import zenoh

from edge.cameras.capture import Capture
from edge.cameras.watch import RIVALS_TOLD_NS
from edge.cameras.zenoh_topic import ZenohSource
from edge.status import ask
from msgs.cdr import CompressedImage
from msgs.publish import Node
from msgs.session import client_config
from msgs.topics import IMAGE
from sim_replay.ports import free_port
from tests.waiting import until

from .conftest import Cli
from .flying import flying
from .test_cameras_live import deep_png, message, router, zenoh_camera

HALF_WH = (160, 90)  # of what the calibration is for
NONE: dict[str, Any] = {"info": {}}


@contextmanager
def filming(port: int, payload: Callable[[int], bytes], period_s: float = 0.05) -> Iterator[None]:
    """A router and a camera behind it, which sends `payload` of 0, 1, … until the context ends."""
    over = threading.Event()
    with router(port) as publisher:

        def film() -> None:
            for index in count():
                publisher.put(payload(index))
                if over.wait(period_s):
                    return

        camera = threading.Thread(target=film)
        camera.start()
        try:
            yield
        finally:
            over.set()
            camera.join()


def text_of(camera_port: int, zenoh_port: int, model: Path) -> str:
    """A configuration that looks through `filming`'s camera, 320x180 by its calibration."""
    return (
        f'[camera]\ntype = "zenoh"\ntopic = "nose/image/compressed"\nconnect = "tcp/127.0.0.1:{camera_port}"\n'
        "intrinsics = { fx = 300, fy = 300, cx = 159.5, cy = 89.5, width = 320, height = 180 }\n"
        f'[model]\npath = "{model}"\nthreads = 1\n'
        f'[zenoh]\nlisten = ["tcp/127.0.0.1:{zenoh_port}"]\n[mavlink]\nenabled = false\n'
    )


def camera_finding(cli: Cli, tmp_path: Path, text: str) -> dict[str, Any]:
    (tmp_path / "config.toml").write_text(text)
    done = cli("doctor", "--config", "config.toml", "--json")
    found = json.loads(done.stdout)["findings"]
    assert (done.returncode == 0) == all(finding["verdict"] != "wrong" for finding in found)
    return next(finding for finding in found if finding["what"] == "camera")


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (
            message(1, (300, 200)),
            "the last is of another shape: these intrinsics are for 320x180 pixels, but the camera",
        ),
        (CompressedImage(1, "", "png", deep_png()).encode(), "the last cannot be decoded, or has more than 8 bits"),
        (b"no message", "the last is no sensor_msgs/CompressedImage"),
    ],
)
def test_a_camera_none_of_whose_pictures_can_be_used_is_not_told_as_one_that_sends_none(
    payload: bytes, why: str
) -> None:
    port = free_port()
    with filming(port, lambda _: payload):
        capture = Capture(ZenohSource(zenoh_camera(port)), opened=False)
        capture.start()

        def told() -> str:
            return "; ".join(reason.text for reason in capture.reasons(0))

        try:
            until(lambda: why in told(), what=why)
            assert "none can be used" in told()
        finally:
            capture.stop()


def test_status_and_doctor_tell_the_size_of_the_pictures_that_come(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    camera_port, asked_at = free_port(), free_port()
    text = text_of(camera_port, asked_at, toy_model)

    def told() -> str:
        return str((ask(f"tcp/127.0.0.1:{asked_at}", "uav1") or NONE)["info"].get("camera"))

    size_wh = [HALF_WH]
    with filming(camera_port, lambda index: message(index, size_wh[0])):
        found = camera_finding(cli, tmp_path, text)
        assert "160x90" in found["says"], found
        with flying(tmp_path, text):
            assert told() == "nose/image/compressed 160x90"
            assert "160x90" in camera_finding(cli, tmp_path, text)["says"]
            size_wh[0] = (320, 180)  # switched in flight
            until(lambda: told() == "nose/image/compressed 320x180", what="the new size")


def test_a_camera_that_changes_its_mode_in_flight_is_told_of_until_it_is_in_its_first_again(
    tmp_path: Path, toy_model: Path
) -> None:
    """Its smaller pictures may be scaled, as is assumed, or cut out: then all ranges are wrong."""
    camera_port, asked_at = free_port(), free_port()

    def sizes_told() -> list[str]:
        told = (ask(f"tcp/127.0.0.1:{asked_at}", "uav1") or NONE)["info"]
        kinds = zip(told.get("reason_kinds", []), told.get("reasons", []), strict=True)
        return [text for kind, text in kinds if kind == "camera_size"]

    size_wh = [(320, 180)]
    text = text_of(camera_port, asked_at, toy_model)
    with filming(camera_port, lambda index: message(index, size_wh[0])), flying(tmp_path, text):
        until(lambda: bool((ask(f"tcp/127.0.0.1:{asked_at}", "uav1") or NONE)["info"].get("state")), what="a state")
        assert sizes_told() == []
        size_wh[0] = HALF_WH
        words = "camera: pictures are 160x90, no longer 320x180; ranges are right only if they show the same view"
        until(lambda: sizes_told() == [words], what="the other mode")
        size_wh[0] = (320, 180)
        until(lambda: sizes_told() == [], what="the first mode")


def test_two_cameras_on_one_topic_are_told_of_while_there_are_two() -> None:
    """Which of them is used is chance: it may be the one that [mount] and the calibration are not of."""
    port = free_port()
    with filming(port, message), zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
        other = Node(session, "nose", name="rear").publisher(IMAGE)
        capture = Capture(ZenohSource(zenoh_camera(port)), opened=False)
        capture.start()

        def told(at_ns: int) -> list[str]:
            return [reason.text for reason in capture.reasons(at_ns) if reason.kind == "camera_contested"]

        try:
            until(lambda: capture.newest(0.1) is not None, what="the first camera")
            assert told(time.monotonic_ns()) == []
            words = "camera: somebody else sends pictures on its topic too; only those of the first are used"
            until(lambda: told(time.monotonic_ns()) == [words], lambda: other.put(message(9)), what="the second")
            other.close()
            until(lambda: told(time.monotonic_ns() + RIVALS_TOLD_NS) == [], what="one camera again")
        finally:
            capture.stop()


def test_doctor_does_not_take_a_frozen_camera_for_a_good_one(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    camera_port = free_port()
    with filming(camera_port, lambda _: message(1)):
        found = camera_finding(cli, tmp_path, text_of(camera_port, free_port(), toy_model))
    assert found["verdict"] == "wrong", found
    assert "camera frozen" in found["says"]
    assert "plug it in again" in found["advice"]


def test_doctor_says_why_no_picture_came(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    camera_port = free_port()
    with filming(camera_port, lambda _: message(1, (300, 200))):
        found = camera_finding(cli, tmp_path, text_of(camera_port, free_port(), toy_model))
    assert found["verdict"] == "wrong", found
    assert "300x200" in found["says"], found
