"""Common to video files and network streams: both are read by ffmpeg through OpenCV."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Sequence
from pathlib import Path

import cv2

from edge.errors import InputError

COUNTED_FPS = 25.0  # rate that ffmpeg assumes for pictures without timestamps
UNDECODABLE_MAX = 10  # pictures in a row; with as many, it is the end


def check_file(path: Path) -> None:
    """Raise InputError unless it is a file that may be read: OpenCV does not say why it opens none."""
    try:
        there, readable = stat.S_ISREG(path.stat().st_mode), os.access(path, os.R_OK)
    except OSError as error:
        there, readable = False, not isinstance(error, PermissionError)  # a folder above it may not be entered
    if not readable:
        raise InputError(f"{path} cannot be read: {os.strerror(errno.EACCES)}")
    if not there:
        raise InputError(f"{path} does not exist")


def open_video(name: str, settings: Sequence[int] = ()) -> cv2.VideoCapture:
    """`settings`: OpenCV's properties and their values, alternating.

    Pictures are not rotated, whatever the video's metadata say: calibration and mount refer to the sensor's readout.
    """
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, settings)
    if capture.isOpened():
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def grab_next(video: cv2.VideoCapture) -> int | None:
    """Advance to the next picture that can be decoded; returns how many before it cannot be, None at the end.

    OpenCV reports a picture that its decoder refuses as it reports the end, but grabs the one after it.
    """
    for undecodable in range(UNDECODABLE_MAX):
        if video.grab():
            return undecodable
    return None


def may_be_bare_jpeg(capture: cv2.VideoCapture) -> bool:
    """Whether it may be a sequence of JPEGs without timestamps, as web cameras send: ffmpeg then invents them, whatever
    the rate. A container may look the same until it gives a timestamp for which `is_counted` is false."""
    jpeg = capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*"MJPG")
    return jpeg and capture.get(cv2.CAP_PROP_FPS) == COUNTED_FPS and capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0


def is_counted(position_ms: float) -> bool:
    """Whether a timestamp may be a count of pictures at COUNTED_FPS: a real clock does not match that for long."""
    return round(position_ms * COUNTED_FPS) % 1000 == 0
