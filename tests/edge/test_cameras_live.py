"""Cameras that others run: a zenoh topic, devices, calibrations that are refused."""

from __future__ import annotations

import struct
import threading
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zenoh

from edge.cameras import zenoh_topic
from edge.cameras.capture import Capture
from edge.cameras.device import complaints
from edge.cameras.intrinsics import read_calibration
from edge.cameras.source import EndOfStream, SourceLost
from edge.cameras.zenoh_topic import ZenohSource, decode_picture, picture_size_wh
from edge.config_camera import DeviceCamera, ZenohCamera
from edge.errors import InputError
from edge.types import Frame
from msgs import topics
from msgs.cdr import CompressedImage
from msgs.publish import Node, TopicPublisher
from msgs.session import client_config, router_config
from sim_replay.ports import free_port
from tests.waiting import until

from .pictures import INTRINSICS, LENS, SIZE_WH, number_of, picture

PERIOD_NS = 33_333_333


def message(index: int, size_wh: tuple[int, int] = SIZE_WH, stamp_ns: int | None = None) -> bytes:
    _, png = cv2.imencode(".png", picture(index, size_wh))
    now_ns = time.time_ns() if stamp_ns is None else stamp_ns
    return CompressedImage(now_ns, "camera_optical_frame", "png", png.tobytes()).encode()


def deep_png() -> bytes:
    """As of a mono camera of 12 bits: nearly black, if the upper 8 of its 16 were taken."""
    _, png = cv2.imencode(".png", np.full((SIZE_WH[1], SIZE_WH[0]), 4095, np.uint16))
    return bytes(png.tobytes())


def turned_jpeg(index: int) -> bytes:
    """A picture whose EXIF says that it is to be shown turned by a quarter."""
    _, jpeg = cv2.imencode(".jpg", picture(index))
    orientation = b"II*\0\x08\0\0\0\x01\0" + b"\x12\x01\x03\0\x01\0\0\0\x06\0\0\0" + b"\0\0\0\0"
    body = b"Exif\0\0" + orientation
    data = jpeg.tobytes()
    return bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])


def empty_png(size_wh: tuple[int, int]) -> bytes:
    """Small, whatever its size: all black."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    width, height = size_wh
    pixels = zlib.compress(bytes((width + 1) * height))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@contextmanager
def router(port: int) -> Iterator[TopicPublisher]:
    """A router with a ROS 2 node behind it that publishes `nose/image/compressed`."""
    endpoint = f"tcp/127.0.0.1:{port}"
    with zenoh.open(router_config([endpoint])), zenoh.open(client_config([endpoint])) as session:
        yield Node(session, "nose", name="driver").publisher(topics.IMAGE)


def zenoh_camera(port: int, latency_ms: float = 0.0) -> ZenohCamera:
    return ZenohCamera(
        type="zenoh",
        topic="nose/image/compressed",
        connect=f"tcp/127.0.0.1:{port}",
        latency_ms=latency_ms,
        intrinsics=INTRINSICS,
    )


def put_until_read(source: ZenohSource, publisher: TopicPublisher | zenoh.Publisher, payload: bytes) -> Frame:
    """The first pictures may be lost while the subscription spreads."""
    frames: list[Frame] = []
    reader = threading.Thread(target=lambda: frames.append(source.read(threading.Event())))
    reader.start()
    while reader.is_alive():
        publisher.put(payload)
        reader.join(0.05)
    return frames[0]


def test_a_zenoh_topic_is_a_camera_stamped_by_its_publisher() -> None:
    port = free_port()
    with router(port) as publisher, closing(ZenohSource(zenoh_camera(port, latency_ms=30.0))) as source:
        info = source.open()
        assert info.image_size_wh == SIZE_WH
        put_until_read(source, publisher, message(1))
        exposed_ns = time.monotonic_ns() - 80_000_000
        frame = put_until_read(source, publisher, message(7, stamp_ns=time.time_ns() - 80_000_000))
        while number_of(frame) != 7:
            frame = put_until_read(source, publisher, message(7, stamp_ns=time.time_ns() - 80_000_000))
        assert frame.meta.capture_ns >= exposed_ns - 31_000_000
        assert frame.meta.arrival_ns - frame.meta.capture_ns >= 109_000_000
        assert frame.distortion == tuple(LENS)
        assert frame.K[0, 0] == 300


def test_pictures_that_a_link_held_back_before_the_first_are_not_told_as_of_now() -> None:
    """As where the daemon was stopped, or the link stood still, while the camera began."""
    port = free_port()
    with router(port) as publisher, closing(ZenohSource(zenoh_camera(port))) as source:
        source.open()
        until(publisher.matching)
        read: list[Frame] = []
        reader = threading.Thread(target=lambda: read.append(source.read(threading.Event())))
        reader.start()
        for number, held_s in enumerate((4.0, 3.7, 3.3, 2.9, 2.4)):
            publisher.put(message(number, stamp_ns=time.time_ns() - round(held_s * 1e9)))
            until(lambda number=number: read or source.counts["catching_up"] > number)  # type: ignore[misc]
        publisher.put(message(5))
        reader.join()
    assert number_of(read[0]) == 5


def test_a_picture_is_taken_as_its_sensor_read_it_out_however_it_says_it_is_held() -> None:
    port = free_port()
    with router(port) as publisher, closing(ZenohSource(zenoh_camera(port))) as source:
        source.open()
        payload = CompressedImage(time.time_ns(), "camera_optical_frame", "jpeg", turned_jpeg(7)).encode()
        frame = put_until_read(source, publisher, payload)
    assert (frame.image_bgr.shape[1], frame.image_bgr.shape[0]) == SIZE_WH


def reading(source: ZenohSource, stop: threading.Event) -> Frame | None:
    try:
        return source.read(stop)
    except EndOfStream:
        return None


def test_what_is_no_picture_on_the_topic_is_counted_and_what_is_lost_shows_as_a_gap() -> None:
    port = free_port()
    with router(port) as publisher, closing(ZenohSource(zenoh_camera(port))) as source:
        source.open()
        first = put_until_read(source, publisher, message(1))
        stop, read = threading.Event(), []
        reader = threading.Thread(target=lambda: read.append(reading(source, stop)))
        reader.start()
        for reason, payload in (
            ("undecodable", message(2)[:40]),
            ("undecodable", CompressedImage(1, "", "jpeg", b"no jpeg").encode()),
            ("undecodable", CompressedImage(1, "", "png", deep_png()).encode()),
            ("misfit", message(3, (300, 200))),
        ):
            before = source.counts[reason]
            while source.counts[reason] == before:
                publisher.put(payload)
                stop.wait(0.02)
        stop.set()
        reader.join()
        assert read == [None]
        later = put_until_read(source, publisher, message(4, stamp_ns=5))
        assert later.meta.sequence - first.meta.sequence >= 4
        assert later.meta.capture_ns < first.meta.capture_ns  # an old picture is not told as a new one


def test_a_small_file_that_would_unpack_to_more_than_the_memory_is_not_decoded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert decode_picture(empty_png((64, 36))) is not None
    huge = empty_png((8200, 8200))  # 200 MB, from 70 kB
    assert len(huge) < 100_000
    assert decode_picture(huge) is None
    # The size is known before anything is decoded, whatever the encoder writes before it.
    _, jpeg = cv2.imencode(".jpg", picture(1))
    _, progressive = cv2.imencode(
        ".jpg", picture(1)[..., 0], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    )
    assert decode_picture(jpeg.tobytes()[:-99]) is None, "what is missing would be gray"
    padded = jpeg.tobytes()[:2] + b"\xff\xff" + jpeg.tobytes()[2:]
    pictures = [
        jpeg.tobytes(),
        padded,
        progressive.tobytes(),
        turned_jpeg(1),
        message(1)[message(1).index(b"\x89PNG") :],
    ]
    for data in pictures:
        assert picture_size_wh(data) == SIZE_WH
        assert decode_picture(data) is not None
        for cut_short in range(0, min(len(data), 2000), 7):
            picture_size_wh(data[:cut_short])
    monkeypatch.setattr(zenoh_topic, "PIXELS_MAX", SIZE_WH[0] * SIZE_WH[1] - 1)
    assert [decode_picture(data) for data in pictures] == [None] * len(pictures)


def test_of_two_cameras_on_one_topic_one_alone_is_looked_through_until_it_is_gone() -> None:
    """A recording that is played beside the camera would have the tracker see both skies in turn."""
    port = free_port()
    with router(port) as camera, zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
        recording = Node(session, "nose", name="playback").publisher(topics.IMAGE)
        with closing(ZenohSource(zenoh_camera(port))) as source:
            source.open()
            put_until_read(source, camera, message(1))
            seen: set[int] = set()
            for _ in range(40):
                recording.put(message(9))
                camera.put(message(1))
                last = source.read(threading.Event())
                seen.add(number_of(last))
            assert seen == {1}
            assert source.counts["other_publisher"] > 0
            # The camera falls silent: what else there is takes its place.
            larger = (2 * SIZE_WH[0], 2 * SIZE_WH[1])
            other = put_until_read(source, recording, message(9, larger))
            assert number_of(other) == 9
            assert other.meta.arrival_ns - last.meta.arrival_ns >= 1_000_000_000
            assert other.meta.sequence == last.meta.sequence + 1, "the numbers of two publishers tell no loss"
            assert other.K[0, 0] == 600


def test_who_publishes_what_cannot_be_used_does_not_keep_the_camera_out() -> None:
    port = free_port()
    with router(port) as camera, zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
        thermal = Node(session, "nose", name="thermal").publisher(topics.IMAGE)
        with closing(ZenohSource(zenoh_camera(port))) as source:
            source.open()
            read: list[Frame] = []
            reader = threading.Thread(target=lambda: read.append(source.read(threading.Event())))
            reader.start()
            deep = CompressedImage(1, "", "png", deep_png()).encode()
            until(lambda: source.counts["undecodable"] > 0, lambda: thermal.put(deep))
            while reader.is_alive():
                thermal.put(deep)
                camera.put(message(7))
                reader.join(0.05)
            assert [number_of(frame) for frame in read] == [7]


def test_while_the_process_itself_stood_still_the_camera_was_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    port, stood_still_ns, looks = free_port(), [0], []

    def monotonic_ns() -> int:
        looks.append(None)
        return time.monotonic_ns() + stood_still_ns[0]

    with router(port) as camera, closing(ZenohSource(zenoh_camera(port))) as source:
        source.open()
        put_until_read(source, camera, message(1))
        monkeypatch.setattr(zenoh_topic, "time", SimpleNamespace(monotonic_ns=monotonic_ns))
        read: list[Frame] = []
        reader = threading.Thread(target=lambda: read.append(source.read(threading.Event())))
        reader.start()
        until(lambda: len(looks) > 2)
        stood_still_ns[0] = 10_000_000_000
        seen = len(looks)
        until(lambda: len(looks) > seen + 2 or not reader.is_alive())
        until(lambda: not reader.is_alive(), lambda: camera.put(message(7)))
    assert [number_of(frame) for frame in read] == [7]


IMAGE_TYPE = "sensor_msgs::msg::dds_::CompressedImage_"


@pytest.mark.parametrize(
    "below",
    [
        f"thermal/{IMAGE_TYPE}/RIHS01_1",
        "info/sensor_msgs::msg::dds_::CameraInfo_/RIHS01_1",
        "sensor_msgs::msg::dds_::Image_/RIHS01_1",
        "thermal",
    ],
)
def test_another_topic_below_the_camera_s_or_another_type_is_not_taken_for_the_camera(below: str) -> None:
    port = free_port()
    with router(port) as camera, closing(ZenohSource(zenoh_camera(port))) as source:
        source.open()
        with zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
            key = f"0/nose/image/compressed/{below}"
            until(lambda: source.counts["other_topic"] > 0, lambda: session.put(key, message(9)))
            assert number_of(put_until_read(source, camera, message(1))) == 1
        assert source.counts["other_publisher"] == 0


@pytest.mark.parametrize("below", ["", f"/{IMAGE_TYPE}/{topics.HASH_UNSUPPORTED}"])
def test_pictures_on_the_topic_are_taken_from_any_ros_and_from_a_plain_publisher(below: str) -> None:
    port = free_port()
    with router(port), closing(ZenohSource(zenoh_camera(port, latency_ms=30.0))) as source:
        source.open()
        with zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
            publisher = session.declare_publisher(f"0/nose/image/compressed{below}")
            frame = put_until_read(source, publisher, message(5, stamp_ns=1))
            assert number_of(frame) == 5
            assert frame.meta.arrival_ns - frame.meta.capture_ns == 30_000_000, "its clock was never set"


def test_a_topic_of_another_type_is_told_apart_from_one_that_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_topic, "SILENCE_S", 0.5)
    port, key = free_port(), "0/nose/image/compressed/sensor_msgs::msg::dds_::Image_/RIHS01_1"
    with router(port), closing(ZenohSource(zenoh_camera(port))) as source, ThreadPoolExecutor() as pool:
        source.open()
        reading = pool.submit(source.read, threading.Event())
        with zenoh.open(client_config([f"tcp/127.0.0.1:{port}"])) as session:
            until(reading.done, lambda: session.put(key, b"raw"), what="that it gives up")
        with pytest.raises(SourceLost, match=f"no sensor_msgs/CompressedImage on .* but samples on {key}"):
            reading.result()


def test_a_router_that_comes_late_is_found_and_one_that_goes_is_missed() -> None:
    port = free_port()
    source = ZenohSource(zenoh_camera(port))
    with pytest.raises(SourceLost, match="no zenoh session"):
        source.open()
    capture = Capture(source, False)
    capture.start()
    try:
        assert capture.newest(0.3) is None
        with router(port) as publisher:
            index, frame = 0, None
            while frame is None:
                publisher.put(message(index := index + 1))
                frame = capture.newest(0.1)
        assert capture.reasons(time.monotonic_ns()) == (), "it is not lost any more"
    finally:
        capture.stop()
    assert capture.counters()["reconnects"] >= 1


def test_a_device_that_does_other_than_asked_is_told() -> None:
    asked = DeviceCamera(type="device", fps=30, fourcc="MJPG", intrinsics=INTRINSICS)
    size_wh = (asked.width, asked.height)
    assert complaints(asked, size_wh, "MJPG", 30.0, 4.0) == []
    assert complaints(asked, size_wh, "MJPG", 29.97, 4.0) == []
    assert complaints(asked, size_wh, "YUYV", 5.0, 4.0) == ["gives YUYV, not MJPG", "gives 5 frames a second, not 30"]
    smaller = complaints(asked.model_copy(update={"width": 1920, "height": 1080}), (1280, 720), "MJPG", 30, 4)
    assert smaller == ["gives 1280x720, not 1920x1080"], "a scaled picture fits the calibration, a cut one looks alike"


def test_a_calibration_of_another_lens_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yaml"
    path.write_text(
        "image_width: 640\nimage_height: 480\ndistortion_model: equidistant\n"
        "camera_matrix: {rows: 3, cols: 3, data: [300, 0, 320, 0, 300, 240, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 4, data: [0.1, 0, 0, 0]}\n"
    )
    with pytest.raises(InputError, match="distortion_model equidistant"):
        read_calibration(path)


@pytest.mark.parametrize(("fisheye", "taken"), [("0", True), ("1", False), ("true", False)])
def test_a_fisheye_calibration_of_opencv_is_refused(tmp_path: Path, fisheye: str, taken: bool) -> None:
    """As its sample calibrator writes it: with no distortion_model, but four numbers that plumb bob has too."""
    path = tmp_path / "fisheye.yaml"
    path.write_text(
        f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\nfisheye_model: {fisheye}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 300., 0., 320., 0., 300., 240., 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n"
        "   data: [ -0.02, 0.008, -0.01, 0.004 ]\n"
    )
    if taken:
        assert read_calibration(path).distortion == (-0.02, 0.008, -0.01, 0.004)
        return
    with pytest.raises(InputError, match="fisheye"):
        read_calibration(path)
