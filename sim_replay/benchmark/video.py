"""Encodes a sequence with H.264 at a given bitrate and decodes it, as a video link would."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction

import av
import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def through_h264(images_bgr: Iterator[Image], fps: float, kbps: int) -> Iterator[Image]:
    """The images [H, W, 3], H and W even, as decoded: the same number, in the same order.

    libx264 on one thread, low delay, one key frame per two seconds: the same bytes for the same images.
    """
    stream = io.BytesIO()
    count = _encode(images_bgr, stream, fps, kbps)
    stream.seek(0)
    with av.open(stream, mode="r") as container:
        given = 0
        for frame in container.decode(video=0):
            given += 1
            yield np.asarray(cv2.cvtColor(frame.to_ndarray(format="yuv420p"), cv2.COLOR_YUV2BGR_I420), np.uint8)
    if given != count:
        raise RuntimeError(f"the codec gave {given} pictures for {count}")


def _encode(images_bgr: Iterator[Image], target: io.BytesIO, fps: float, kbps: int) -> int:
    count = 0
    with av.open(target, mode="w", format="matroska") as container:
        rate = Fraction(fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt, stream.bit_rate = "yuv420p", 1000 * kbps
        stream.codec_context.thread_count = 1
        stream.codec_context.gop_size = max(1, round(2 * fps))
        vbv = {"maxrate": f"{kbps}k", "bufsize": f"{kbps}k"}
        stream.options = {"preset": "veryfast", "tune": "zerolatency", **vbv}
        for image in images_bgr:
            if count == 0:
                stream.height, stream.width = image.shape[:2]
            # OpenCV's conversion both ways: libswscale's fast one shifts every colour by a few levels.
            planes = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420), np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode(None))
    return count
