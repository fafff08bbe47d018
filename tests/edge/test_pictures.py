"""Pictures as who looks, the disk and the ground behind a radio have them: real sessions on loopback."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh
from mcap.reader import make_reader

from edge.config import RecorderSettings, ZenohSettings
from edge.config_ground import ZenohTlsSettings
from edge.links.zenoh_link import ZenohLink
from edge.pictures import LIVE_BYTES_MAX, RECORDED_QUALITY, WAITING_MAX, Picture, Pictures, Rate, jpeg, small_jpeg
from edge.types import Frame, FrameMeta, Mount
from msgs.cdr import CompressedImage, PoseWithCovarianceStamped
from msgs.client import connect
from msgs.recording import Recorder
from msgs.session import TlsFiles, router_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import K, make_report, make_track
from .test_zenoh_config import make_keys
from .test_zenoh_link import MOUNT


def frame(sequence: int, capture_ns: int, seed: int | None = None) -> Frame:
    """A smooth picture whose brightness tells its number; with a seed, 4K of noise that no JPEG makes small."""
    if seed is None:
        image = np.full((270, 480, 3), 20 * sequence % 240, dtype=np.uint8)
    else:
        image = np.random.default_rng(seed).integers(0, 256, (2160, 3840, 3), dtype=np.uint8)
    return Frame(FrameMeta(sequence, capture_ns, capture_ns), image, K)


def decoded(payload: bytes) -> tuple[CompressedImage, np.ndarray]:
    message = CompressedImage.decode(payload)
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return message, np.asarray(image)


@contextlib.contextmanager
def shown(link: ZenohLink, live_hz: float, recorded_hz: float = 0.0) -> Iterator[Pictures]:
    link.start()
    pictures = Pictures(link, live_hz, recorded_hz)
    pictures.start()
    try:
        yield pictures
    finally:
        pictures.stop()
        link.stop()


def test_who_looks_sees_the_picture_with_the_stamp_of_its_poses_and_nothing_is_sent_before() -> None:
    endpoint = free_endpoint()
    link = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", Mount(MOUNT.R_body_cam, MOUNT.t_body_cam_m))
    pictures_of: dict[int, np.ndarray] = {}
    poses: set[int] = set()

    def look(sample: zenoh.Sample) -> None:
        message, image = decoded(sample.payload.to_bytes())
        pictures_of[message.stamp_ns] = image

    def hear(sample: zenoh.Sample) -> None:
        poses.add(PoseWithCovarianceStamped.decode(sample.payload.to_bytes()).stamp_ns)

    with shown(link, 10.0) as pictures, connect(endpoint) as session:
        pictures.show(frame(1, time.monotonic_ns()))
        assert not link.wants_picture()
        session.declare_subscriber("0/uav1/target/*/pose/**", zenoh.handlers.Callback(hear, indirect=False))
        session.declare_subscriber("0/uav1/image/**", zenoh.handlers.Callback(look, indirect=False))
        numbers = iter(range(1, 10_000))

        def fly() -> None:
            now_ns = time.monotonic_ns()
            link.publish(make_report(make_track(now_ns), now_ns=now_ns))
            pictures.show(frame(next(numbers), now_ns))

        def of_poses() -> int:
            """Pictures with a pose's stamp: of a report that was overtaken there is none, and UTC is measured anew."""
            told = list(poses)
            return sum(any(abs(stamp_ns - pose_ns) < 100_000 for pose_ns in told) for stamp_ns in list(pictures_of))

        until(lambda: len(pictures_of) >= 3 and of_poses() >= 2, fly, what="pictures with the stamps of poses")
    assert all(image.shape == (270, 480, 3) and np.ptp(image) <= 2 for image in pictures_of.values())
    stamps = np.array(sorted(pictures_of))
    # Ten a second on the frames' own clock: never closer than a period, but for where frames came late.
    assert (np.diff(stamps) > 0).all()
    assert stamps[-1] - stamps[0] >= (len(stamps) - 2) * 100_000_000


def test_a_link_that_has_ended_wants_no_pictures_and_does_not_end_who_asks() -> None:
    endpoint = free_endpoint()
    link = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT)
    link.start()
    with connect(endpoint) as session, session.declare_subscriber("0/uav1/image/**"):
        until(link.wants_picture, what="the viewer")
        link.stop()
        assert not link.wants_picture()


def test_a_picture_that_is_too_large_for_the_wire_is_sent_worse_or_counted() -> None:
    endpoint = free_endpoint()
    link = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT)
    sizes: list[int] = []
    with shown(link, 10.0) as pictures, connect(endpoint) as session:
        take = zenoh.handlers.Callback(lambda s: sizes.append(len(s.payload.to_bytes())), indirect=False)
        session.declare_subscriber("0/uav1/image/**", take)
        until(lambda: pictures.counters().get("not_encoded"), lambda: pictures.show(frame(1, now(), seed=1)))
        until(lambda: bool(sizes), lambda: pictures.show(frame(1, now())), what="one that fits")
    assert max(sizes) < LIVE_BYTES_MAX + 200


def test_a_4k_picture_full_of_detail_is_seen_with_all_its_pixels() -> None:
    """In JPEG's usual codes alone it is too large at any quality: who looks would wait in vain."""
    grain = np.random.default_rng(0).normal(120.0, 15.0, (540, 960)).clip(0, 255).astype(np.uint8)
    image = np.asarray(cv2.cvtColor(cv2.resize(grain, (3840, 2160)), cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    endpoint = free_endpoint()
    received: list[bytes] = []
    with (
        shown(ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT), 10.0) as pictures,
        connect(endpoint) as session,
    ):
        take = zenoh.handlers.Callback(lambda s: received.append(s.payload.to_bytes()), indirect=False)
        session.declare_subscriber("0/uav1/image/**", take)
        until(lambda: bool(received), lambda: pictures.show(Frame(FrameMeta(1, now(), now()), image, K)))
        assert "not_encoded" not in pictures.counters()
    assert len(received[0]) < LIVE_BYTES_MAX + 200
    _, seen = decoded(received[0])
    assert seen.shape == image.shape
    assert np.abs(seen.astype(float) - image).mean() < 8.0, "it is that picture"


def now() -> int:
    return time.monotonic_ns()


def test_a_recording_holds_as_many_pictures_a_second_as_was_asked_for(tmp_path: Path) -> None:
    settings = RecorderSettings(enabled=True, folder=tmp_path, free_min_mb=0.0, image_max_hz=5.0)
    recorder = Recorder(tmp_path, "uav1", settings.limits(), lambda *_: None)
    link = ZenohLink(ZenohSettings(enabled=False, listen=[]), "uav1", MOUNT, recorder)
    recorder.start()
    began_ns, handled = now(), threading.Event()
    with shown(link, 0.0, settings.image_max_hz) as pictures:
        for k in range(21):  # 30 frames a second for 0.67 s: 0, 0.2, 0.4, 0.6
            pictures.show(frame(k, began_ns + round(k * 1e9 / 30)))
            handled.wait(0.01)
    recorder.stop()
    (path,) = tmp_path.glob("*.mcap")
    with path.open("rb") as file:
        kept = [decoded(message.data) for _, _, message in make_reader(file).iter_messages("/uav1/image/compressed")]
    assert [int(np.median(image)) for _, image in kept] == pytest.approx([0, 120, 0, 120], abs=2)
    stamps_s = np.array([message.stamp_ns - kept[0][0].stamp_ns for message, _ in kept]) * 1e-9
    np.testing.assert_allclose(stamps_s, [0.0, 0.2, 0.4, 0.6], atol=0.002)


class Album:
    """A link that looks and records, and keeps what it gets."""

    def __init__(self) -> None:
        self.kept: list[Picture] = []

    def wants_picture(self) -> bool:
        return True

    def records_picture(self) -> bool:
        return True

    def publish_picture(self, picture: Picture) -> None:
        self.kept.append(picture)


@pytest.mark.parametrize(("live_hz", "recorded_hz"), [(5.0, 10.0), (10.0, 5.0)])
def test_what_waits_at_the_end_is_handed_over_and_what_was_replaced_is_counted(
    live_hz: float, recorded_hz: float
) -> None:
    album, more = Album(), 2
    pictures = Pictures(album, live_hz, recorded_hz)
    frames = [frame(k, k * 10**8) for k in range(WAITING_MAX + more)]
    for one in frames:
        pictures.show(one)
        pictures.show(frame(0, one.meta.capture_ns + 10**6))  # not due, so it takes no place
    pictures.start()
    for _ in range(2):
        pictures.stop()
    assert pictures.counters() == {"replaced": more}
    for hz, live in ((live_hz, True), (recorded_hz, False)):
        due = frames[more :: round(10 / hz)]
        kept = [one for one in album.kept if one.live == live]
        assert [(one.capture_ns, one.recorded) for one in kept] == [(one.meta.capture_ns, not live) for one in due]
        encoded = [small_jpeg(one.image_bgr) if live else jpeg(one.image_bgr, RECORDED_QUALITY) for one in due]
        assert [one.jpeg for one in kept] == encoded


@pytest.mark.parametrize(
    ("side", "settings"),
    [(400, (80, False)), (500, (60, False)), (600, (40, False)), (750, (20, False)), (900, (20, True)),
     (1100, (10, True)), (1600, (5, True)), (2400, None)],
)  # fmt: skip
def test_who_looks_has_the_best_quality_that_fits(side: int, settings: tuple[int, bool] | None) -> None:
    """Of noise: one quality less is half a picture's side more."""
    image = np.random.default_rng(0).integers(0, 256, (side, side, 3), dtype=np.uint8)
    assert small_jpeg(image) == (None if settings is None else jpeg(image, *settings))


def test_a_picture_longer_than_jpeg_can_tell_is_none() -> None:
    assert jpeg(np.zeros((1, 65_500, 3), np.uint8), 90) is not None
    assert jpeg(np.zeros((1, 65_536, 3), np.uint8), 90) is None


def test_a_pause_is_not_made_up_for() -> None:
    rate, times_s = Rate(10.0), (0.0, 0.09, 0.1, 5.03, 5.04, 5.06, 5.12, 5.13, 5.19, 5.21)
    assert [t for t in times_s if rate.due(round(t * 1e9))] == [0.0, 0.1, 5.03, 5.04, 5.13]
    assert not any(Rate(0.0).due(t) for t in (0, 10**9, 10**12))


@pytest.mark.parametrize("hz", [1.0, 7.0, 30.0])
def test_the_rate_is_met_on_average_by_frames_that_come_at_their_own_times(hz: float) -> None:
    rate, chance = Rate(hz), np.random.default_rng(5)
    times_ns = np.cumsum(chance.integers(10_000_000, 25_000_000, 3000))
    taken = sum(rate.due(int(t)) for t in times_ns)
    assert taken == pytest.approx(hz * (times_ns[-1] - times_ns[0]) * 1e-9, rel=0.02, abs=2)


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_pictures_stay_off_the_radio(tmp_path: Path, protocol: str) -> None:
    files: TlsFiles = make_keys(tmp_path)
    secure, on_board = free_endpoint().replace("tcp/", f"{protocol}/"), free_endpoint()
    tls = ZenohTlsSettings(**{key: getattr(files, key) for key in ("root_ca", "certificate", "private_key")})
    link = ZenohLink(ZenohSettings(listen=[on_board], connect=[secure], tls=tls), "uav1", MOUNT)
    ground_heard: list[str] = []
    board_heard: list[str] = []

    def note(into: list[str]) -> Any:
        return zenoh.handlers.Callback(lambda sample: into.append(str(sample.key_expr)), indirect=False)

    with zenoh.open(router_config([secure], tls=files)) as ground, shown(link, 10.0) as pictures:
        ground.declare_subscriber("0/uav1/**", note(ground_heard))
        with connect(on_board) as board:
            board.declare_subscriber("0/uav1/**", note(board_heard))

            def fly() -> None:
                now_ns = now()
                link.publish(make_report(make_track(now_ns), now_ns=now_ns))
                pictures.show(frame(1, now_ns))

            def both() -> bool:
                pictured = sum("/image/" in key for key in board_heard)
                return pictured >= 3 and sum("/pose/" in key for key in ground_heard) >= 30

            until(both, fly, what="pictures on board, poses on the ground")
    assert not [key for key in ground_heard if "/image/" in key]
