"""What was filmed or recorded is flown again: a video with telemetry, and the daemon's own recording."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer
from rich.console import Console

from msgs.cdr import CompressedImage
from msgs.geometry import R_from_euler, R_from_q_wxyz, q_wxyz_from_R, so3_log
from sim_replay.cli import main
from sim_replay.ground_truth import read_sequence
from sim_replay.lock import LOCK_FILE
from sim_replay.recorded.opened import open_sequence
from sim_replay.report.flight_files import remove_flight
from sim_replay.telemetry import Telemetry, read_telemetry, write_telemetry
from tests.edge.pictures import damaged_jpeg
from tests.waiting import until

BIN = Path(sys.executable).parent
FPS, FRAMES = 10.0, 40
R_BODY_CAM = R_from_euler(0.0, np.radians(5.0), 0.0) @ np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
LEVER_M = (0.4, 0.1, -0.2)
LENS = "{ fx = 2000.0, fy = 2000.0, cx = 319.5, cy = 191.5, width = 640, height = 384 }"


def replay(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([BIN / "uavpose-replay", *arguments], capture_output=True, text=True, timeout=220)


def own_flight() -> Telemetry:
    """Three degrees of roll a second in a climb to the north-east, from a second before the first picture."""
    t_s = np.arange(-1.0, FRAMES / FPS + 1.0, 0.02)
    R_ned_body = R_from_euler(np.radians(3.0 * t_s), np.full_like(t_s, 0.1), np.full_like(t_s, 0.7))
    velocity = np.tile([12.0, 9.0, -1.0], (len(t_s), 1))
    place = np.tile([47.0, 8.0, 400.0], (len(t_s), 1))
    rates = np.tile([np.radians(3.0), 0.0, 0.0], (len(t_s), 1))
    values = np.hstack([q_wxyz_from_R(R_ned_body), rates, velocity * t_s[:, None], velocity, place])
    return Telemetry(np.round(t_s * 1e9).astype(np.int64), values)


@pytest.fixture(scope="module")
def flown(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with what it takes to fly it; nobody knows its truth."""
    folder = tmp_path_factory.mktemp("flown") / "000001"
    shutil.copytree(small_scene, folder)
    write_telemetry(folder / "telemetry.csv", own_flight())
    settings = {"fps": FPS, "t0_ns": 0, "R_body_cam": R_BODY_CAM.tolist(), "t_body_cam_m": LEVER_M}
    (folder / "sequence.toml").write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items()))
    return folder


def poses_of(out: Path) -> dict[int, dict[str, Any]]:
    return {pose["frame"]: pose for pose in map(json.loads, (out / "poses.jsonl").read_text().splitlines())}


@pytest.fixture(scope="module")
def as_it_was(flown: Path, toy_model: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, dict[str, Any]]:
    out = tmp_path_factory.mktemp("scene")
    played = replay("play", "--lockstep", "--sequence", flown, "--model", toy_model, "--out", out)
    assert played.returncode == 0, played.stderr
    return poses_of(out)


@pytest.fixture(scope="module")
def flight(flown: Path, toy_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a flight in real time left behind, with its recording."""
    out = tmp_path_factory.mktemp("flight")
    played = replay("play", "--record", "--sequence", flown, "--model", toy_model, "--out", out)
    assert played.returncode == 0, played.stderr
    assert "not scored: no ground truth" in played.stdout.replace("\n", " ")
    return out


@pytest.fixture(scope="module")
def recorded(flight: Path) -> Path:
    (path,) = (flight / "recordings").glob("*.mcap")
    return path


def test_a_video_with_telemetry_flies_as_its_pictures_do(
    flown: Path, toy_model: Path, as_it_was: dict[int, dict[str, Any]], tmp_path: Path
) -> None:
    film = cv2.VideoWriter(str(tmp_path / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (640, 384))
    for path in sorted((flown / "rgb").iterdir()):
        film.write(cv2.imread(str(path)))
    film.release()
    shutil.copyfile(flown / "telemetry.csv", tmp_path / "own.csv")
    (tmp_path / "flight.toml").write_text(
        f'video = "film.mp4"\ntelemetry = "own.csv"\nintrinsics = {LENS}\n'
        f"[mount]\nR_body_cam = {R_BODY_CAM.tolist()}\nt_body_cam_m = {list(LEVER_M)}\n"
    )
    played = replay(
        "play", "--lockstep", "--sequence", tmp_path / "flight.toml", "--model", toy_model, "--out", tmp_path / "out"
    )
    assert played.returncode == 0, played.stderr
    poses = poses_of(tmp_path / "out")
    assert sorted(poses) == sorted(as_it_was)
    for frame, pose in poses.items():
        np.testing.assert_allclose(pose["t_cam_target_m"], as_it_was[frame]["t_cam_target_m"], rtol=0.03, atol=0.3)
    # What it was unpacked into is a sequence of its own: the same again.
    again = replay(
        "play", "--lockstep", "--sequence", tmp_path / "out/sequence", "--model", toy_model, "--out", tmp_path / "again"
    )
    assert again.returncode == 0, again.stderr
    assert poses_of(tmp_path / "again") == poses


def test_the_daemons_own_recording_flies_again(
    flight: Path, recorded: Path, toy_model: Path, as_it_was: dict[int, dict[str, Any]], tmp_path: Path
) -> None:
    with recorded.open("rb") as file:
        kept = make_reader(file).iter_messages("/uav1/image/compressed")
        pictures = [CompressedImage.decode(message.data).data for _, _, message in kept]
    assert len(pictures) > FRAMES // 2

    again = replay("play", "--lockstep", "--sequence", recorded, "--model", toy_model, "--out", tmp_path / "again")
    assert again.returncode == 0, again.stderr
    sequence = read_sequence(tmp_path / "again/sequence")
    assert sequence.fps == pytest.approx(FPS, rel=0.02)
    assert sequence.scene.images[0].read_bytes() == pictures[0]
    np.testing.assert_allclose(sequence.mount.R_body_cam, R_BODY_CAM, atol=1e-9)
    np.testing.assert_allclose(sequence.mount.t_body_cam_m, LEVER_M, atol=1e-9)

    # A busy host may have let the first pictures pass.
    first, poses = frame_of(pictures[0]), poses_of(tmp_path / "again")
    both = [frame for frame in poses if frame + first in as_it_was]
    assert len(both) > FRAMES // 3
    for frame in both:
        was = as_it_was[frame + first]["t_cam_target_m"]
        np.testing.assert_allclose(poses[frame]["t_cam_target_m"], was, rtol=0.05, atol=0.5)
    _attitude_as_flown(read_telemetry(tmp_path / "again/sequence/telemetry.csv"))

    # What a flight leaves behind is known by name, but for what was recorded and unpacked.
    shutil.copytree(flight, tmp_path / "flight")
    for folder, left in (("flight", ["recordings"]), ("again", ["sequence"])):
        remove_flight(tmp_path / folder)
        assert [one.name for one in (tmp_path / folder).iterdir()] == left


def copied(path: Path, cut: Path, keep: Callable[[str, Message], bool]) -> Path:
    """A recording with those messages alone that are to be kept, by topic."""
    with path.open("rb") as source, cut.open("wb") as target:
        writer = Writer(target)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            if keep(channel.topic, message):
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
        writer.finish()
    return cut


def test_pictures_from_before_the_first_attitude_are_left_out(recorded: Path, tmp_path: Path) -> None:
    with recorded.open("rb") as file:
        kept = [message for _, _, message in make_reader(file).iter_messages("/uav1/image/compressed")]
    from_ns = kept[10].log_time
    told = lambda topic, one: one.log_time >= from_ns or not topic.endswith("/tf")  # noqa: E731
    cut = copied(recorded, tmp_path / "cut.mcap", told)
    sequence = open_sequence(cut, tmp_path / "again", Console(quiet=True))
    first = [CompressedImage.decode(message.data).data for message in kept].index(sequence.scene.images[0].read_bytes())
    assert 8 <= first <= 12
    first_ns = read_telemetry(sequence.telemetry_csv).t_ns[0]
    assert abs(first_ns) < 60_000_000  # its attitude is its own


def test_what_was_not_recorded_is_a_dropped_frame_and_no_picture_shown_again(
    recorded: Path, toy_model: Path, as_it_was: dict[int, dict[str, Any]], tmp_path: Path
) -> None:
    gap = range(15, 21)  # by the scene's numbers

    def keep(topic: str, message: Message) -> bool:
        return not topic.endswith("/image/compressed") or frame_of(CompressedImage.decode(message.data).data) not in gap

    cut = copied(recorded, tmp_path / "cut.mcap", keep)
    again = replay("play", "--lockstep", "--step", "--sequence", cut, "--model", toy_model, "--out", tmp_path / "again")
    assert again.returncode == 0, again.stderr
    sequence = read_sequence(tmp_path / "again/sequence")
    first = frame_of(sequence.scene.images[0].read_bytes())  # a busy host may have let the first pictures pass
    missing = {frame - first for frame in gap}
    assert missing <= sequence.scene.unrecorded
    shown = {int(one.stem): frame_of(one.read_bytes()) for one in (tmp_path / "again/sequence/rgb").iterdir()}
    assert shown == {number: number + first for number in shown}
    assert not missing & shown.keys()
    poses = poses_of(tmp_path / "again")
    assert not missing & poses.keys()
    assert {frame - first for frame in range(21, 30)} & poses.keys()
    for frame, pose in poses.items():
        if frame + first in as_it_was:
            was = as_it_was[frame + first]["t_cam_target_m"]
            np.testing.assert_allclose(pose["t_cam_target_m"], was, rtol=0.05, atol=0.5)
    assert f"frame {gap[0] - first}: not recorded" in again.stdout


def write_film(folder: Path, picture: Path, frames: int, row_s: float = 0.02, fourcc: str = "mp4v") -> Path:
    """A video of one picture, with telemetry of all of it and `flight.toml`."""
    film = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*fourcc), FPS, (640, 384))
    for _ in range(frames):
        film.write(cv2.imread(str(picture)))
    film.release()
    t_s = np.arange(0.0, frames / FPS, row_s)
    values = np.tile(own_flight().values[0], (len(t_s), 1))
    write_telemetry(folder / "own.csv", Telemetry(np.round(t_s * 1e9).astype(np.int64), values))
    path = folder / "flight.toml"
    path.write_text(f'video = "film.mp4"\ntelemetry = "own.csv"\nintrinsics = {LENS}\n')
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_video_whose_unpacking_was_stopped_is_unpacked_anew(
    number: signal.Signals, flown: Path, tmp_path: Path
) -> None:
    frames, out = 400, tmp_path / "out"
    path = write_film(tmp_path, flown / "rgb/000000.png", frames)
    command = [BIN / "uavpose-replay", "play", "--sequence", path, "--out", out]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: list(out.glob("*/rgb/*.jpg")) or process.poll() is not None, what="the first picture")
        process.send_signal(number)
        process.wait(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert not (out / "sequence").exists(), "it was stopped too late"
    assert len(open_sequence(path, out, Console(quiet=True)).scene.images) == frames
    left = {one.name for one in out.iterdir()}
    assert left - {LOCK_FILE} == {"sequence"}


def test_a_picture_of_a_video_that_cannot_be_decoded_is_a_frame_that_was_not_recorded(
    flown: Path, tmp_path: Path
) -> None:
    path = write_film(tmp_path, flown / "rgb/000000.png", 20, fourcc="MJPG")
    film = tmp_path / "film.mp4"
    film.write_bytes(damaged_jpeg(film.read_bytes(), {0, 7, 8}))
    played = open_sequence(path, tmp_path / "out", Console(quiet=True))
    assert len(played.scene.images) == 19
    assert played.scene.unrecorded == {6, 7}  # the first picture of all is number 0
    assert played.frame0_ns == 1e9 / FPS


def test_a_video_whose_telemetry_is_of_another_time_or_too_sparse_is_refused_before_it_is_unpacked(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_film(tmp_path, flown / "rgb/000000.png", 20)
    text = path.read_text()
    path.write_text(f"t0_ns = 7000000000\n{text}")
    assert main(["play", "--sequence", str(path), "--out", str(tmp_path / "out")]) == 2
    told = "own.csv: tells of 0.000 s to 1.980 s, but the first picture was exposed at 7.000 s on its clock"
    assert told in capsys.readouterr().err
    path = write_film(tmp_path, flown / "rgb/000000.png", 20, row_s=0.5)
    assert main(["play", "--sequence", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "own.csv: has 2.0 rows a second; 10 are needed" in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*"))


def frame_of(jpeg: bytes) -> int:
    """Which of the scene's pictures it is: its rectangle moves by 4 pixels from one to the next."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return round((np.flatnonzero((image > 128).any(axis=0)).mean() - 200.5) / 4)


def _attitude_as_flown(telemetry: Telemetry) -> None:
    """It rolls as the own ship did, and climbs as it did, whatever picture came first."""
    flown, seconds = own_flight(), (telemetry.t_ns[-1] - telemetry.t_ns[0]) * 1e-9
    R_first, R_last = R_from_q_wxyz(telemetry.values[[0, -1], :4])
    turned_deg = np.degrees(so3_log(R_first.T @ R_last))
    np.testing.assert_allclose(turned_deg, [3.0 * seconds, 0.0, 0.0], atol=0.3)
    np.testing.assert_allclose(np.median(telemetry.values[:, 10:13], axis=0), flown.values[0, 10:13], atol=0.5)
    np.testing.assert_allclose(np.median(telemetry.values[:, 4:7], axis=0), flown.values[0, 4:7], atol=0.01)


def test_px4_behind_a_bad_link_is_flown_with_and_every_message_it_gets_is_kept(
    flown: Path, toy_model: Path, tmp_path: Path
) -> None:
    link = ["--link-delay-ms", "15", "--link-jitter-ms", "10", "--link-loss", "0.05", "--link-reorder", "0.05"]
    played = replay(
        "play", "--autopilot", "px4", *link, "--sequence", flown, "--model", toy_model, "--out", tmp_path / "out"
    )
    assert played.returncode == 0, played.stdout + played.stderr
    messages = [json.loads(line) for line in (tmp_path / "out/mavlink.jsonl").read_text().splitlines()]
    kinds = {one["message"] for one in messages}
    assert {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "TARGET_RELATIVE", "CAMERA_TRACKING_IMAGE_STATUS"} <= kinds
    intervals = [one for one in messages if one["message"] == "COMMAND_LONG"]
    # What PX4 does not know must be zero, or it denies the rate.
    assert all((one["param3"], one["param4"], one["param7"]) == (0.0, 0.0, 0.0) for one in intervals)
    summary = [json.loads(line) for line in (tmp_path / "out/received.jsonl").read_text().splitlines()][-2]
    assert sum(summary["received"].values()) == len(messages)
    assert summary["received"]["TARGET_RELATIVE"] > FRAMES // 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("film.mp4", "gone.mp4"), "gone.mp4 does not exist"),
        (("own.csv", "gone.csv"), "gone.csv: cannot be read"),
        (("fx = 2000.0", "fx = -1.0"), "intrinsics.fx: must be more than 0"),
        (("height = 384", "height = 400"), "intrinsics: these intrinsics are for 640x400 pixels"),
        (("telemetry", "telemetri"), "telemetri: "),
    ],
)
def test_what_is_wrong_with_a_filmed_flight_is_said(
    flown: Path, change: tuple[str, str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = cv2.VideoWriter(str(tmp_path / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (640, 384))
    film.write(cv2.imread(str(flown / "rgb/000000.png")))
    film.release()
    shutil.copyfile(flown / "telemetry.csv", tmp_path / "own.csv")
    text = f'video = "film.mp4"\ntelemetry = "own.csv"\nintrinsics = {LENS}\n'
    (tmp_path / "flight.toml").write_text(text.replace(*change))
    code = main(["play", "--sequence", str(tmp_path / "flight.toml"), "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert code == 2, said
    assert words in said
    assert "flight.toml" in said or "gone.csv" in said


def test_what_holds_nothing_to_fly_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "torn.mcap").write_bytes(b"no MCAP at all")
    assert main(["play", "--sequence", str(tmp_path / "torn.mcap"), "--out", str(tmp_path / "out")]) == 2
    assert "torn.mcap" in capsys.readouterr().err
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n")  # power was lost as it began
    assert main(["play", "--sequence", str(tmp_path / "torn.mcap"), "--out", str(tmp_path / "out")]) == 2
    assert "torn.mcap: is not a complete MCAP file (it ends early)" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["play", "--sequence", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert "is not a scene folder" in capsys.readouterr().err
    (tmp_path / "out/sequence").mkdir(parents=True)
    shutil.move(tmp_path / "torn.mcap", tmp_path / "empty/torn.mcap")
    assert main(["play", "--sequence", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert "is in the way" in capsys.readouterr().err
