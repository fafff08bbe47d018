"""What files and network streams have in common: ffmpeg reads them, through OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

import cv2

COUNTED_FPS = 25.0  # as which ffmpeg counts pictures that come without times


def open_video(name: str, settings: Sequence[int] = ()) -> cv2.VideoCapture:
    """`settings`: OpenCV's properties and their values, by turns.

    Pictures come as the sensor read them out, whatever the video says of how to turn them: so the lens was calibrated,
    and so the camera sits on its mount.
    """
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, settings)
    if capture.isOpened():
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def may_be_bare_jpeg(capture: cv2.VideoCapture) -> bool:
    """Whether JPEG may follow JPEG with nothing between that tells the time, as web cameras send them: the times that
    ffmpeg tells then are made up, whatever the pictures' rate is. A container may look alike until it tells one that
    `is_counted` is not."""
    jpeg = capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*"MJPG")
    return jpeg and capture.get(cv2.CAP_PROP_FPS) == COUNTED_FPS and capture.get(cv2.CAP_PROP_FRAME_COUNT) <= 0


def is_counted(position_ms: float) -> bool:
    """Whether a time may be a count of pictures: no camera's own clock keeps to it for long."""
    return round(position_ms * COUNTED_FPS) % 1000 == 0
