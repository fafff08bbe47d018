from __future__ import annotations

import struct
import threading
import time
from collections import Counter
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.cameras.capture import Capture
from edge.cameras.file import FileSource
from edge.cameras.intrinsics import Intrinsics, load_intrinsics
from edge.cameras.reconnect import LONGEST_WAIT_NS, Reconnect
from edge.cameras.sequence import SequenceSource
from edge.cameras.source import EndOfStream
from edge.config_camera import FileCamera, IntrinsicsSettings, SequenceCamera
from edge.errors import InputError
from edge.types import CameraInfo, Frame, FrameMeta
from tests.waiting import until

from .pictures import play
from .toy_scene import write_scene

VIDEO_WH = (320, 180)
INTRINSICS = IntrinsicsSettings(fx=300, fy=300, cx=159.5, cy=89.5, width=VIDEO_WH[0], height=VIDEO_WH[1])
BMP_TOO_WIDE = struct.pack("<2sI4xIIiiHHI24x", b"BM", 54, 54, 40, 2**30, 1, 1, 24, 0)
TORN_JPEG = cv2.imencode(".jpg", np.tile(np.arange(180, dtype=np.uint8)[:, None, None], (1, 320, 3)))[1].tobytes()[:-99]


def write_video(path: Path, frames: int, fps: float) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, VIDEO_WH)
    for index in range(frames):
        writer.write(np.full((VIDEO_WH[1], VIDEO_WH[0], 3), 10 * index, np.uint8))
    writer.release()
    return path


def test_a_sequence_hands_over_each_frame_at_its_exposure_and_not_before(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "000001", frames=6)
    start_ns = time.monotonic_ns() + 300_000_000
    frames = play(SequenceSource(SequenceCamera(type="sequence", path=scene, fps=4, start_at_ns=start_ns)))
    numbers = [frame.meta.sequence for frame in frames]  # a busy machine passes some over
    assert len(numbers) >= 3
    assert np.diff(numbers).min() >= 1
    assert [frame.meta.capture_ns for frame in frames] == [start_ns + 250_000_000 * k for k in numbers]
    assert all(frame.meta.arrival_ns >= frame.meta.capture_ns for frame in frames)
    left_edges = [int(np.argmax(frame.image_bgr.any(axis=(0, 2)))) for frame in frames]
    assert np.diff(left_edges).tolist() == (8 * np.diff(numbers)).tolist()


def test_a_sequence_entered_late_begins_where_a_camera_would_be(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "000001", frames=6)
    start_ns = time.monotonic_ns() - 1_100_000_000
    capture = Capture(SequenceSource(SequenceCamera(type="sequence", path=scene, fps=4, start_at_ns=start_ns)), False)
    capture.start()
    frame = capture.newest(5.0)
    capture.stop()
    assert frame is not None
    assert frame.meta.sequence >= 4
    assert capture.counters()["dropped"] == frame.meta.sequence


def test_a_loop_that_began_long_ago_is_at_once_where_it_is_now(tmp_path: Path) -> None:
    """As with `start_at_ns = 0` on a computer that has been up for weeks."""
    scene = write_scene(tmp_path / "000001", 4)
    start_ns = time.monotonic_ns() - 20 * 86_400 * 1_000_000_000
    source = SequenceSource(SequenceCamera(type="sequence", path=scene, fps=30, loop=True, start_at_ns=start_ns))
    with closing(source):
        source.open()
        asked_ns = time.monotonic_ns()
        frame = source.read(threading.Event())
        # Searched frame by frame, it was found after 23 s.
        assert time.monotonic_ns() - asked_ns < 2_000_000_000
        assert abs(frame.meta.capture_ns - asked_ns) < 2_000_000_000
        assert frame.meta.capture_ns == start_ns + round(frame.meta.sequence * 1e9 / 30)


def test_a_looping_sequence_goes_on_in_time(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "000001", frames=3)
    source = SequenceSource(SequenceCamera(type="sequence", path=scene, fps=20, loop=True))
    with closing(source):
        source.open()
        frames = [source.read(threading.Event()) for _ in range(12)]
    first = frames[0]
    for frame in frames:  # a busy machine passes some over
        later = frame.meta.sequence - first.meta.sequence
        assert frame.meta.capture_ns - first.meta.capture_ns == later * 50_000_000
        assert np.array_equal(frame.image_bgr, first.image_bgr) == (later % 3 == 0)


def test_a_slow_reader_gets_the_newest_frame_and_every_drop_is_counted(scene: Path) -> None:
    capture = Capture(SequenceSource(SequenceCamera(type="sequence", path=scene, fps=60)), False)
    capture.start()
    taken = []
    while not taken or taken[-1] < 39:
        frame = capture.newest(5.0)
        assert frame is not None
        taken.append(frame.meta.sequence)
        threading.Event().wait(0.1)  # a reader six times too slow
    with pytest.raises(EndOfStream):
        capture.newest(5.0)
    capture.stop()
    assert len(taken) <= 10
    assert np.diff(taken).min() >= 1
    assert capture.counters()["dropped"] == 40 - len(taken)


class Numbered:
    """A camera that has lost what its numbers pass over, and then shows nothing more."""

    live = False

    def __init__(self, numbers: list[int]) -> None:
        self._numbers, self.counts = numbers, Counter[str]()

    def open(self) -> CameraInfo:
        return CameraInfo("numbered", VIDEO_WH, np.eye(3), None)

    def read(self, stop: threading.Event) -> Frame:
        if not self._numbers:
            stop.wait()
            raise EndOfStream
        number, now_ns = self._numbers.pop(0), time.monotonic_ns()
        return Frame(FrameMeta(number, now_ns, now_ns), np.zeros((2, 2, 3), np.uint8), np.eye(3))

    def close(self) -> None:
        pass


def test_what_the_source_lost_and_what_nobody_took_in_time_are_counted_apart() -> None:
    capture = Capture(Numbered([0, 1, 4, 5]), False)
    dropped = ("dropped", "dropped_at_source", "dropped_overtaken")
    assert capture.counters() == dict.fromkeys(("captured", *dropped, "frozen", "time_jumps", "reconnects"), 0)
    capture.start()
    until(lambda: capture.counters()["captured"] == 4, what="all frames")
    newest = capture.newest(0.0)
    capture.stop()
    assert newest is not None
    assert newest.meta.sequence == 5
    assert [capture.counters()[name] for name in dropped] == [5, 2, 3]


class Broken(SequenceSource):
    """Fails as no camera should after its first frame."""

    def read(self, stop: threading.Event) -> Frame:
        frame = super().read(stop)
        if frame.meta.sequence > 0:
            raise MemoryError("no room for a picture")
        return frame


def test_a_capture_thread_that_breaks_ends_the_loop_instead_of_leaving_it_to_wait(scene: Path) -> None:
    capture = Capture(Broken(SequenceCamera(type="sequence", path=scene, fps=60)), False)
    capture.start()
    assert capture.newest(5.0) is not None
    with pytest.raises(MemoryError):
        capture.newest(5.0)
    capture.stop()


@pytest.mark.parametrize(
    ("file", "content", "sentence"),
    [
        ("scene_camera.json", None, "is no BOP scene: scene_camera.json cannot be read: No such file"),
        ("scene_camera.json", b'{"0": {}}', "scene_camera.json: '0' has no 'cam_K'"),
        ("scene_camera.json", b"{}", "scene_camera.json has no camera for picture 0"),
        ("scene_camera.json", b"[]", "scene_camera.json is not as BOP writes it"),
        ("rgb/000000.png", None, "has no pictures in rgb/ or gray/"),
        ("rgb/000000.png", b"junk", "000000.png is not a readable picture"),
        ("rgb/000000.png", TORN_JPEG, "000000.png is cut short"),
        ("rgb/000000.png", BMP_TOO_WIDE, "000000.png is not a readable picture"),
    ],
)
def test_a_damaged_scene_is_told_with_file_and_fault(
    tmp_path: Path, file: str, content: bytes | None, sentence: str
) -> None:
    folder = write_scene(tmp_path / "000001", frames=1)
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        SequenceSource(SequenceCamera(type="sequence", path=folder)).open()


def test_a_video_plays_at_its_own_rate(tmp_path: Path) -> None:
    path = write_video(tmp_path / "flight.mp4", frames=8, fps=8)
    frames = play(FileSource(FileCamera(type="file", path=path, intrinsics=INTRINSICS)))
    numbers = [frame.meta.sequence for frame in frames]  # a busy machine passes some over
    assert len(numbers) >= 3
    assert numbers[-1] == 7
    steps_ns = np.diff([frame.meta.capture_ns for frame in frames])
    np.testing.assert_allclose(steps_ns, 125e6 * np.diff(numbers), atol=1)
    assert [round(float(frame.image_bgr.mean()) / 10) for frame in frames] == numbers


def test_however_late_its_reader_a_video_ends_with_its_last_frame(tmp_path: Path) -> None:
    path = write_video(tmp_path / "flight.mp4", frames=8, fps=20)
    with closing(FileSource(FileCamera(type="file", path=path, intrinsics=INTRINSICS))) as source:
        source.open()
        assert source.read(threading.Event()).meta.sequence == 0
        threading.Event().wait(0.6)  # longer than the rest of it
        last = source.read(threading.Event())
        assert last.meta.sequence == 7
        assert round(float(last.image_bgr.mean()) / 10) == 7
        with pytest.raises(EndOfStream):
            source.read(threading.Event())


def write_slow_video(path: Path, frames: int) -> Path:
    """1000 frames a second, each of which takes many milliseconds to decode."""
    _, jpeg = cv2.imencode(".jpg", np.full((2160, 3840, 3), 90, np.uint8))
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mjpeg", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 3840, 2160, "yuvj420p"
        for index in range(frames):
            packet = av.Packet(jpeg.tobytes())
            packet.stream, packet.time_base, packet.is_keyframe = stream, Fraction(1, 1000), True
            packet.pts = packet.dts = index
            out.mux(packet)
    return path


def test_a_video_slower_to_decode_than_its_rate_shows_old_frames_instead_of_none(tmp_path: Path) -> None:
    path = write_slow_video(tmp_path / "flight.avi", frames=300)
    with closing(FileSource(FileCamera(type="file", path=path, intrinsics=INTRINSICS))) as source:
        source.open()
        first = source.read(threading.Event()).meta
        late = source.read(threading.Event()).meta
        assert first.sequence < late.sequence < 299
        passed_ns = (late.sequence - first.sequence) * 1_000_000
        assert late.capture_ns == first.capture_ns + passed_ns  # so its age is told
        stop = threading.Event()
        stop.set()
        for _ in range(40):
            with pytest.raises(EndOfStream):
                source.read(stop)
        assert source.read(threading.Event()).meta.sequence < 299  # nothing was skipped for who does not want it


@given(st.lists(st.sampled_from(["lost", "delivered"]), max_size=30))
def test_waits_between_tries_grow_to_a_cap_and_a_frame_forgives(events: list[str]) -> None:
    link, wait_before_ns = Reconnect(), 0
    for now_ns, event in enumerate(events):
        if event == "delivered":
            link, wait_before_ns = link.delivered(), 0
        else:
            link = link.lost(now_ns)
            wait_ns = link.retry_at_ns - now_ns
            assert wait_ns == (min(2 * wait_before_ns, LONGEST_WAIT_NS) if wait_before_ns else 250_000_000)
            wait_before_ns = wait_ns


@given(
    st.integers(1, 8),
    st.integers(1, 8),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
def test_scaled_intrinsics_see_the_same_ray_through_the_same_spot(up: int, down: int, ray: tuple[float, float]) -> None:
    small = Intrinsics(np.array([[700.0, 0, 310.25], [0, 705.0, 250.5], [0, 0, 1.0]]), (640, 480))
    large = small.scaled_to((640 * up, 480 * up)).scaled_to((80 * down, 60 * down))
    scale = 80 * down / 640
    point = small.K @ [*ray, 1.0]
    np.testing.assert_allclose((large.K @ [*ray, 1.0])[:2], (point[:2] + 0.5) * scale - 0.5, atol=1e-9)


def test_the_numbers_of_the_configuration_are_the_camera_s() -> None:
    numbers = IntrinsicsSettings(
        fx=300, fy=310, cx=159.5, cy=89.5, width=320, height=180, distortion=[-0.1, 0.02, 0, 0]
    )
    lens = load_intrinsics(numbers)
    np.testing.assert_array_equal(lens.K, [[300, 0, 159.5], [0, 310, 89.5], [0, 0, 1]])
    assert (lens.image_size_wh, lens.distortion) == ((320, 180), (-0.1, 0.02, 0.0, 0.0))


def test_a_frame_of_another_size_than_the_intrinsics_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "flight.mp4", frames=2, fps=20)
    other = IntrinsicsSettings(fx=300, fy=300, cx=1, cy=1, width=640, height=480)
    source = FileSource(FileCamera(type="file", path=path, intrinsics=other))
    with pytest.raises(InputError, match=f"640x480.*{VIDEO_WH[0]}x{VIDEO_WH[1]}"):
        source.open()
