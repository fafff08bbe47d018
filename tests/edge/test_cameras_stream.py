"""Streams over the network as cameras: whose time their frames carry, and what waited to be read."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, HTTPServer

import av
import cv2
import numpy as np
import pytest

from edge.cameras.capture import Capture
from edge.cameras.losses import Losses
from edge.cameras.source import SourceLost
from edge.cameras.stream import StreamSource
from edge.config_camera import StreamCamera
from edge.types import Frame
from sim_replay.ports import free_port
from tests.waiting import until

from .pictures import INTRINSICS, LENS, SIZE_WH, number_of, picture

WAITING = 40  # frames
TENTH_IS_KEY = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "keyint=10:min-keyint=10:scenecut=0"}


class UdpCamera(threading.Thread):
    """An encoder that sends MPEG-TS or RTP over UDP in real time until told to stop, with a key frame each tenth. While
    `bad` is set, these do not arrive."""

    def __init__(self, port: int, fps: int, lost: int | None = None, rtp: bool = False) -> None:
        """`lost`: the number of a picture, modulo 50, that does not arrive."""
        super().__init__()
        self._url, self._fps, self.stop = f"udp://127.0.0.1:{port}?pkt_size=1316", fps, threading.Event()
        self._format = "mpegts"
        if rtp:
            self._url, self._format = f"rtp://127.0.0.1:{port}", "rtp"
        self._lost, self.bad = lost, threading.Event()

    def run(self) -> None:
        with av.open(self._url, "w", format=self._format) as out:
            stream = out.add_stream("libx264", rate=self._fps, options=TENTH_IS_KEY)
            stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
            start_s, index = time.monotonic(), 0
            while not self.stop.wait(max(start_s + index / self._fps - time.monotonic(), 0)):
                frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
                frame.pts, frame.time_base = index, Fraction(1, self._fps)
                packets = stream.encode(frame)
                if index % 50 != self._lost and not (self.bad.is_set() and index % 10 == 0):
                    out.mux(packets)
                index += 1


def test_a_udp_stream_is_stamped_by_its_own_clock() -> None:
    port = free_port(socket.SOCK_DGRAM)
    encoder = UdpCamera(port, fps=20)
    settings = StreamCamera(type="stream", url=f"udp://127.0.0.1:{port}", intrinsics=INTRINSICS, latency_ms=30)
    encoder.start()
    try:
        source = StreamSource(settings)
        with closing(source):
            source.open()
            frames = [source.read(threading.Event()) for _ in range(30)]
            assert source.counts["unstamped"] == 0
    finally:
        encoder.stop.set()
        encoder.join()
    stamps_ns = np.array([frame.meta.capture_ns for frame in frames])
    late_ns = np.array([frame.meta.arrival_ns for frame in frames]) - stamps_ns
    assert np.all(late_ns >= 30_000_000 - 1)
    # However the frames bunched on their way, most steps are the camera's own to the microsecond.
    assert np.median(np.abs(np.diff(stamps_ns) - 50_000_000)) < 100_000
    assert all(frame.distortion == tuple(LENS) for frame in frames)


@contextmanager
def described(port: int) -> Iterator[str]:
    """The address of a web server that answers with the SDP of H.264 by RTP to this port."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            session = ("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=-", "c=IN IP4 127.0.0.1", "t=0 0")
            media = (f"m=video {port} RTP/AVP 96", "a=rtpmap:96 H264/90000", "a=fmtp:96 packetization-mode=1")
            sdp = "".join(f"{line}\r\n" for line in (*session, *media)).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(sdp)))
            self.end_headers()
            self.wfile.write(sdp)

        def log_message(self, format: str, *values: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/nose.sdp"
        server.shutdown()


@pytest.mark.parametrize("rtp", [False, True])
def test_what_is_damaged_by_a_loss_before_it_is_not_shown(rtp: bool) -> None:
    port = free_port(socket.SOCK_DGRAM)
    encoder = UdpCamera(port, fps=20, lost=33, rtp=rtp)
    encoder.start()
    try:
        with described(port) if rtp else nullcontext(f"udp://127.0.0.1:{port}") as url:
            source, numbers = StreamSource(StreamCamera(type="stream", url=url, intrinsics=INTRINSICS)), list[int]()
            with closing(source):
                source.open()
                while source.counts["damaged"] == 0:
                    numbers.append(number_of(source.read(threading.Event())))
    finally:
        encoder.stop.set()
        encoder.join()
    assert source.counts["damaged"] == 6
    assert numbers[-2:] == [32 % 25, 40 % 25]


def test_a_stream_of_which_all_is_damaged_is_told_of_until_it_recovers() -> None:
    port = free_port(socket.SOCK_DGRAM)
    encoder = UdpCamera(port, fps=20)
    settings = StreamCamera(type="stream", url=f"udp://127.0.0.1:{port}", intrinsics=INTRINSICS)
    capture = Capture(StreamSource(settings), False)

    def kinds() -> list[str]:
        return [reason.kind for reason in capture.reasons(time.monotonic_ns())]

    encoder.start()
    capture.start()
    try:
        until(lambda: capture.counters()["captured"] >= 10, what="sound pictures")
        assert "camera_damaged" not in kinds()
        encoder.bad.set()
        until(lambda: "camera_damaged" in kinds(), what="the reason")
        encoder.bad.clear()
        until(lambda: "camera_damaged" not in kinds(), what="a key frame")
        counters = capture.counters()
    finally:
        capture.stop()
        encoder.stop.set()
        encoder.join()
    assert counters["camera_damaged"] > 0
    assert counters["reconnects"] == 0


@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_a_picture_is_damaged_from_a_loss_to_the_next_key_frame_or_for_two_seconds(rate_hz: float) -> None:
    losses, step_ms = Losses(lossy=True), 1000.0 / rate_hz
    times_ms = [index * step_ms for index in range(200) if index not in (50, 130)]
    damaged = [time_ms for time_ms in times_ms if losses.damaged(time_ms, key=time_ms in (0.0, 60 * step_ms))]
    assert damaged[:9] == pytest.approx([index * step_ms for index in range(51, 60)])
    assert damaged[9] == pytest.approx(131 * step_ms)
    assert damaged[-1] - damaged[9] == pytest.approx(2000.0, abs=1.01 * step_ms)


def test_what_follows_an_outage_is_damaged_though_an_earlier_loss_has_healed_meanwhile() -> None:
    losses, sent = Losses(lossy=True), [*range(60), *range(61, 70), *range(160, 260)]
    damaged = [index for index in sent if losses.damaged(index * 40.0, key=index == 0)]
    assert damaged == [*range(61, 70), *range(160, 210)]


@pytest.mark.parametrize("left_out", [5, 3])
def test_an_encoder_that_leaves_out_pictures_by_itself_loses_few_of_those_it_sends(left_out: int) -> None:
    """Each fifth or third of 30 a second, with a key frame each two seconds."""
    losses, sent = Losses(lossy=True), [index for index in range(1800) if index % left_out]
    damaged = [losses.damaged(index * 1000.0 / 30.0, key=index % 60 == 1) for index in sent]
    assert sum(damaged) < 0.1 * len(sent)


def test_an_encoder_that_halves_its_rate_in_flight_is_soon_taken_as_it_is() -> None:
    """As in the dusk, when the camera exposes for longer; without a key frame."""
    losses = Losses(lossy=True)
    times_ms = [*(index * 100.0 / 3.0 for index in range(3000)), *(1e5 + index * 200.0 / 3.0 for index in range(1000))]
    assert sum(losses.damaged(time_ms, key=False) for time_ms in times_ms) < 60


class SilentCamera(threading.Thread):
    """A server that sends so many pictures of H.264 and then nothing, until told to stop."""

    def __init__(self, pictures: int, torn: int | None = None) -> None:
        """`torn`: the number of a picture, modulo 50, of which nothing but ones arrive, in Matroska: of MPEG-TS, ffmpeg
        leaves out what is no picture."""
        super().__init__(daemon=True)
        self._torn = torn
        self._container, self._options = ("mpegts", {}) if torn is None else ("matroska", {"cluster_time_limit": "1"})
        self._server, self._pictures, self.stop = socket.create_server(("127.0.0.1", 0)), pictures, threading.Event()
        self.port = int(self._server.getsockname()[1])

    def run(self) -> None:
        with (
            self._server,
            self._server.accept()[0] as connected,
            av.open(Caller(connected), "w", format=self._container, options=self._options) as out,
        ):
            stream = out.add_stream("libx264", rate=50, options=TENTH_IS_KEY)
            stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
            start_s = time.monotonic()
            for index in range(self._pictures):
                if self.stop.wait(max(start_s + index / 50 - time.monotonic(), 0)):
                    break
                frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
                frame.pts, frame.time_base = index, Fraction(1, 50)
                for packet in stream.encode(frame):
                    if index % 50 == self._torn:
                        packet.update(bytes(packet)[:4] + b"\xff" * (packet.size - 4))
                    out.mux(packet)
            self.stop.wait()


def test_the_decoder_holds_no_picture_back() -> None:
    """Only what is read ahead waits, here until nothing came for seconds: the next one tells that it is complete."""
    camera, frames = SilentCamera(pictures=200), list[Frame]()
    camera.start()
    settings = StreamCamera(type="stream", url=f"tcp://127.0.0.1:{camera.port}", intrinsics=INTRINSICS)
    with closing(StreamSource(settings)) as source:
        source.open()
        with suppress(SourceLost):
            while True:
                frames.append(source.read(threading.Event()))
    camera.stop.set()
    camera.join()
    late = [frame for frame in frames if frame.meta.arrival_ns - frames[-1].meta.arrival_ns > -1_000_000_000]
    assert [number_of(frame) for frame in late] == [198 % 25, 199 % 25]


def test_what_is_predicted_from_a_picture_that_cannot_be_decoded_is_not_shown() -> None:
    camera = SilentCamera(pictures=200, torn=13)
    camera.start()
    settings = StreamCamera(type="stream", url=f"tcp://127.0.0.1:{camera.port}", intrinsics=INTRINSICS)
    with closing(StreamSource(settings)) as source:
        source.open()
        numbers = [number_of(source.read(threading.Event()))]
        before = source.counts["damaged"]  # that the stream began with
        while source.counts["damaged"] == before:
            numbers.append(number_of(source.read(threading.Event())))
    camera.stop.set()
    camera.join()
    assert source.counts["damaged"] == before + 6
    assert numbers[-2:] == [12, 20]


class Caller:
    """Where a muxer writes; who has hung up is no error to it."""

    def __init__(self, connected: socket.socket) -> None:
        self._connected, self.there = connected, True

    def write(self, data: bytes) -> int:
        try:
            self._connected.sendall(data)
        except OSError:
            self.there = False
        return len(data)


class TcpCamera(threading.Thread):
    """A server that sends MPEG-TS in real time to who calls, one after the other; what is not read waits."""

    def __init__(self, fps: int, frames: int = 2000, port: int = 0, calls: int = 1) -> None:
        super().__init__(daemon=True)
        self._server, self.began_s = socket.create_server(("127.0.0.1", port)), 0.0
        self._fps, self._frames, self._calls = fps, frames, calls
        self.port = int(self._server.getsockname()[1])

    def run(self) -> None:
        with self._server:
            for _ in range(self._calls):
                self._serve()

    def _serve(self) -> None:
        with self._server.accept()[0] as connected:
            caller = Caller(connected)
            with av.open(caller, "w", format="mpegts") as out:
                stream = out.add_stream("mpeg2video", rate=self._fps)
                stream.width, stream.height, stream.pix_fmt = *SIZE_WH, "yuv420p"
                stream.codec_context.gop_size, stream.codec_context.max_b_frames = 5, 0
                self.began_s, self.sent = time.monotonic(), 0
                for index in range(self._frames):
                    time.sleep(max(self.began_s + index / self._fps - time.monotonic(), 0))
                    image = np.hstack([picture(index), picture(index // 25)])
                    frame = av.VideoFrame.from_ndarray(cv2.resize(image, SIZE_WH), format="bgr24")
                    frame.pts, frame.time_base = index, Fraction(1, self._fps)
                    out.mux(stream.encode(frame))
                    self.sent += 1
                    if not caller.there:
                        return


def test_a_stream_that_waited_to_be_read_begins_with_what_is_now() -> None:
    camera = TcpCamera(fps=20)
    settings = StreamCamera(type="stream", url=f"tcp://127.0.0.1:{camera.port}", intrinsics=INTRINSICS)
    camera.start()
    with closing(StreamSource(settings)) as source:
        source.open()
        until(lambda: camera.sent >= WAITING, what="what is sent while the model is loaded")
        frames = [source.read(threading.Event()) for _ in range(40)]

    def late_s(frame: Frame) -> float:
        left, right = np.array_split(frame.image_bgr, 2, axis=1)
        index = round(float(left.mean()) / 10) + 25 * round(float(right.mean()) / 10)
        return frame.meta.capture_ns / 1e9 - (camera.began_s + index / 20)

    # What encoder, network and decoder take is common to all; what waited is not.
    assert late_s(frames[0]) - min(late_s(frame) for frame in frames) < 0.3 * WAITING / 20


def test_a_stream_that_is_absent_is_opened_when_it_comes_and_again_when_it_ends() -> None:
    port, frames = free_port(), 40
    settings = StreamCamera(type="stream", url=f"tcp://127.0.0.1:{port}", intrinsics=INTRINSICS)
    capture = Capture(StreamSource(settings), False)
    capture.start()
    try:
        assert capture.newest(0.3) is None
        TcpCamera(fps=20, frames=frames, port=port, calls=10).start()
        last = capture.newest(20.0)
        assert last is not None
        while last.meta.sequence <= frames:  # it was opened again
            newer = capture.newest(20.0)
            assert newer is not None
            assert newer.meta.sequence > last.meta.sequence
            last = newer
    finally:
        capture.stop()
    assert capture.counters()["reconnects"] >= 2


def test_all_that_a_stream_counts_is_told_from_the_start() -> None:
    source = StreamSource(StreamCamera(type="stream", url="udp://127.0.0.1:9", intrinsics=INTRINSICS))
    assert {name for name in Capture(source, False).counters() if name.startswith("camera_")} == {
        "camera_unstamped",
        "camera_undecodable",
        "camera_catching_up",
        "camera_damaged",
    }


def test_a_stream_is_named_without_its_password() -> None:
    port = free_port()
    settings = StreamCamera(type="stream", url=f"http://pilot:se@cret@127.0.0.1:{port}/x", intrinsics=INTRINSICS)
    source = StreamSource(settings)
    assert source.nominal().name == f"http://***@127.0.0.1:{port}/x"
    with closing(source), pytest.raises(SourceLost) as lost:
        source.open()
    assert "cret" not in str(lost.value)
