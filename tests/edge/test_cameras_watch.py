"""What is noticed of a live camera: pictures that repeat, numbers that it skips, stamps that jump."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Container, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.cameras.capture import FROZEN_TOLD_NS, JUMPS_TOLD_S, Capture
from edge.cameras.folder import FolderSource, list_pictures
from edge.cameras.source import EndOfStream, SourceLost
from edge.cameras.watch import FrameWatch, RivalWatch, StampWatch
from edge.config_camera import FolderCamera
from edge.errors import InputError
from edge.estimator.pace import Pace
from edge.health import Health
from edge.types import CameraInfo, Frame, FrameMeta
from tests.waiting import until

from .pictures import INTRINSICS, number_of, picture

PERIOD_NS = 33_333_333


class Playing(FolderSource):
    """A folder that is a live camera: what repeats there is frozen."""

    live = True


def write_pictures(folder: Path, numbers: list[int]) -> Path:
    folder.mkdir()
    for index, number in enumerate(numbers):
        cv2.imwrite(str(folder / f"frame{index}.{'PNG' if index % 2 else 'png'}"), picture(number))
    return folder


def all_of(source: FolderSource) -> tuple[list[int], dict[str, int]]:
    """Brightness of every frame handed out to a reader that is always in time, and the counters."""
    capture = Capture(source, False)
    capture.start()
    numbers = []
    try:
        while True:
            if (frame := capture.newest(5.0)) is not None:
                numbers.append(number_of(frame))
    except EndOfStream:
        return numbers, capture.counters()
    finally:
        capture.stop()


def test_a_live_picture_that_repeats_is_withheld_and_a_recordings_is_not(tmp_path: Path) -> None:
    shown = [1, 2, 3, 3, 3, 4, 5, 5, 6, 7, 8]  # ten in eleven: names are sorted as numbers
    folder = write_pictures(tmp_path / "pictures", shown)
    settings = FolderCamera(type="folder", path=folder, fps=8, intrinsics=INTRINSICS)
    numbers, counters = all_of(FolderSource(settings))
    assert numbers == shown
    assert (counters["frozen"], counters["dropped"]) == (3, 0)
    numbers, counters = all_of(Playing(settings))
    assert numbers == [1, 2, 3, 4, 5, 6, 7, 8]
    assert (counters["frozen"], counters["dropped"]) == (3, 0)


class Numbered:
    """A live camera of thirty frames a second that shows what it is given, under its number."""

    live = True

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._shown: queue.Queue[tuple[int, int, float | None]] = queue.Queue()

    def show(self, sequence: int, shade: int, delay_s: float | None = 0.0) -> None:
        """`delay_s`: of the arrival after the stamp; None: it cannot be stamped."""
        self._shown.put((sequence, shade, delay_s))

    def open(self) -> CameraInfo:
        return CameraInfo("numbered", (16, 16), np.eye(3), 30.0)

    def read(self, stop: threading.Event) -> Frame:
        while not stop.is_set():
            with suppress(queue.Empty):
                sequence, shade, delay_s = self._shown.get(timeout=0.02)
                self.counts["unstamped"] += delay_s is None
                arrival_ns = sequence * PERIOD_NS
                meta = FrameMeta(sequence, arrival_ns - round((delay_s or 0.0) * 1e9), arrival_ns)
                return Frame(meta, np.full((16, 16, 3), shade, np.uint8), np.eye(3))
        raise EndOfStream

    def close(self) -> None: ...


def handed_on(numbers: Iterable[int], repeated: Container[int]) -> tuple[list[FrameMeta], dict[str, int]]:
    """What a reader that is always in time gets of a live camera, those `repeated` show what the one before does."""
    source, taken, shade = Numbered(), list[FrameMeta](), 0
    capture = Capture(source, True)
    capture.start()
    try:
        for number in numbers:
            shade += number not in repeated
            source.show(number, shade)
            if number not in repeated:
                frame = capture.newest(60.0)
                assert frame is not None
                taken.append(frame.meta)
        return taken, capture.counters()
    finally:
        capture.stop()


@pytest.mark.parametrize(
    ("numbers", "repeated", "said", "frozen", "dropped"),
    [
        (range(60), range(4, 60, 6), [], 10, 0),  # a sensor of 25 Hz in a stream of 30
        (range(60), [k for k in range(60) if k % 19 > 11], [], 21, 0),  # frozen again and again
        ([k for k in range(60) if k % 6 != 2], [], ["17 % of frames dropped"], 0, 10),
        ([k for k in range(60) if k % 6 != 2], range(3, 60, 6), ["20 % of frames dropped"], 10, 10),
    ],
)
def test_pictures_that_a_live_camera_repeats_are_no_drops_and_numbers_that_it_skips_are(
    numbers: Iterable[int], repeated: Container[int], said: list[str], frozen: int, dropped: int
) -> None:
    taken, counters = handed_on(numbers, repeated)
    health = Health(wants_attitude=False)
    for meta in taken:
        health.frame_done(meta.sequence, {"total": 1}, (), True, meta.capture_ns)
    assert [reason.text for reason in health.assess(taken[-1].capture_ns).reasons] == said
    assert (counters["captured"], counters["frozen"], counters["dropped"]) == (len(taken), frozen, dropped)


def test_a_live_camera_that_is_frozen_is_told_from_the_second_on_until_it_moves() -> None:
    source = Numbered()
    capture = Capture(source, True)
    capture.start()
    try:
        before_ns = told_from_ns = time.monotonic_ns() + FROZEN_TOLD_NS
        for number, (shade, frozen, captured) in enumerate(((1, 0, 1), (1, 1, 1), (1, 2, 1), (2, 2, 2))):
            source.show(number, shade)
            until(
                lambda told=(frozen, captured): (capture.counters()["frozen"], capture.counters()["captured"]) == told
            )
            if number <= 1:
                told_from_ns = time.monotonic_ns() + FROZEN_TOLD_NS
            kinds = [[one.kind for one in capture.reasons(at_ns)] for at_ns in (before_ns - 1, told_from_ns)]
            assert kinds == [[], ["camera_frozen"] if shade == 1 and frozen else []]
    finally:
        capture.stop()


def test_a_camera_that_shows_each_picture_twice_leaves_the_time_of_both() -> None:
    pace = Pace()
    taken, _ = handed_on(range(12), range(1, 12, 2))
    assert [pace.unhurried(meta) for meta in taken] == [False, *[True] * 5]


def test_a_folder_s_pictures_follow_each_other_as_they_were_numbered_or_timed(tmp_path: Path) -> None:
    """Python leaves out the last zeros of a time's decimals."""
    names = ["cam2.png", "cam10.png", "flight 1.2.png", "flight 1.10.png"]
    names += [f"seen {1764415083 + 0.15 * k}.png" for k in range(20)]
    for name in names:
        (tmp_path / name).touch()
    assert [path.name for path in list_pictures(tmp_path)] == names


def test_a_folder_without_pictures_is_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none here")
    with pytest.raises(InputError, match=rf"{tmp_path} has no pictures"):
        list_pictures(tmp_path)
    with pytest.raises(InputError, match=r"nowhere cannot be read"):
        list_pictures(tmp_path / "nowhere")


def frame_at(capture_ms: float, arrival_ms: float, shade: int = 0) -> Frame:
    meta = FrameMeta(0, round(capture_ms * 1e6), round(arrival_ms * 1e6))
    return Frame(meta, np.full((16, 16, 3), shade, np.uint8), np.eye(3))


def test_stamps_that_jump_are_noticed_and_those_that_jitter_are_not() -> None:
    watch = FrameWatch()

    def jumps(capture_ms: float, arrival_ms: float) -> bool:
        frame = frame_at(capture_ms, arrival_ms)
        jumped = watch.jumps(frame)
        watch.repeats(frame)
        return jumped

    assert [jumps(1000 + 33 * k, 1050 + 33 * k + (k % 3) * 20) for k in range(6)] == [False] * 6
    assert jumps(1100, 1300)  # back
    assert jumps(1000 + 600, 1550)  # in the future
    assert jumps(2000, 2900)  # much older than those before
    assert not jumps(2033, 2933)
    assert [jumps(3000 + 500 * k, 3900 + 500 * k) for k in range(3)] == [False] * 3  # few frames a second
    assert [jumps(5000, 5005), jumps(5033, 5032)] == [True, True]  # newer of a sudden, and a little in the future


def stamped_worse(delays_s: Iterable[float | None], at_s: float) -> list[str]:
    """What is told at a time of ten frames a second that arrive so long after their stamps; None: without a stamp."""
    watch = StampWatch()
    for k, delay_s in enumerate(delays_s):
        arrival_ns = 10**12 + k * 10**8
        watch.take(FrameMeta(k, arrival_ns - round((delay_s or 0.0) * 1e9), arrival_ns), delay_s is not None)
    return [reason.text for reason in watch.reasons(10**12 + round(at_s * 1e9))]


LATE = "camera: pictures are 0.5 s older than they were; its clock or link has changed"
UNSTAMPED = "camera timestamps have become unusable: times of arrival are used instead"


@pytest.mark.parametrize(
    ("delays_s", "told"),
    [
        ([0.02] * 10 + [0.5] * 100, [LATE]),  # its clock was set back by 0.48 s
        ([0.5] * 110, []),  # it is slow, but was always
        ([0.02] * 10 + [0.5, 0.5, 0.03] * 30, []),  # a link that holds up some
        ([0.02] * 10 + [0.5] * 80 + [0.02] * 20, []),  # it is over
        ([0.02] * 10 + [None] * 100, [UNSTAMPED]),  # its clock was set ahead: stamps in the future
        ([None] * 110, []),  # it has none
        ([0.4, None] * 55, []),  # one without a stamp makes those with one no older
    ],
)
def test_stamps_that_have_become_worse_are_told_for_as_long_as_they_are(
    delays_s: list[float | None], told: list[str]
) -> None:
    assert stamped_worse(delays_s, 11.0) == told


@pytest.mark.parametrize(("delay_s", "kind"), [(0.5, "camera_late"), (None, "camera_unstamped")])
def test_a_camera_whose_clock_is_set_is_told_of_while_it_gives_frames(delay_s: float | None, kind: str) -> None:
    source = Numbered()
    capture = Capture(source, True)
    capture.start()
    try:
        for number in range(60):
            source.show(number, number, 0.02 if number < 20 else delay_s)
            assert capture.newest(60.0) is not None
        kinds = {reason.kind for reason in capture.reasons(60 * PERIOD_NS)}
    finally:
        capture.stop()
    assert kind in kinds


class Unplugged(Numbered):
    """While it is, its pictures end with the one that is read just now."""

    def __init__(self) -> None:
        super().__init__()
        self.gone = threading.Event()

    def read(self, stop: threading.Event) -> Frame:
        if self.gone.is_set():
            raise SourceLost("unplugged")
        return super().read(stop)


def test_a_camera_is_told_as_lost_until_it_gives_frames_again() -> None:
    source = Unplugged()
    capture = Capture(source, True)
    capture.start()
    try:
        source.gone.set()
        source.show(0, 0)
        until(lambda: [reason.text for reason in capture.reasons(0)] == ["camera lost: unplugged"], what="the loss")
        source.gone.clear()
        source.show(1, 1)
        until(lambda: capture.reasons(0) == (), what="its return")
    finally:
        capture.stop()


class Jumping(FolderSource):
    """A folder whose fourth picture is stamped a second too early."""

    def read(self, stop: threading.Event) -> Frame:
        frame = super().read(stop)
        early_ns = 1_000_000_000 if frame.meta.sequence == 3 else 0
        return replace(frame, meta=replace(frame.meta, capture_ns=frame.meta.capture_ns - early_ns))


def test_every_frame_tells_how_often_the_cameras_time_has_jumped(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "pictures", list(range(1, 7)))
    settings = FolderCamera(type="folder", path=folder, fps=10.0, intrinsics=INTRINSICS)
    capture, before_ns = Capture(Jumping(settings), False), time.monotonic_ns()
    capture.start()
    told = {}
    try:
        while True:
            if (frame := capture.newest(5.0)) is not None:
                told[frame.meta.sequence] = frame.meta.time_jumps
    except EndOfStream:
        pass
    finally:
        capture.stop()
    # There and back again.
    assert all(jumps == {0: 0, 1: 0, 2: 0, 3: 1}.get(sequence, 2) for sequence, jumps in told.items())
    assert max(told.values()) == 2
    (reason,) = capture.reasons(before_ns + JUMPS_TOLD_S * 1_000_000_000)
    assert (reason.kind, reason.text) == ("camera_stamps", "camera timestamps jump (2 in 5 s)")
    assert capture.reasons(time.monotonic_ns() + JUMPS_TOLD_S * 1_000_000_000 + 1) == ()


@pytest.mark.parametrize(("gap_s", "told"), [(0.5, True), (1.5, False)])
def test_a_publisher_that_comes_after_a_silence_is_no_rival(gap_s: float, told: bool) -> None:
    watch = RivalWatch()
    watch.take(FrameMeta(0, 10**12, 10**12), 0)
    next_ns = 10**12 + round(gap_s * 1e9)
    watch.take(FrameMeta(1, next_ns, next_ns), 3)
    assert bool(watch.reasons(next_ns)) == told


def test_one_pixel_that_changed_is_another_picture() -> None:
    watch = FrameWatch()
    still = frame_at(0, 1)
    moved = frame_at(33, 34)
    moved.image_bgr[3, 5, 1] = 1
    assert [watch.repeats(frame) for frame in (still, still, moved, moved, still)] == [False, True, False, True, False]
