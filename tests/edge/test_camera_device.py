"""What a V4L2 device is asked for, and what becomes of its frames. No driver is here: a stand-in for OpenCV's capture
answers."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Event

import cv2
import numpy as np
import pytest

from edge.cameras.capture import Capture
from edge.cameras.device import BUFFERS, EXPOSURE_MANUAL, DeviceSource
from edge.cameras.live import UNDECODABLE_MAX
from edge.cameras.source import EndOfStream, SourceLost
from edge.config_camera import DeviceCamera
from edge.errors import InputError

from .pictures import INTRINSICS, SIZE_WH

MJPG = cv2.VideoWriter.fourcc(*"MJPG")
EXPOSURES = {cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE}


PICTURE = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
TORN, EMPTY, GONE = object(), object(), object()


class Driver:
    """In place of cv2.VideoCapture: keeps what it is set to, but for the properties that it lacks."""

    def __init__(self, lacks: set[int], exposure_most: float) -> None:
        self._lacks, self._exposure_most = lacks, exposure_most
        self.opened: tuple[str, int] | None = None
        self.held: dict[int, float] = {}
        self.asked: list[int] = []
        self.opens = self.releases = 0
        self.comes: Iterator[object] = iter(())  # for each grab a picture, TORN, or GONE
        self._grabbed: object = None

    def __call__(self, device: str, api: int) -> Driver:
        self.opened = (device, api)
        self.opens += 1
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

    def grab(self) -> bool:
        self._grabbed = next(self.comes)
        return self._grabbed is not GONE

    def retrieve(self) -> tuple[bool, object]:
        if self._grabbed is TORN:
            raise cv2.error("cannot decode")
        return self._grabbed is not EMPTY, self._grabbed

    def release(self) -> None:
        self.releases += 1


def settings(exposure_ms: float | None = None, latency_ms: float = 0.0) -> DeviceCamera:
    width, height = SIZE_WH
    return DeviceCamera(
        type="device",
        device="/dev/video3",
        width=width,
        height=height,
        fps=60,
        exposure_ms=exposure_ms,
        latency_ms=latency_ms,
        intrinsics=INTRINSICS,
    )


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    driver = Driver(set(), 1000.0)
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", driver)
    return driver


def test_a_picture_that_cannot_be_decoded_is_left_out_and_the_device_stays_open(driver: Driver) -> None:
    source = DeviceSource(settings())
    source.open()
    driver.comes = iter([PICTURE, TORN, EMPTY, PICTURE])
    frames = [source.read(Event()) for _ in range(2)]
    assert [frame.meta.sequence for frame in frames] == [0, 3]
    assert source.counts["undecodable"] == 2
    assert driver.opens == 1
    stop, driver.comes = Event(), iter([PICTURE])
    stop.set()
    with pytest.raises(EndOfStream):
        source.read(stop)


def test_a_device_that_is_pulled_out_or_gives_nothing_but_torn_pictures_is_lost_and_opened_again(
    driver: Driver,
) -> None:
    source = DeviceSource(settings())
    for comes, why in ([PICTURE, GONE], "no more frames"), ([PICTURE, *[TORN] * UNDECODABLE_MAX], "cannot be decoded"):
        source.open()
        driver.comes = iter(comes)
        source.read(Event())
        with pytest.raises(SourceLost, match=why):
            source.read(Event())
        source.close()
    source.open()
    driver.comes = iter([PICTURE])
    assert source.read(Event()).meta.sequence == UNDECODABLE_MAX + 2
    assert (driver.opens, driver.releases) == (3, 2), "it could not be opened again while it is held"


def test_a_device_that_says_no_size_is_tried_again_and_not_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", Driver({cv2.CAP_PROP_FRAME_WIDTH}, 1000.0))
    with pytest.raises(SourceLost, match=r"/dev/video3 does not say the size of its picture"):
        DeviceSource(settings()).open()


class Modes(Driver):
    """Gives twenty pictures each time it is opened, and is of another shape the times that are told."""

    def __init__(self, misfits: tuple[int, ...]) -> None:
        super().__init__(set(), 1000.0)
        self._misfits = misfits

    def __call__(self, device: str, api: int) -> Driver:
        super().__call__(device, api)
        self.comes = iter([*(np.full_like(PICTURE, shade) for shade in range(20)), GONE])
        return self

    def get(self, prop: int) -> float:
        lower = prop == cv2.CAP_PROP_FRAME_HEIGHT and self.opens in self._misfits
        return super().get(prop) - 100 * lower


def test_a_device_that_comes_back_in_another_mode_is_opened_until_it_is_in_its_own(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    modes, told = Modes((2,)), set()
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", modes)
    capture = Capture(DeviceSource(settings()), False)
    capture.start()
    try:
        while modes.opens < 4 or capture.newest(20.0) is None:
            told |= {(reason.kind, reason.text) for reason in capture.reasons(0)}
            capture.newest(0.05)
    finally:
        capture.stop()
    assert {kind for kind, text in told if text.startswith("camera lost: these intrinsics are for")} == {"camera_lost"}
    warned = [text for text in caplog.messages if text.startswith("camera lost: ")]
    assert warned[:2] == ["camera lost: the camera gives no more frames; trying again"] * 2, (
        "at each loss, not each try"
    )


def test_a_device_that_never_fitted_ends_the_daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    modes = Modes((1, 2))
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", modes)
    capture = Capture(DeviceSource(settings()), False)
    capture.start()
    with pytest.raises(InputError, match="these intrinsics are for"):
        capture.newest(20.0)
    capture.stop()
    assert modes.releases == modes.opens


def test_the_drivers_stamp_is_the_exposure_less_the_latency_and_without_one_the_arrival_is(driver: Driver) -> None:
    stamped, unstamped = DeviceSource(settings(latency_ms=7.0)), DeviceSource(settings(latency_ms=7.0))
    driver.comes = iter([PICTURE, PICTURE])
    exposed_ns = time.monotonic_ns() - 25_000_000
    stamped.open()
    driver.held[cv2.CAP_PROP_POS_MSEC] = exposed_ns / 1e6
    assert stamped.read(Event()).meta.capture_ns == pytest.approx(exposed_ns - 7_000_000, abs=2000)
    assert stamped.counts["unstamped"] == 0
    unstamped.open()
    driver.held[cv2.CAP_PROP_POS_MSEC] = 0.0
    meta = unstamped.read(Event()).meta
    assert meta.capture_ns == meta.arrival_ns - 7_000_000
    assert unstamped.counts["unstamped"] == 1


def opened(
    monkeypatch: pytest.MonkeyPatch,
    exposure_ms: float | None,
    lacks: set[int] | None = None,
    exposure_most: float = 1000.0,
) -> Driver:
    driver = Driver(lacks or set(), exposure_most)
    monkeypatch.setattr("edge.cameras.device.cv2.VideoCapture", driver)
    info = DeviceSource(settings(exposure_ms)).open()
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
        cv2.CAP_PROP_BUFFERSIZE: BUFFERS,
        cv2.CAP_PROP_AUTO_EXPOSURE: EXPOSURE_MANUAL,
        cv2.CAP_PROP_EXPOSURE: 25,  # V4L2 counts in 100 microseconds
    }
    assert wanted.items() <= driver.held.items()
    # The size goes with the format, and a driver takes an exposure only once it does not choose it itself.
    assert driver.asked.index(cv2.CAP_PROP_FOURCC) < driver.asked.index(cv2.CAP_PROP_FRAME_WIDTH)
    assert driver.asked.index(cv2.CAP_PROP_AUTO_EXPOSURE) < driver.asked.index(cv2.CAP_PROP_EXPOSURE)
    assert caplog.messages == []


def test_before_a_device_answers_it_is_told_as_it_is_asked_for() -> None:
    width, height = SIZE_WH
    asked = settings().model_copy(update={"width": 2 * width, "height": 2 * height})
    info = DeviceSource(asked).nominal()
    assert (info.image_size_wh, info.K[0, 0], info.frame_rate_hz) == ((2 * width, 2 * height), 600.0, None)


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
