"""What a V4L2 device is asked for when it is opened. No driver is here: a stand-in for OpenCV's capture is asked."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge.cameras.device import EXPOSURE_MANUAL, DeviceSource
from edge.config_camera import DeviceCamera

from .pictures import INTRINSICS, SIZE_WH

MJPG = cv2.VideoWriter.fourcc(*"MJPG")
EXPOSURES = {cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE}


class Driver:
    """In place of cv2.VideoCapture: keeps what it is set to, but for the properties that it lacks."""

    def __init__(self, lacks: set[int], exposure_most: float) -> None:
        self._lacks, self._exposure_most = lacks, exposure_most
        self.opened: tuple[str, int] | None = None
        self.held: dict[int, float] = {}
        self.asked: list[int] = []

    def __call__(self, device: str, api: int) -> Driver:
        self.opened = (device, api)
        return self

    def isOpened(self) -> bool:
        return True

    def set(self, prop: int, value: float) -> bool:
        self.asked.append(prop)
        if prop in self._lacks:
            return False
        self.held[prop] = min(value, self._exposure_most) if prop == cv2.CAP_PROP_EXPOSURE else value
        return True

    def get(self, prop: int) -> float:
        return self.held.get(prop, 0.0)


def opened(
    monkeypatch: pytest.MonkeyPatch,
    exposure_ms: float | None,
    lacks: set[int] | None = None,
    exposure_most: float = 1000.0,
) -> Driver:
    driver = Driver(lacks or set(), exposure_most)
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", driver)
    width, height = SIZE_WH
    settings = DeviceCamera(
        type="device",
        device="/dev/video3",
        width=width,
        height=height,
        fps=60,
        exposure_ms=exposure_ms,
        intrinsics=INTRINSICS,
    )
    info = DeviceSource(settings).open()
    assert (info.name, info.image_size_wh, info.frame_rate_hz) == ("/dev/video3", SIZE_WH, 60)
    np.testing.assert_array_equal(info.K[0], [300, 0, 159.5])
    return driver


def test_format_size_rate_and_exposure_are_asked_of_the_driver(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    driver = opened(monkeypatch, exposure_ms=2.5)
    assert driver.opened == ("/dev/video3", cv2.CAP_V4L2)
    width, height = SIZE_WH
    wanted = {
        cv2.CAP_PROP_FOURCC: MJPG,
        cv2.CAP_PROP_FRAME_WIDTH: width,
        cv2.CAP_PROP_FRAME_HEIGHT: height,
        cv2.CAP_PROP_FPS: 60,
        cv2.CAP_PROP_AUTO_EXPOSURE: EXPOSURE_MANUAL,
        cv2.CAP_PROP_EXPOSURE: 25,  # V4L2 counts in 100 microseconds
    }
    assert wanted.items() <= driver.held.items()
    # The size goes with the format, and a driver takes an exposure only once it does not choose it itself.
    assert driver.asked.index(cv2.CAP_PROP_FOURCC) < driver.asked.index(cv2.CAP_PROP_FRAME_WIDTH)
    assert driver.asked.index(cv2.CAP_PROP_AUTO_EXPOSURE) < driver.asked.index(cv2.CAP_PROP_EXPOSURE)
    assert caplog.messages == []


def test_an_exposure_that_is_not_set_is_left_to_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not EXPOSURES & set(opened(monkeypatch, exposure_ms=None).asked)


@pytest.mark.parametrize("lacking", sorted(EXPOSURES))
def test_a_driver_without_exposure_is_told_and_looked_through_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lacking: int
) -> None:
    opened(monkeypatch, exposure_ms=2.5, lacks={lacking})
    assert caplog.messages == ["/dev/video3 does not let its exposure be set"]


def test_an_exposure_that_the_driver_cuts_short_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    opened(monkeypatch, exposure_ms=40.0, exposure_most=166.0)
    assert caplog.messages == ["/dev/video3 exposes for 16.6 ms, not 40"]
