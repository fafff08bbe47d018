"""Pictures that tell their numbers, and the lens that a live camera of the tests has."""

from __future__ import annotations

import threading
from contextlib import closing

import numpy as np

from edge.cameras.source import EndOfStream, Source
from edge.config_camera import IntrinsicsSettings
from edge.types import Frame

SIZE_WH = (320, 180)
JPEG_FRAME = b"\xff\xc0"  # begins the part of a JPEG that tells the size, and stands nowhere else in it
LENS = [-0.2, 0.05, 0.001, -0.001, 0.0]
INTRINSICS = IntrinsicsSettings(fx=300, fy=300, cx=159.5, cy=89.5, width=320, height=180, distortion=LENS)


def picture(index: int, size_wh: tuple[int, int] = SIZE_WH) -> np.ndarray:
    """Tells its number, modulo 25, by its brightness."""
    return np.full((size_wh[1], size_wh[0], 3), 10 * (index % 25), np.uint8)


def damaged_jpeg(data: bytes, numbers: set[int]) -> bytes:
    """The same file or picture with these of its JPEGs, counted from 0, damaged so that they cannot be decoded."""
    before, *pictures = data.split(JPEG_FRAME)
    assert len(pictures) > max(numbers)
    return before + b"".join((bytes(2) if n in numbers else JPEG_FRAME) + rest for n, rest in enumerate(pictures))


def number_of(frame: Frame) -> int:
    return round(float(frame.image_bgr.mean()) / 10)


def play(source: Source) -> list[Frame]:
    """Every frame until the end, as a reader gets it that is always in time."""
    frames = []
    with closing(source):
        source.open()
        try:
            while True:
                frames.append(source.read(threading.Event()))
        except EndOfStream:
            return frames
