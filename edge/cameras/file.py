"""A video file, played in real time by its own timestamps."""

from __future__ import annotations

import threading
import time
from collections import Counter
from pathlib import Path
from shlex import quote

import cv2
import numpy as np

from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.source import EndOfStream, wait_until
from edge.cameras.video import check_file, grab_next, open_video
from edge.config_camera import FileCamera
from edge.errors import InputError
from edge.types import CameraInfo, Frame, FrameMeta

# Skipped frames are decoded all the same, so a video that decodes slower than its rate never catches up.
SKIPPING_MAX_NS = 250_000_000
ROUNDING_NS = 1_000_000  # files round timestamps, Matroska to the millisecond
GAP_MAX_NS = 60_000_000_000  # between two frames of one recording


class FileSource:
    """A frame counts as exposed at start + its time in the video; frames that a late reader missed are skipped, as with
    a camera.

    If skipping takes too long, the frame is an old one, as its timestamp shows.
    """

    live = False

    def __init__(self, settings: FileCamera) -> None:
        self._settings = settings
        self._capture: cv2.VideoCapture | None = None
        self._start_ns: int | None = None
        self._times = VideoTimes(1.0)
        self.counts: Counter[str] = Counter()

    def open(self) -> CameraInfo:
        """Raises InputError: no video, no timestamps, or intrinsics that do not fit."""
        path = self._settings.path
        check_file(path)
        self._capture = open_video(str(path))
        if not self._capture.isOpened():
            raise InputError(f"{path} is not a readable video")
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        if not 0 < fps <= 1000:
            raise InputError(f"{path} does not say its frame rate")
        if not tells_times(path):
            # Not `-c copy`: frames are copied in the order in which they are decoded, and would get each other's times.
            raise InputError(
                f"{path} does not say when its frames were taken; put it into a file that does, "
                f"with the rate it was filmed at: ffmpeg -framerate 30 -i {quote(path.name)} -crf 12 "
                f"{quote(f'{path.stem}.mp4')}"
            )
        self._frames = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))  # 0 or less: unknown
        size_wh = (
            int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        self._intrinsics = load_intrinsics(self._settings.intrinsics).scaled_to(size_wh)
        self._start_ns, self._times = None, VideoTimes(fps)
        return CameraInfo(path.name, size_wh, self._intrinsics.K, fps, self._intrinsics.distortion)

    def read(self, stop: threading.Event) -> Frame:
        """The next frame, not before its time. Raises EndOfStream after the last, InputError if none can be read."""
        assert self._capture is not None
        if stop.is_set():
            raise EndOfStream
        skipping_until_ns = time.monotonic_ns() + SKIPPING_MAX_NS
        self._grab(self._capture)
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        while self._follows() and self._start_ns + self._times.next_ns <= (now_ns := time.monotonic_ns()):
            if stop.is_set() or now_ns >= skipping_until_ns:
                break
            self._grab(self._capture)
        index, capture_ns = self._times.index, self._start_ns + self._times.last_ns
        wait_until(capture_ns, stop)
        read, image_bgr = self._capture.retrieve()
        if not read:
            raise EndOfStream
        meta = FrameMeta(index, capture_ns, time.monotonic_ns())
        image = np.asarray(image_bgr, dtype=np.uint8)
        return Frame(meta, image, self._intrinsics.K, self._intrinsics.distortion)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _grab(self, capture: cv2.VideoCapture) -> None:
        """Advance to the next frame. Raises EndOfStream if there is none, InputError if there never was one."""
        undecodable = grab_next(capture)
        if undecodable is None:
            if self._times.index < 0:
                raise InputError(f"{self._settings.path} has no readable frame")
            raise EndOfStream
        self._times.take(round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6), undecodable)

    def _follows(self) -> bool:
        """Whether another frame follows: the last one is not skipped, however late the reader."""
        return self._frames <= 0 or self._times.index + 1 < self._frames


class VideoTimes:
    """Times of a video's frames, relative to the first.

    If the file's timestamps are those of its frame rate except for rounding, the exact times are used. A frame without
    a timestamp (the last ones of some files) or with one of another clock (joined videos) follows at that rate. One
    wrong timestamp changes no other frame's time.
    """

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._period_ns = self._step_ns = round(1e9 / fps)
        self._stamp_ns = self._told_ns = 0  # of the last frame: its timestamp in the file, and its time by them
        self._sure_stamp_ns = self._sure_ns = 0  # the same of the last frame whose timestamp was believed
        self.index = -1  # of the last frame
        self.last_ns = 0

    @property
    def next_ns(self) -> int:
        """Expected time of the next frame, from the last interval: its timestamp is not known before it is read."""
        return self.last_ns + self._step_ns

    def take(self, stamp_ns: int, undecodable: int = 0) -> None:
        """Add the next frame, by its timestamp in the file, and before it as many that cannot be decoded."""
        since_ns, self._stamp_ns = stamp_ns - self._stamp_ns, stamp_ns
        if self.index < 0:
            self.index, self._sure_stamp_ns = undecodable, stamp_ns
            self.last_ns = self._told_ns = self._sure_ns = undecodable * self._period_ns
            return
        self.index += 1 + undecodable
        if 0 < (since_sure_ns := stamp_ns - self._sure_stamp_ns) <= GAP_MAX_NS:
            self._told_ns = self._sure_ns + since_sure_ns
            self._sure_stamp_ns, self._sure_ns = stamp_ns, self._told_ns
        elif 0 < since_ns <= GAP_MAX_NS:  # the second one of another clock
            self._told_ns += since_ns
            self._sure_stamp_ns, self._sure_ns = stamp_ns, self._told_ns
        else:
            self._told_ns += (1 + undecodable) * self._period_ns
        by_rate_ns = round(self.index * 1e9 / self._fps)
        time_ns = by_rate_ns if abs(self._told_ns - by_rate_ns) <= ROUNDING_NS else self._told_ns
        time_ns = max(time_ns, self.last_ns + 1)
        self._step_ns, self.last_ns = time_ns - self.last_ns, time_ns


def tells_times(path: Path) -> bool:
    """Whether a video's frames have timestamps, or it has only one. H.264 and JPEG without a container have none."""
    capture = open_video(str(path))
    stamps_ms = [capture.get(cv2.CAP_PROP_POS_MSEC) for _ in range(2) if grab_next(capture) is not None]
    capture.release()
    return len(stamps_ms) < 2 or (stamps_ms[0] < stamps_ms[1] and not _is_bare_jpeg(path))


def _is_bare_jpeg(path: Path) -> bool:
    """Whether it is a sequence of JPEGs, plain or as multipart from a web camera: ffmpeg invents their timestamps."""
    with path.open("rb") as file:
        return file.read(16).lstrip().startswith((b"\xff\xd8", b"--"))
