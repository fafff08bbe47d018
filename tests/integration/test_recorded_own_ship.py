"""What is told of the own ship when a recording flies again: that of its vehicle, no faster than it flew, no guess."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rich.console import Console

from edge.errors import InputError
from edge.pictures import Rate
from msgs import topics
from msgs.cdr import CompressedImage, TFMessage
from msgs.geometry import R_from_euler, q_wxyz_from_R
from sim_replay.cli import main
from sim_replay.recorded.opened import open_sequence
from sim_replay.telemetry import Telemetry, read_telemetry, write_telemetry
from tests.sim_replay.toy_flight import write_toy_flight

FRAMES = 40
START_M, VELOCITY_MPS = np.array([900.0, -400.0, -300.0]), np.array([18.0, -9.0, 1.0])
UNKNOWN = [0.0, 0.0, 0.0, 0.0]

Rewritten = Callable[[str, bytes], Iterator[tuple[str, bytes]]]  # topic and payload, to those that take their place


@pytest.fixture(scope="module")
def recorded(toy_model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """By the daemon, of an own ship that rolls to and fro and is far from where north-east-down begins."""
    folder = tmp_path_factory.mktemp("own_ship")
    scene = write_toy_flight(folder / "scene", FRAMES)
    flight = read_telemetry(scene / "telemetry.csv")
    write_telemetry(scene / "telemetry.csv", rolling(flight.t_ns))
    assert main(["play", "--record", "--sequence", str(scene), "--model", str(toy_model), "--out", str(folder)]) == 0
    (path,) = (folder / "recordings").glob("*.mcap")
    return path


def rolling(t_ns: np.ndarray) -> Telemetry:
    t_s = t_ns * 1e-9
    roll_rad = np.radians(40.0) * np.sin(2.0 * np.pi * t_s / 3.0)
    values = np.zeros((len(t_s), 16))
    values[:, :4] = q_wxyz_from_R(R_from_euler(roll_rad, 0.0 * t_s, 0.0 * t_s))
    values[:, 7:10] = START_M + VELOCITY_MPS * t_s[:, None]
    values[:, 10:13] = VELOCITY_MPS
    values[:, 13:] = (47.0, 8.0, 500.0)
    return Telemetry(t_ns, values)


def rewritten(source: Path, target: Path, rewrite: Rewritten) -> Path:
    with source.open("rb") as old, target.open("wb") as new:
        writer = Writer(new)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(old).iter_messages():
            for topic, data in rewrite(channel.topic, message.data):
                if topic not in channels:
                    schema_id = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                    channels[topic] = writer.register_channel(
                        topic, channel.message_encoding, schema_id, channel.metadata
                    )
                writer.add_message(channels[topic], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()
    return target


def places_changed(change: Callable[[int, np.ndarray], np.ndarray | None]) -> Rewritten:
    """By the transform's number: another place of the own ship, None for none."""
    count = 0

    def rewrite(topic: str, data: bytes) -> Iterator[tuple[str, bytes]]:
        nonlocal count
        if not topic.endswith("/tf"):
            yield topic, data
            return
        links = []
        for link in TFMessage.decode(data).transforms:
            place_m = np.asarray(link.t_frame_child_m)
            if link.child_frame_id == topics.FRAME_BODY_NED:
                changed_m = change(count, place_m)
                if changed_m is None:
                    continue
                link = replace(link, t_frame_child_m=changed_m)
            links.append(link)
        count += 1
        yield topic, TFMessage(tuple(links)).encode()

    return rewrite


def opened(path: Path, out: Path) -> Telemetry:
    return read_telemetry(open_sequence(path, out, Console(quiet=True)).telemetry_csv)


@pytest.mark.parametrize("unknown", [range(12), range(15, 20), range(28, 99)])
def test_a_place_that_was_not_known_for_a_while_makes_no_leap(
    unknown: range, recorded: Path, toy_model: Path, tmp_path: Path
) -> None:
    changed = places_changed(lambda number, place_m: None if number in unknown else place_m)
    path = rewritten(recorded, tmp_path / "late.mcap", changed)
    out = tmp_path / "out"
    assert main(["play", "--lockstep", "--sequence", str(path), "--model", str(toy_model), "--out", str(out)]) == 0
    told = read_telemetry(out / "sequence/telemetry.csv")
    assert np.linalg.norm(told.values[:, 7:10] - START_M, axis=1).max() < 150.0
    assert np.linalg.norm(told.values[:, 10:13], axis=1).max() < 30.0


def test_where_the_autopilot_set_its_place_anew_nobody_flew_that_fast(recorded: Path, tmp_path: Path) -> None:
    moved = places_changed(lambda number, place_m: place_m + (60.0 if number >= 20 else 0.0))
    told = opened(rewritten(recorded, tmp_path / "moved.mcap", moved), tmp_path / "out")
    assert np.diff(told.values[:, 7]).max() > 50.0  # the place is as it was recorded
    np.testing.assert_allclose(told.values[:, 10:13], np.tile(VELOCITY_MPS, (len(told.t_ns), 1)), atol=5.0)


def test_another_vehicle_in_the_recording_does_not_move_this_one(recorded: Path, tmp_path: Path) -> None:
    def also_heard(topic: str, data: bytes) -> Iterator[tuple[str, bytes]]:
        yield topic, data
        if topic.endswith("/tf"):
            links = TFMessage.decode(data).transforms
            upside_down = np.array([1.0, 0.0, 0.0, 0.0])
            turned = (replace(one, stamp_ns=one.stamp_ns + 7, q_frame_child_xyzw=upside_down) for one in links)
            yield "/uav2/tf", TFMessage(tuple(turned)).encode()

    both = rewritten(recorded, tmp_path / "both.mcap", also_heard)
    alone, beside = opened(recorded, tmp_path / "alone"), opened(both, tmp_path / "beside")
    np.testing.assert_array_equal(beside.t_ns, alone.t_ns)
    np.testing.assert_array_equal(beside.values, alone.values)


def test_files_of_a_flight_whose_clock_was_set_back_are_refused_together_and_played_one_by_one(
    recorded: Path, tmp_path: Path
) -> None:
    def earlier(topic: str, data: bytes) -> Iterator[tuple[str, bytes]]:
        if topic.endswith("/image/compressed"):
            image = CompressedImage.decode(data)
            data = replace(image, stamp_ns=image.stamp_ns - 2 * 10**9).encode()
        elif topic.endswith("/tf"):
            links = TFMessage.decode(data).transforms
            data = TFMessage(tuple(replace(one, stamp_ns=one.stamp_ns - 2 * 10**9) for one in links)).encode()
        yield topic, data

    flight = tmp_path / "flight"
    flight.mkdir()
    shutil.copyfile(recorded, flight / "uav1_000000.mcap")
    second = rewritten(recorded, flight / "uav1_000001.mcap", earlier)
    with pytest.raises(InputError, match=rf"^{second}: the clock of uav1 was set back: give the files one by one$"):
        open_sequence(flight, tmp_path / "both", Console(quiet=True))
    np.testing.assert_array_equal(opened(second, tmp_path / "one").t_ns, opened(recorded, tmp_path / "other").t_ns)


def test_a_clock_of_another_vehicle_that_was_set_back_is_no_obstacle(recorded: Path, tmp_path: Path) -> None:
    stamps_s = iter([100, *range(1000)])

    def also_heard(topic: str, data: bytes) -> Iterator[tuple[str, bytes]]:
        yield topic, data
        if topic.endswith("/tf"):
            links, stamp_ns = TFMessage.decode(data).transforms, next(stamps_s) * 10**9
            yield "/uav2/tf", TFMessage(tuple(replace(one, stamp_ns=stamp_ns) for one in links)).encode()

    both = rewritten(recorded, tmp_path / "both.mcap", also_heard)
    np.testing.assert_array_equal(opened(both, tmp_path / "out").t_ns, opened(recorded, tmp_path / "alone").t_ns)


@pytest.mark.parametrize(("camera_hz", "image_max_hz", "resolution_ns"), [(30, 20, 1), (25, 10, 1), (60, 60, 10**6)])
def test_pictures_recorded_at_no_whole_fraction_of_the_cameras_rate_all_keep_their_frames(
    camera_hz: int, image_max_hz: int, resolution_ns: int, recorded: Path, tmp_path: Path
) -> None:
    limit = Rate(image_max_hz)
    exposed_ns = [round(k * 1e9 / camera_hz) for k in range(80)]
    frames = [k for k, t_ns in enumerate(exposed_ns) if limit.due(t_ns)][:30]
    left = iter(exposed_ns[k] // resolution_ns * resolution_ns for k in frames)
    begun_ns: list[int] = []

    def restamped(topic: str, data: bytes) -> Iterator[tuple[str, bytes]]:
        if not topic.endswith("/image/compressed"):
            yield topic, data
            return
        image = CompressedImage.decode(data)
        if not begun_ns:
            begun_ns.append((image.stamp_ns + 500_000_000) // resolution_ns * resolution_ns)  # own attitude is known
        if (since_ns := next(left, None)) is not None:
            yield topic, replace(image, stamp_ns=begun_ns[0] + since_ns).encode()

    sequence = open_sequence(
        rewritten(recorded, tmp_path / "few.mcap", restamped), tmp_path / "out", Console(quiet=True)
    )
    assert sequence.fps == pytest.approx(camera_hz, rel=5e-3)
    assert sorted(int(path.stem) for path in (tmp_path / "out/sequence/rgb").iterdir()) == frames


def test_where_rows_of_telemetry_are_missing_no_own_attitude_is_made_up(toy_model: Path, tmp_path: Path) -> None:
    scene = write_toy_flight(tmp_path / "scene", FRAMES)
    t_ns = read_telemetry(scene / "telemetry.csv").t_ns
    flight = rolling(t_ns[(t_ns <= 1_000_000_000) | (t_ns >= 3_000_000_000)])
    write_telemetry(scene / "telemetry.csv", flight)
    out = tmp_path / "out"
    assert main(["play", "--lockstep", "--sequence", str(scene), "--model", str(toy_model), "--out", str(out)]) == 0
    messages = [json.loads(line) for line in (out / "mavlink.jsonl").read_text().splitlines()]
    told = [one for one in messages if one["message"] == "TARGET_RELATIVE"]
    known = {round(one["timestamp"] * 1e-5): one["q_sensor"] != UNKNOWN for one in told}  # by frame
    assert all(known[frame] for frame in range(5, 10))
    assert not any(known[frame] for frame in range(16, 30))  # poses go on
    assert all(known[frame] for frame in range(35, FRAMES))
