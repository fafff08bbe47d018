"""What the daemon records: what it sends, also with no zenoh, and after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh
from mcap.reader import make_reader

from edge import clock
from edge.config import load_config
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.links.zenoh_link import ZenohLink
from edge.pictures import Picture
from msgs import recording
from msgs.client import connect
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import make_report, make_track
from .test_zenoh_link import MOUNT

CAMERA = '[camera]\ntype = "sequence"\npath = "scene"\n'


def read(path: Path) -> list[tuple[str, bytes]]:
    with open(path, "rb") as file:
        return [(channel.topic, message.data) for _, channel, message in make_reader(file).iter_messages()]


def link_and_recorder(folder: Path, **settings: Any) -> tuple[ZenohLink, Recorder]:
    recorder = Recorder(folder, "uav1", RecordingLimits(free_bytes_min=0), print)
    return ZenohLink(ZenohSettings(**settings), "uav1", MOUNT, recorder), recorder


def test_the_recording_holds_the_bytes_that_went_over_the_wire(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    link, recorder = link_and_recorder(tmp_path, listen=[endpoint])
    recorder.start()
    link.start()
    came: list[tuple[str, bytes]] = []
    with connect(endpoint) as session:

        def take(sample: zenoh.Sample) -> None:
            name = str(sample.key_expr).removeprefix("0").partition("/geometry_msgs")[0]
            came.append((name, sample.payload.to_bytes()))

        session.declare_subscriber("0/uav1/target/*/pose/**", zenoh.handlers.Callback(take, indirect=False))
        until(lambda: len(came) >= 5, lambda: link.publish(make_report(make_track(time.monotonic_ns()))), what="poses")
        link.publish_event(20, "tracking")
        link.stop()
    recorder.stop()
    (path,) = tmp_path.iterdir()
    recorded = read(path)
    assert set(came) <= {one for one in recorded if one[0].endswith("/pose")}
    topics = {"/uav1/target/t0/pose", "/uav1/target/t0/odom", "/uav1/target/detections", "/uav1/tf"}
    assert {topic for topic, _ in recorded} == topics | {"/uav1/camera_info", "/uav1/events"}


def test_with_zenoh_off_it_is_recorded_all_the_same(tmp_path: Path) -> None:
    link, recorder = link_and_recorder(tmp_path, enabled=False)
    recorder.start()
    link.start()
    link.publish(make_report(make_track(time.monotonic_ns())))
    link.stop()
    recorder.stop()
    (path,) = tmp_path.iterdir()
    assert "/uav1/target/t0/pose" in {topic for topic, _ in read(path)}
    assert "sent_pose" not in link.counters()


def test_a_frame_s_picture_has_the_stamp_of_its_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though UTC, measured anew in between, is another by nanoseconds: readers match them by it."""
    monkeypatch.setattr(clock, "UTC_PERIOD_NS", 0)
    link, recorder = link_and_recorder(tmp_path, enabled=False, max_age_ms=10_000.0)
    recorder.start()
    link.start()
    for _ in range(10):
        report = make_report(make_track(time.monotonic_ns()))
        link.publish(report)
        link.settle()
        link.publish_picture(Picture(report.meta.capture_ns, b"", live=False, recorded=True))
        link.settle()
    link.stop()
    recorder.stop()
    (path,) = tmp_path.iterdir()
    stamps: dict[str, list[bytes]] = {}
    for topic, data in read(path):
        stamps.setdefault(topic, []).append(data[4:12])
    assert stamps["/uav1/image/compressed"] == stamps["/uav1/target/detections"]


def test_a_folder_that_cannot_be_written_is_an_event_and_poses_still_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    (tmp_path / "file").write_text("in the way")
    told: list[tuple[int, str]] = []
    tell = lambda level, text: told.append((level, text))  # noqa: E731
    recorder = Recorder(tmp_path / "file" / "folder", "uav1", RecordingLimits(), tell)
    endpoint = free_endpoint()
    link = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT, recorder)
    recorder.start()
    link.start()
    until(lambda: told != [], lambda: link.publish(make_report(make_track(time.monotonic_ns()))), what="the event")
    sent = link.counters()["sent_pose"]
    until(
        lambda: link.counters()["sent_pose"] > sent + 5,
        lambda: link.publish(make_report(make_track(time.monotonic_ns()))),
        what="poses",
    )
    link.stop()
    recorder.stop()
    assert told == [(40, "recording stopped: Not a directory")]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("file_max_mb = 100\ntotal_max_mb = 150", "[recorder]: total_max_mb must hold two files of file_max_mb"),
        ("when_full = 'wait'", "config.toml:5: [recorder] when_full: must be 'oldest' or 'stop'"),
        ("dir = 'x'", "config.toml:5: [recorder] dir: unknown key"),
    ],
)
def test_a_fault_in_its_section_is_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(f"{CAMERA}[recorder]\n{text}\n")
    with pytest.raises(InputError) as error:
        load_config(path)
    assert sentence in str(error.value)


def test_its_folder_is_taken_from_the_configuration_s(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(CAMERA)
    assert load_config(path).config.recorder.folder == tmp_path / "recordings"


def test_a_killed_daemon_leaves_a_recording_that_its_next_start_makes_whole(
    tmp_path: Path, scene: Path, toy_model: Path
) -> None:
    folder, config = tmp_path / "recordings", tmp_path / "config.toml"
    config.write_text(
        f'[camera]\ntype = "sequence"\npath = "{scene}"\nloop = true\n[model]\npath = "{toy_model}"\nthreads = 1\n'
        "[zenoh]\nenabled = false\n[mavlink]\nenabled = false\n[recorder]\nenabled = true\nfree_min_mb = 0\n"
    )
    for attempt, number in ((1, signal.SIGKILL), (2, signal.SIGTERM)):
        daemon = subprocess.Popen([sys.executable, "-m", "edge.cli", "run", "--config", str(config)])
        try:
            until(
                lambda attempt=attempt: (
                    len(list(folder.glob("*"))) == attempt  # type: ignore[misc]
                    and os.path.getsize(max(folder.iterdir())) > 2000
                ),
                what="recording",
            )
        finally:
            daemon.send_signal(number)
            daemon.wait(20.0)
    for path in sorted(folder.iterdir()):
        assert "/uav1/diagnostics" in {topic for topic, _ in read(path)}
