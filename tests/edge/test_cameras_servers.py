"""RTSP and HTTP cameras: a small server of each, asked as a network camera is, and the pictures it sends."""

from __future__ import annotations

import re
import select
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import closing, suppress
from fractions import Fraction
from itertools import count, pairwise
from typing import BinaryIO, Literal

import av
import cv2
import numpy as np
import pytest

from edge.cameras.stream import StreamSource
from edge.config_camera import StreamCamera
from tests.waiting import until

from .pictures import INTRINSICS, SIZE_WH, damaged_jpeg, number_of, picture

FPS = 20
RTP_BYTES = 7 * 188  # whole packets of MPEG-TS
RTP_MP2T = 33
SDP = f"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=-\r\nt=0 0\r\nm=video 0 RTP/AVP {RTP_MP2T}\r\na=control:track0\r\n"


class Sink:
    """Where a muxer writes: hands on `size` bytes at a time, or as they come. Who has hung up is no error to it."""

    def __init__(self, send: Callable[[bytes], object], size: int | None) -> None:
        self._send, self._size, self._held, self.there = send, size, b"", True

    def write(self, data: bytes) -> int:
        self._held += data
        size = self._size or len(self._held)
        while self.there and len(self._held) >= size > 0:
            try:
                self._send(self._held[:size])
            except OSError:
                self.there = False
            self._held = self._held[size:]
        return len(data)


def film(send: Callable[[bytes], object], size: int | None = None) -> None:
    """Numbered pictures as MPEG-TS in real time, until `send` raises OSError: nobody looks any more."""
    sink = Sink(send, size)
    with av.open(sink, "w", format="mpegts") as out:
        stream = out.add_stream("mpeg2video", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = 5, 0
        began_s, index = time.monotonic(), 0
        while sink.there:
            time.sleep(max(began_s + index / FPS - time.monotonic(), 0))
            frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            out.mux(stream.encode(frame))
            index += 1


class Server(threading.Thread, ABC):
    """Serves one caller, whose requests it keeps."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self.requests: list[str] = []

    def run(self) -> None:
        with self._listening, self._listening.accept()[0] as caller, caller.makefile("rb") as lines:
            self.serve(caller, lines)

    @abstractmethod
    def serve(self, caller: socket.socket, lines: BinaryIO) -> None:
        """Answer its requests and film until it hangs up."""

    def heard(self, lines: BinaryIO) -> str:
        """The next request's head."""
        head = "".join(iter(lambda: lines.readline().decode(), "\r\n"))
        self.requests.append(head)
        return head


class HttpCamera(Server):
    def serve(self, caller: socket.socket, lines: BinaryIO) -> None:
        self.heard(lines)
        caller.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: video/mp2t\r\nConnection: close\r\n\r\n")
        film(caller.sendall)


class WebCamera(Server):
    """JPEG after JPEG over HTTP (multipart/x-mixed-replace) to one caller after the other: nothing tells when one was
    taken. `sent` of them were, and each tells in its halves which it is; every `torn_every`th cannot be decoded."""

    def __init__(self, fps: int, torn_every: int = 10**9) -> None:
        super().__init__()
        self._fps, self._torn_every, self.sent = fps, torn_every, 0

    def run(self) -> None:
        with self._listening:
            while True:
                with self._listening.accept()[0] as caller, caller.makefile("rb") as lines, suppress(OSError):
                    self.serve(caller, lines)

    def serve(self, caller: socket.socket, lines: BinaryIO) -> None:
        self.heard(lines)
        caller.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=next\r\n\r\n")
        began_s = time.monotonic()
        for index in count():
            time.sleep(max(began_s + index / self._fps - time.monotonic(), 0))
            halves = np.hstack([picture(self.sent, (2, 4)), picture(self.sent // 25, (2, 4))])
            image = cv2.resize(halves, SIZE_WH, interpolation=cv2.INTER_NEAREST)
            jpeg = cv2.imencode(".jpg", image)[1].tobytes()
            if index % self._torn_every == self._torn_every - 1:
                jpeg = damaged_jpeg(jpeg, {0})
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            caller.sendall(head.encode() + jpeg + b"\r\n")
            self.sent += 1


class ContainerCamera(Server):
    """JPEG at the rate that ffmpeg takes pictures without times for, in a container that tells the camera's own; the
    link holds up every tenth."""

    def serve(self, caller: socket.socket, lines: BinaryIO) -> None:
        self.heard(lines)
        caller.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: video/x-matroska\r\n\r\n")
        sink = Sink(caller.sendall, None)
        with av.open(sink, "w", format="matroska", options={"cluster_time_limit": "1"}) as out:
            stream = out.add_stream("mjpeg", rate=25)
            stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuvj420p"
            stream.codec_context.time_base = Fraction(1, 1000)
            began_s, index = time.monotonic(), 0
            while sink.there:
                filmed_ms = index * 40 + index % 3
                held_ms = 60 if index % 10 == 9 else 0
                time.sleep(max(began_s + (filmed_ms + held_ms) / 1000 - time.monotonic(), 0))
                frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
                frame.pts, frame.time_base = filmed_ms, Fraction(1, 1000)
                out.mux(stream.encode(frame))
                index += 1


class RtspCamera(Server):
    """RFC 2326 as far as a player asks it: pictures by RTP in the connection itself, or in datagrams."""

    def serve(self, caller: socket.socket, lines: BinaryIO) -> None:
        udp, sent = socket.socket(type=socket.SOCK_DGRAM), 0
        with udp:
            udp.bind(("127.0.0.1", 0))
            client: tuple[str, int] | None = None
            while True:
                head = self.heard(lines)
                extra, body = "", ""
                if head.startswith("OPTIONS"):
                    extra = "Public: DESCRIBE, SETUP, PLAY\r\n"
                elif head.startswith("DESCRIBE"):
                    body, extra = SDP, f"Content-Type: application/sdp\r\nContent-Length: {len(SDP)}\r\n"
                elif head.startswith("SETUP"):
                    asked = re.search(r"Transport: (.*)\r\n", head)
                    ports = re.search(r"client_port=(\d+)", head)
                    assert asked is not None
                    own = f";server_port={udp.getsockname()[1]}" if ports else ""
                    client = ("127.0.0.1", int(ports[1])) if ports else None
                    extra = f"Transport: {asked[1]}{own}\r\nSession: 1\r\n"
                number = re.search(r"CSeq: (\d+)", head)
                assert number is not None
                caller.sendall(f"RTSP/1.0 200 OK\r\nCSeq: {number[1]}\r\n{extra}\r\n{body}".encode())
                if head.startswith("PLAY"):
                    break

            def send(data: bytes) -> None:
                nonlocal sent
                packet = struct.pack(">BBHII", 0x80, RTP_MP2T, sent % 2**16, sent * 90, 1) + data
                sent += 1
                if client is None:
                    caller.sendall(struct.pack(">cBH", b"$", 0, len(packet)) + packet)
                elif select.select([caller], [], [], 0)[0]:
                    raise BrokenPipeError("TEARDOWN")
                else:
                    udp.sendto(packet, client)

            film(send, RTP_BYTES)


def seen(url: str, transport: Literal["tcp", "udp"] = "tcp") -> tuple[list[int], np.ndarray]:
    """Numbers of 20 pictures as they come, and their stamps in ns."""
    settings = StreamCamera(type="stream", url=url, rtsp_transport=transport, intrinsics=INTRINSICS)
    with closing(StreamSource(settings)) as source:
        source.open()
        frames = [source.read(threading.Event()) for _ in range(20)]
    return [number_of(frame) for frame in frames], np.array([frame.meta.capture_ns for frame in frames])


def is_real_time(numbers: list[int], stamps_ns: np.ndarray) -> bool:
    """Whether picture follows picture, each stamped by the camera's own clock."""
    follow = all((after - before) % 25 == 1 for before, after in pairwise(numbers))
    return follow and float(np.median(np.abs(np.diff(stamps_ns) - 1e9 / FPS))) < 1e5


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_an_rtsp_camera_is_looked_through_by_the_transport_that_is_set(transport: Literal["tcp", "udp"]) -> None:
    camera = RtspCamera()
    camera.start()
    numbers, stamps_ns = seen(f"rtsp://127.0.0.1:{camera.port}/main", transport)
    assert is_real_time(numbers, stamps_ns)
    setup = next(head for head in camera.requests if head.startswith("SETUP"))
    assert ("interleaved" in setup) == (transport == "tcp")
    assert ("client_port" in setup) == (transport == "udp")


def test_an_http_camera_is_looked_through() -> None:
    camera = HttpCamera()
    camera.start()
    assert is_real_time(*seen(f"http://127.0.0.1:{camera.port}/video.ts"))
    assert camera.requests[0].startswith("GET /video.ts")


@pytest.mark.parametrize("fps", [10, 60])
def test_a_web_camera_s_pictures_are_of_when_they_came_whatever_their_rate(fps: int) -> None:
    """ffmpeg counts them as 25 a second: of fewer each would seem later than the one before."""
    camera = WebCamera(fps)
    camera.start()
    url = f"http://127.0.0.1:{camera.port}/video.mjpg"
    with closing(StreamSource(StreamCamera(type="stream", url=url, latency_ms=30, intrinsics=INTRINSICS))) as source:
        source.open()
        frames = [source.read(threading.Event()) for _ in range(20)]
    assert {frame.meta.arrival_ns - frame.meta.capture_ns for frame in frames} == {30_000_000}
    assert frames[0].meta.sequence < 2 * fps  # what waited is passed over for half a second, not for five
    assert source.counts["unstamped"] >= len(frames)


def test_a_web_camera_s_pictures_that_waited_to_be_read_are_not_told_as_of_now() -> None:
    """As while a model is loaded. A slow machine would be long in catching up, and tell each as of when it was decoded:
    the camera is called again."""
    camera = WebCamera(fps=20)
    camera.start()
    url = f"http://127.0.0.1:{camera.port}/video.mjpg"
    with closing(StreamSource(StreamCamera(type="stream", url=url, intrinsics=INTRINSICS))) as source:
        source.open()
        until(lambda: camera.sent >= 40, what="pictures that wait")
        waiting = camera.sent
        left, right = np.array_split(source.read(threading.Event()).image_bgr, 2, axis=1)
    assert round(float(left.mean()) / 10) + 25 * round(float(right.mean()) / 10) >= waiting
    assert len(camera.requests) == 2


def test_a_stream_s_picture_that_cannot_be_decoded_is_left_out_and_the_stream_stays_open() -> None:
    """OpenCV reports it as it reports that the stream has ended."""
    camera = WebCamera(fps=60, torn_every=9)
    camera.start()
    url = f"http://127.0.0.1:{camera.port}/video.mjpg"
    with closing(StreamSource(StreamCamera(type="stream", url=url, intrinsics=INTRINSICS))) as source:
        source.open()
        numbers = [source.read(threading.Event()).meta.sequence for _ in range(20)]
    assert source.counts["undecodable"] >= 2
    left_out = {after - before - 1 for before, after in pairwise(numbers)}
    assert left_out == {0, 1}


def test_jpeg_in_a_container_is_of_the_times_that_this_tells() -> None:
    """At 25 a second too, where it looks like JPEG without any: what the link held up would be told as new."""
    camera = ContainerCamera()
    camera.start()
    url = f"http://127.0.0.1:{camera.port}/video.mkv"
    with closing(StreamSource(StreamCamera(type="stream", url=url, intrinsics=INTRINSICS))) as source:
        source.open()
        frames = [source.read(threading.Event()) for _ in range(40)]
    between_ms = [(b.meta.capture_ns - a.meta.capture_ns) / 1e6 for a, b in pairwise(frames)]
    assert max(between_ms) < 50  # 80 and more between the arrivals
    assert source.counts["unstamped"] < 10
