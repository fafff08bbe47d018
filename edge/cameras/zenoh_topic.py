"""A camera on zenoh: sensor_msgs/CompressedImage, as a ROS 2 driver over rmw_zenoh publishes it."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter

import cv2
import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh import handlers

from edge.cameras.intrinsics import Intrinsics, load_intrinsics
from edge.cameras.source import EndOfStream, SourceLost
from edge.cameras.stamps import StampCheck
from edge.cameras.watch import PUBLISHER_SILENT_NS
from edge.clock import UtcClock
from edge.config_camera import ZenohCamera
from edge.errors import InputError
from edge.types import CameraInfo, Frame, FrameMeta
from msgs.cdr import CompressedImage
from msgs.session import client_config, reason_of
from msgs.topics import IMAGE, dds_type, parse_attachment
from msgs.wire import PayloadError

log = logging.getLogger(__name__)

SILENCE_S = 3.0
LOOK_S = 0.1
STAMP_AGE_MAX_NS = 2_000_000_000
# 200 MB when decoded, more than any camera's: a PNG of 200 kB may unpack to gigabytes, which end the process.
PIXELS_MAX = 2**26
PNG_HEADER = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"  # then width and height
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of a frame's header
# A picture rotated according to its EXIF data would not fit the calibration.
DECODING = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
UNDECODABLE = f"cannot be decoded, or has more than 8 bits a channel or {PIXELS_MAX // 10**6} megapixels"


class _UnusableError(Exception):
    """A picture that the daemon cannot use; the text says why."""

    def __init__(self, counted_as: str, text: str) -> None:
        super().__init__(text)
        self.counted_as = counted_as


class ZenohSource:
    """The newest picture of a topic, with its header's timestamp as long as the sender's UTC agrees with ours.

    A picture that cannot be decoded or whose shape does not fit the calibration is counted and dropped, and so are
    those of a second publisher: of two cameras, or a camera and a recording of it, only one is used. So is whatever
    comes on a topic below this one, or is of another type.
    """

    live = True

    def __init__(self, settings: ZenohCamera) -> None:
        self._settings = settings
        self._intrinsics = load_intrinsics(settings.intrinsics)
        self._latency_ns = round(settings.latency_ms * 1e6)
        self._session: zenoh.Session | None = None
        self._arrived = threading.Condition()
        self._sample: tuple[int, bytes, bytes] | None = None  # arrival_ns, payload, attachment
        self._stem = f"{settings.domain}/{settings.topic}"
        self._other_key = ""  # of the last sample that was not on the topic or not of its type
        self._clock = UtcClock()
        self._stamps = StampCheck(STAMP_AGE_MAX_NS)
        self._sequence = 0
        self._sent: tuple[bytes, int] | None = None  # publisher of the last picture, and its sequence number
        self._heeded: tuple[bytes, int] | None = None  # the publisher in use, and when its last usable picture came
        self.counts: Counter[str] = Counter(
            unstamped=0, catching_up=0, undecodable=0, misfit=0, other_publisher=0, other_topic=0
        )

    def nominal(self) -> CameraInfo:
        lens = self._intrinsics
        return CameraInfo(self._settings.topic, lens.image_size_wh, lens.K, None, lens.distortion)

    def open(self) -> CameraInfo:
        """Raises SourceLost if nothing answers at the endpoint. The publisher may appear later."""
        tls = self._settings.tls.files() if self._settings.tls is not None else None
        try:
            self._session = zenoh.open(client_config([self._settings.connect], tls=tls))
            self._session.declare_subscriber(f"{self._stem}/**", handlers.Callback(self._take, indirect=False))
        except zenoh.ZError as error:
            self.close()
            reason = reason_of(error).rstrip("! ")
            raise SourceLost(f"no zenoh session with {self._settings.connect}: {reason}") from error
        return self.nominal()

    def read(self, stop: threading.Event) -> Frame:
        """The next picture. Raises SourceLost if none arrived for three seconds, or none that can be used."""
        silent_ns = time.monotonic_ns() + round(SILENCE_S * 1e9)
        unusable, why, others = 0, "", self.counts["other_topic"]
        while time.monotonic_ns() < silent_ns:
            if stop.is_set():
                raise EndOfStream
            looked_ns = time.monotonic_ns()
            with self._arrived:
                self._arrived.wait_for(lambda: self._sample is not None, LOOK_S)
                sample, self._sample = self._sample, None
            if sample is None:
                # Time during which this process stood still is no silence of the camera.
                silent_ns += max(time.monotonic_ns() - looked_ns - round(LOOK_S * 1e9), 0)
                continue
            try:
                return self._frame(*sample)
            except _UnusableError as error:
                self.counts[error.counted_as] += 1
                unusable, why = unusable + 1, str(error)
        topic, seconds = self._settings.topic, f"{SILENCE_S:.0f} s"
        if unusable:
            # "No picture" would make the user check the cable instead of the calibration.
            raise SourceLost(f"of {unusable} pictures on {topic} in {seconds} none can be used: the last {why}")
        if self.counts["other_topic"] > others:
            raise SourceLost(
                f"no sensor_msgs/CompressedImage on {topic} for {seconds}, but samples on {self._other_key}"
            )
        raise SourceLost(f"no picture on {topic} for {seconds}")

    def close(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def _take(self, sample: zenoh.Sample) -> None:
        """On zenoh's thread: keep the newest picture; a replaced one shows as a gap in the sequence numbers."""
        key = str(sample.key_expr)
        if not of_topic(key, self._stem):
            with self._arrived:
                self._other_key = key
                self.counts["other_topic"] += 1
            return
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        publisher, now_ns = _publisher(attachment), time.monotonic_ns()
        with self._arrived:
            if self._heeded is None:
                self._heeded = (publisher, now_ns)
            elif publisher != self._heeded[0]:
                if now_ns - self._heeded[1] <= PUBLISHER_SILENT_NS:
                    self.counts["other_publisher"] += 1
                    return
                log.info("the camera's topic has another publisher")
                self._heeded = (publisher, now_ns)
            self._sample = (now_ns, sample.payload.to_bytes(), attachment)
            self._arrived.notify()

    def _frame(self, arrival_ns: int, payload: bytes, attachment: bytes) -> Frame:
        """Raises _UnusableError."""
        try:
            message = CompressedImage.decode(payload)
        except PayloadError as error:
            raise _UnusableError("undecodable", "is no sensor_msgs/CompressedImage") from error
        image_bgr = decode_picture(message.data)
        if image_bgr is None:
            raise _UnusableError("undecodable", UNDECODABLE)
        fitted = self._fit((image_bgr.shape[1], image_bgr.shape[0]))
        stamp_ns = self._clock.monotonic_ns(message.stamp_ns)
        believed = self._stamps.believes(stamp_ns, arrival_ns)
        if believed is None:
            raise _UnusableError("catching_up", "is old, or its clock differs from ours")
        if not believed:
            self.counts["unstamped"] += 1
            stamp_ns = arrival_ns
        with self._arrived:
            if self._heeded is not None and self._heeded[0] == _publisher(attachment):
                self._heeded = (self._heeded[0], arrival_ns)
        meta = FrameMeta(self._number(attachment), stamp_ns - self._latency_ns, arrival_ns)
        return Frame(meta, image_bgr, fitted.K, fitted.distortion)

    def _fit(self, size_wh: tuple[int, int]) -> Intrinsics:
        """Raises _UnusableError."""
        try:
            return self._intrinsics.scaled_to(size_wh)
        except InputError as error:
            raise _UnusableError("misfit", f"is of another shape: {error}") from error

    def _number(self, attachment: bytes) -> int:
        """Sequence number that advances with the publisher's own numbers, so that lost pictures show as a gap."""
        parsed = parse_attachment(attachment)
        step = 1
        if parsed is not None:
            sent, _, publisher = parsed
            if self._sent is not None and self._sent[0] == publisher and sent > self._sent[1]:
                step = sent - self._sent[1]
            self._sent = (publisher, sent)
        self._sequence += step
        return self._sequence - 1


def _publisher(attachment: bytes) -> bytes:
    """The gid of a sample's publisher; empty: not told."""
    parsed = parse_attachment(attachment)
    return b"" if parsed is None else parsed[2]


def of_topic(key: str, stem: str) -> bool:
    """Whether a key is that of pictures on the topic `stem` (`<domain>/<topic>`): with their type and any hash, as
    rmw_zenoh has it, or without both. `stem/**` also matches the topics below."""
    below = key.removeprefix(stem).split("/")[1:]
    return not below or (len(below) == 2 and below[0] == dds_type(IMAGE))


def decode_picture(data: bytes) -> NDArray[np.uint8] | None:
    """JPEG or PNG of 8 bits and at most PIXELS_MAX to [H, W, 3] BGR as the sensor read it out, or None.

    The brightness scale of deeper pictures is unknown: 12 bits in 16 would be nearly black.
    """
    size_wh = picture_size_wh(data)
    if size_wh is None or size_wh[0] * size_wh[1] > PIXELS_MAX:
        return None
    try:
        image_bgr = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), DECODING)
    except cv2.error:
        return None
    return None if image_bgr is None or image_bgr.dtype != np.uint8 else np.asarray(image_bgr, dtype=np.uint8)


def picture_size_wh(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels from the header of a JPEG or PNG, without decoding it; None if it is neither."""
    if data.startswith(PNG_HEADER):
        at = len(PNG_HEADER)
        return (_big_endian(data, at, 4), _big_endian(data, at + 4, 4)) if at + 8 <= len(data) else None
    at = 2 if data.startswith(b"\xff\xd8") else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in JPEG_FRAMES:
            return _big_endian(data, at + 7, 2), _big_endian(data, at + 5, 2)
        # A marker may follow any number of bytes 0xFF.
        at += 1 if marker == 0xFF else 2 + _big_endian(data, at + 2, 2)
    return None


def _big_endian(data: bytes, at: int, size: int) -> int:
    return int.from_bytes(data[at : at + size], "big")
