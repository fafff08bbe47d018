"""Video files as they are made: of a rate that varies, turned, joined, or without any times."""

from __future__ import annotations

import os
import shlex
import struct
import subprocess
import threading
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from edge.calibrate import PICTURES_MAX, pictures_of
from edge.cameras.file import FileSource, VideoTimes
from edge.config_camera import FileCamera
from edge.errors import InputError

from .pictures import INTRINSICS, SIZE_WH, damaged_jpeg, picture, play

FPS = 25
UPRIGHT, TURNED = ((1, 0, 0, 1), (-1, 0, 0, -1))  # of a track header's matrix: a, b, c, d


def write_film(path: Path, times_ms: list[int], codec: str = "mpeg4", bright: slice = np.s_[:]) -> Path:
    """A picture for each time, bright in a part of its rows."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=FPS)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base, stream.codec_context.max_b_frames = Fraction(1, 1000), 0
        for time_ms in times_ms:
            image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
            image[bright] = 200
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def matrix(a: int, b: int, c: int, d: int) -> bytes:
    return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)


def bare_jpeg(path: Path, before: bytes = b"", after: bytes = b"") -> Path:
    jpegs = [cv2.imencode(".jpg", picture(index))[1].tobytes() for index in range(3)]
    path.write_bytes(b"".join(before + jpeg + after for jpeg in jpegs))
    return path


def turned(path: Path) -> Path:
    """The same file, which says that it is to be shown upside down, as a camera that hangs writes it."""
    before, name, header = path.read_bytes().rpartition(b"tkhd")  # of the track, as the film has one alone
    assert matrix(*UPRIGHT) in header
    path.write_bytes(before + name + header.replace(matrix(*UPRIGHT), matrix(*TURNED), 1))
    return path


def source_of(path: Path) -> FileSource:
    return FileSource(FileCamera(type="file", path=path, intrinsics=INTRINSICS))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_video_of_a_rate_that_varies_is_played_by_its_own_times(tmp_path: Path, suffix: str) -> None:
    """As a camera films that exposes longer in the dark, or a radio link that lost some of it is recorded."""
    times_ms = [0, 40, 80, 120, 640, 680, 720, 840, 960]
    frames = play(source_of(write_film(tmp_path / f"flight.{suffix}", times_ms)))
    began_ns = frames[0].meta.capture_ns - times_ms[frames[0].meta.sequence] * 1_000_000
    told_ms = {frame.meta.sequence: (frame.meta.capture_ns - began_ns) / 1e6 for frame in frames}
    assert len(told_ms) >= 3  # a busy machine passes some over
    for index, time_ms in told_ms.items():
        assert time_ms == pytest.approx(times_ms[index], abs=1.0)
    assert all(frame.meta.arrival_ns >= frame.meta.capture_ns for frame in frames)


def test_the_times_of_a_steady_video_are_those_of_its_rate_however_its_file_rounds_them() -> None:
    times = VideoTimes(30.0)
    for index in range(300):
        times.take(5_000_000_000 + round(index * 1000 / 30) * 1_000_000)
        assert times.last_ns == round(index * 1e9 / 30)


def test_where_a_video_has_no_times_or_those_of_another_clock_frames_follow_at_its_rate() -> None:
    joined, none_at_the_end = [0, 40, 80, 9_000_000, 9_000_040, 20, 60], [80, 120, 160, 0, 0]
    joined_to_another_rate = [0, 40, 80, 9_000_000, 9_000_100, 9_000_200]
    for stamps_ms, expected_ms in (
        (joined, [40.0 * k for k in range(7)]),
        (none_at_the_end, [40.0 * k for k in range(5)]),
        (joined_to_another_rate, [0.0, 40.0, 80.0, 120.0, 220.0, 320.0]),
    ):
        times, told_ms = VideoTimes(FPS), []
        for stamp_ms in stamps_ms:
            times.take(stamp_ms * 1_000_000)
            told_ms.append(times.last_ns / 1e6)
        assert told_ms == expected_ms


@pytest.mark.parametrize("wrong_ms", [0, 360, 359, 200, 9_000_000])
def test_one_frame_of_a_video_without_a_time_or_with_a_wrong_one_does_not_move_those_after_it(wrong_ms: int) -> None:
    times = VideoTimes(FPS)
    for index in range(20):
        times.take((wrong_ms if index == 10 else 40 * index) * 1_000_000)
        assert times.last_ns == 40_000_000 * index


def test_a_video_is_seen_as_its_sensor_read_it_out_however_it_says_it_is_to_be_shown(tmp_path: Path) -> None:
    path = turned(write_film(tmp_path / "flight.mp4", [0, 40, 80], bright=np.s_[:60]))
    seen = [frame.image_bgr[..., 0] for frame in play(source_of(path))]
    calibrated = [gray for _, gray in pictures_of(path)]
    assert len(calibrated) == 3
    for image in (*seen, *calibrated):
        assert image[:60].mean() > 150
        assert image[60:].mean() < 50


def test_of_a_video_that_claims_a_thousand_frames_a_second_as_many_are_examined_as_of_another(tmp_path: Path) -> None:
    """As recorders that count in milliseconds may write them: the number of frames is guessed from the rate."""
    for suffix, count in (("mp4", 300), ("avi", 300), ("avi", 20)):
        names = [
            name for name, _ in pictures_of(write_film(tmp_path / f"board.{suffix}", [40 * k for k in range(count)]))
        ]
        assert len(set(names)) == len(names)
        assert min(count, PICTURES_MAX) <= len(names) <= 2 * PICTURES_MAX


def test_a_video_of_jpeg_whose_recorder_never_ended_it_has_its_times_all_the_same(tmp_path: Path) -> None:
    """As where the power goes in flight: Matroska then says neither how long it is nor of how many frames."""
    pipe, path = tmp_path / "pipe.mkv", tmp_path / "flight.mkv"
    os.mkfifo(pipe)
    with path.open("wb") as file, subprocess.Popen(["cat", pipe], stdout=file):
        write_film(pipe, [0, 40, 80, 120], "mjpeg")  # who cannot go back writes no end
    with closing(source_of(path)) as source:
        source.open()
        frames = [source.read(threading.Event()) for _ in range(2)]
    steps_ns = (frames[1].meta.sequence - frames[0].meta.sequence) * 40_000_000
    assert frames[1].meta.capture_ns - frames[0].meta.capture_ns == steps_ns


def test_a_video_goes_on_after_pictures_that_cannot_be_decoded(tmp_path: Path) -> None:
    """As what a cable tore is recorded. OpenCV reports them as it reports the end."""
    path = write_film(tmp_path / "flight.mkv", [40 * k for k in range(12)], "mjpeg")
    path.write_bytes(damaged_jpeg(path.read_bytes(), {0, 4, 5}))
    frames = play(source_of(path))
    numbers = [frame.meta.sequence for frame in frames]  # a busy machine passes some over
    assert numbers[-1] == 11
    assert not {0, 4, 5} & set(numbers)
    between_ns = frames[-1].meta.capture_ns - frames[0].meta.capture_ns
    assert between_ns == (11 - numbers[0]) * 40_000_000
    assert [name for name, _ in pictures_of(path)] == [f"frame {k}" for k in range(12) if k not in (0, 4, 5)]


def test_a_video_whose_frames_have_no_times_is_refused_with_what_to_do(tmp_path: Path) -> None:
    """As a camera's encoder writes it where nothing packs it into a file with times."""
    torn = bare_jpeg(tmp_path / "torn.mjpeg")
    torn.write_bytes(damaged_jpeg(torn.read_bytes(), {0}))
    part = b"--next\r\nContent-Type: image/jpeg\r\n\r\n"  # as a web camera's answer is saved
    for path in (
        write_film(tmp_path / "flight.h264", [0, 40, 80], "libx264"),
        bare_jpeg(tmp_path / "flight.mjpeg"),
        bare_jpeg(tmp_path / "answer.mjpeg", part, b"\r\n"),
        torn,
    ):
        with closing(source_of(path)) as source, pytest.raises(InputError, match=f"when its frames.*{path.name}"):
            source.open()


def test_the_command_that_gives_a_video_times_gives_each_frame_its_own(tmp_path: Path) -> None:
    """H.264 stores frames that were predicted from later ones after these."""
    with av.open(str(tmp_path / "my flight.h264"), "w") as out:
        stream = out.add_stream("libx264", rate=30, options={"x264-params": "b-adapt=0"})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
        stream.codec_context.max_b_frames = 2
        for index in range(12):
            brighter = np.full((SIZE_WH[1], SIZE_WH[0], 3), 20 * index, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(brighter, format="bgr24")))
        out.mux(stream.encode(None))
    with closing(source_of(tmp_path / "my flight.h264")) as source, pytest.raises(InputError) as refused:
        source.open()
    command = str(refused.value).rpartition("filmed at: ")[2]
    subprocess.run(shlex.split(command), cwd=tmp_path, check=True, capture_output=True)
    frames = play(source_of(tmp_path / "my flight.mp4"))
    numbers = [frame.meta.sequence for frame in frames]  # a busy machine passes some over
    assert len(numbers) >= 3
    assert numbers[-1] == 11
    assert [round(frame.image_bgr.mean() / 20) for frame in frames] == numbers


def test_a_video_that_ends_before_its_first_frame_is_no_flight_that_went_well(tmp_path: Path) -> None:
    path = write_film(tmp_path / "flight.avi", [0, 40, 80])
    path.write_bytes(path.read_bytes().partition(b"movi")[0] + b"movi")
    with closing(source_of(path)) as source:
        source.open()
        with pytest.raises(InputError, match=r"flight.avi has no readable frame"):
            source.read(threading.Event())
