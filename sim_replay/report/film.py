"""Encodes the overlay's frames as a video that browsers play."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np

from sim_replay.overlay import Image

WIDTH_MAX_PX = 1280
CODEC = "libvpx-vp9"
# Fifteen times as fast as the codec's own settings, which OpenCV's writer cannot change.
OPTIONS = {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "crf": "26", "b": "0"}


def write_video(path: Path, frames: Iterable[Image], fps: float, size_wh: tuple[int, int]) -> None:
    """Encode frames [H, W, 3] of `size_wh`, BGR, scaled down to 1280 wide, as VP9 in MP4. Raises OSError."""
    scale = min(1.0, WIDTH_MAX_PX / size_wh[0])
    video_wh = (round(size_wh[0] * scale / 2) * 2, round(size_wh[1] * scale / 2) * 2)
    rate = Fraction(fps).limit_denominator(1001)
    # A relative path with a colon would be taken for a URL.
    with av.open(str(path.absolute()), mode="w") as container:
        stream = cast(av.VideoStream, container.add_stream(CODEC, rate=rate, options=OPTIONS))
        stream.width, stream.height = video_wh
        stream.pix_fmt = "yuv420p"
        for count, image in enumerate(frames):
            scaled = cv2.resize(image, video_wh, interpolation=cv2.INTER_AREA)
            planes = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_BGR2YUV_I420), np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
