"""`uavpose-ground view`: recordings and live vehicles as Rerun has them, read back by its own reader."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from msgs import cdr, topics
from msgs.ground.cli import main
from msgs.ground.feed import Incoming
from msgs.ground.fleet import Fleet
from msgs.ground.view.command import ViewOptions, view
from msgs.ground.view.scene import Scene
from msgs.mcap_file import McapFile
from msgs.publish import Node
from sim_replay.ports import free_endpoint
from tests.waiting import until

from ..conftest import Network
from .flight import (
    PERIOD_NS,
    R_BODY_CAM,
    START_NS,
    T_BODY_CAM_M,
    UAV,
    K,
    attitude,
    frame,
    places_m,
    record,
    samples,
    stamps_ns,
    target_attitude,
)  # fmt: skip

FRAMES = 30


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of three seconds, viewed into a file."""
    folder = tmp_path_factory.mktemp("view")
    record(folder / "flight.mcap", FRAMES)
    assert main(["view", str(folder / "flight.mcap"), "--save", str(folder / "flight.rrd")]) == 0
    return folder / "flight.rrd"


def rows(path: Path, entity: str) -> Iterator[tuple[int, dict[str, object]]]:
    """Stamp (UTC ns) and components of each row of an entity, in their order; static ones are left out."""
    found = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path != f"/{UAV}/{entity}" or chunk.is_static:
            continue
        batch = pa.record_batch(chunk.to_record_batch())
        stamps = batch.column("utc").cast(pa.int64()).to_pylist()
        found += list(zip(stamps, batch.drop_columns(["utc"]).to_pylist(), strict=True))
    return iter(sorted(found, key=lambda one: one[0]))


def component(row: dict[str, object], name: str) -> np.ndarray:
    (value,) = (value for key, value in row.items() if key.endswith(name) and value is not None)
    return np.array(value, dtype=np.float64)


def test_every_part_of_a_recorded_flight_is_there_at_its_time(saved: Path) -> None:
    each_frame = [
        "ned/camera/target/t0/box", "ned/camera/target/t0/sigma", "ned/camera/target/t0/range_sigma",
        "ned/target/t0/body", "ned/target/t0/sigma", "ned/place/ship", "ned/trail/ship", "ned/trail/targets",
        "map/target/t0/heading", "map/target/t0/sigma", "zoom/target/t0/box", "plots/range/t0",
        "plots/attitude/t0/roll", "plots/latency/t0",
    ]  # fmt: skip
    for entity in each_frame:
        assert [stamp_ns for stamp_ns, _ in rows(saved, entity)] == stamps_ns(FRAMES), entity
    for entity in ("health", "ned/camera/image", "plots/latency/total_p50"):
        assert len(list(rows(saved, entity))) == FRAMES // 10, entity
    assert {text(row, "TextLog:text") for _, row in rows(saved, "events")} == {"tracking t0", "tracking"}
    assert len(RrdReader(saved).blueprints()) == 1


def test_what_a_late_joiner_is_told_of_hours_before_is_drawn_where_the_recording_begins(tmp_path: Path) -> None:
    rec = rr.RecordingStream("test")
    rec.set_log_tick_enabled(False)
    rec.set_log_time_enabled(False)
    rec.save(tmp_path / "flight.rrd")
    scene = Scene(rec, Fleet(), (8.0, 12.0, 2.5), lambda _: None)
    for number, age_s in enumerate((7200, 60, -5)):  # received in the first instant, the last one as it happens
        stamp_ns = START_NS - age_s * 1_000_000_000
        event = cdr.Log(stamp_ns, 20, topics.NODE_NAME, f"event {number}").encode()
        attachment = topics.attachment(number + 1, stamp_ns, bytes(16))
        scene.take(Incoming(UAV, topics.EVENTS, None, "", event, attachment), max(stamp_ns, START_NS))
    rec.disconnect()
    drawn = rows(tmp_path / "flight.rrd", "events")
    told = [(stamp_ns - START_NS, text(row, "TextLog:text")) for stamp_ns, row in drawn]
    assert told == [(0, "20:13:20 UTC: event 0"), (0, "22:12:20 UTC: event 1"), (5_000_000_000, "event 2")]


def text(row: dict[str, object], name: str) -> str:
    (value,) = (value for key, value in row.items() if key.endswith(name))
    assert isinstance(value, list)
    return str(value[0])


def clears(row: dict[str, object]) -> bool:
    return any("Clear:" in name and value is not None for name, value in row.items())


def test_targets_stand_in_space_where_they_were_at_the_own_ship_s_attitude_of_that_instant(saved: Path) -> None:
    for stamp_ns, row in rows(saved, "ned/target/t0/body"):
        _, target_m = places_m(stamp_ns)
        np.testing.assert_allclose(component(row, "translation")[0], target_m, atol=1e-3)
        R = component(row, "mat3x3")[0].reshape(3, 3, order="F")
        np.testing.assert_allclose(R, target_attitude(stamp_ns).as_matrix(), atol=1e-5)
    for stamp_ns, row in rows(saved, "plots/attitude/t0/heading"):
        heading_deg = target_attitude(stamp_ns).as_euler("ZYX", degrees=True)[0] % 360.0
        assert component(row, "scalars")[0] == pytest.approx(heading_deg, abs=1e-3)


def test_the_box_on_the_picture_is_the_projection_of_the_target_s_box(saved: Path) -> None:
    stamp_ns, row = next(rows(saved, "ned/camera/target/t0/box"))
    own_m, target_m = places_m(stamp_ns)
    corner_m = target_m + target_attitude(stamp_ns).as_matrix() @ np.array([4.0, 6.0, 1.25])
    R_cam_ned = (attitude(stamp_ns) * Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])).inv().as_matrix()
    x, y, z = R_cam_ned @ (corner_m - own_m - attitude(stamp_ns).apply(T_BODY_CAM_M))
    expected = [K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]]
    strips = component(row, "strips").reshape(-1, 2)
    assert np.abs(strips - expected).max(axis=1).min() < 0.05


def test_a_target_that_is_not_told_again_is_taken_away_after_a_second(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "lost.mcap")
    for topic, target, payload, log_ns in samples(40):
        if topic is topics.POSE and log_ns > START_NS + 10 * PERIOD_NS:
            continue
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    assert main(["view", str(tmp_path / "lost.mcap"), "--save", str(tmp_path / "lost.rrd")]) == 0
    for where in ("ned", "ned/camera", "map", "zoom"):
        cleared = [stamp_ns for stamp_ns, _ in rows(tmp_path / "lost.rrd", f"{where}/target/t0")]
        assert cleared == [stamps_ns(10)[-1] + 1_000_000_000], where


def test_what_an_outage_takes_away_is_gone_also_if_the_first_to_come_again_is_its_own_pose(tmp_path: Path) -> None:
    """Nothing at all is recorded for 5.5 s; the pose of t0 is the first sample after that."""
    file = McapFile(tmp_path / "outage.mcap")
    for topic, target, payload, log_ns in samples(75):
        if not 10 <= (log_ns - START_NS) // PERIOD_NS < 65:
            file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    path = tmp_path / "outage.rrd"
    assert main(["view", str(tmp_path / "outage.mcap"), "--save", str(path)]) == 0
    for where in ("ned", "ned/camera", "map", "zoom"):
        cleared = [stamp_ns for stamp_ns, row in rows(path, f"{where}/target/t0") if clears(row)]
        assert cleared == [stamps_ns(10)[-1] + 1_000_000_000], where
    (silent,) = (stamp_ns for stamp_ns, row in rows(path, "health") if "No word since" in str(row))
    assert silent == START_NS + 3_000_000_000


def test_health_that_is_not_told_again_says_since_when(tmp_path: Path) -> None:
    file, told = McapFile(tmp_path / "silent.mcap"), []
    for topic, target, payload, log_ns in samples(150):
        if topic is topics.DIAGNOSTICS:
            if START_NS + 3_000_000_000 < log_ns < START_NS + 12_000_000_000:
                continue
            told.append(cdr.DiagnosticArray.decode(payload).stamp_ns)
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    assert main(["view", str(tmp_path / "silent.mcap"), "--save", str(tmp_path / "silent.rrd")]) == 0
    last_ns = max(stamp_ns for stamp_ns in told if stamp_ns < START_NS + 4_000_000_000)
    texts = [(stamp_ns, str(row)) for stamp_ns, row in rows(tmp_path / "silent.rrd", "health")]
    silent = [stamp_ns for stamp_ns, text in texts if "No word since" in text]
    assert silent == [last_ns + 3_000_000_000]
    assert [stamp_ns for stamp_ns, text in texts if "No word since" not in text] == told


def test_where_the_own_ship_is_told_seldom_targets_stand_where_they_were_all_the_same(tmp_path: Path) -> None:
    """Each fourth of a frame's transforms comes, then none: 0.4 s on nobody knows any more."""
    file = McapFile(tmp_path / "thin.mcap")
    for topic, target, payload, log_ns in samples(40):
        number = (log_ns - START_NS) // PERIOD_NS
        if topic is topics.TF and (number % 4 or number > 28):
            continue
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    path = tmp_path / "thin.rrd"
    assert main(["view", str(tmp_path / "thin.mcap"), "--save", str(path)]) == 0
    placed = {stamp_ns: component(row, "translation")[0] for stamp_ns, row in rows(path, "ned/target/t0/body")}
    assert list(placed) == stamps_ns(40)
    for stamp_ns in stamps_ns(29):
        np.testing.assert_allclose(placed[stamp_ns], places_m(stamp_ns)[1], atol=0.1)
    unknown = [
        stamp_ns for stamp_ns, row in rows(path, "events") if "own attitude unknown" in text(row, "TextLog:text")
    ]
    assert unknown == [stamps_ns(33)[-1]]
    sight = {stamp_ns: component(row, "strips")[0][0] for stamp_ns, row in rows(path, "ned/target/t0/line_of_sight")}
    last_m = places_m(stamps_ns(40)[28])[0]
    for stamp_ns in stamps_ns(40)[32:]:
        np.testing.assert_allclose(sight[stamp_ns], last_m, atol=1e-3)


def test_without_own_attitude_ship_camera_and_targets_are_drawn_as_if_it_flew_level_and_north(tmp_path: Path) -> None:
    path, last_ns = tmp_path / "flight.mcap", stamps_ns(FRAMES)[9]
    file = McapFile(path)
    for topic, target, payload, log_ns in samples(FRAMES):
        if topic is not topics.TF or log_ns < stamps_ns(FRAMES)[10]:
            file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    assert main(["view", str(path), "--save", str(tmp_path / "flight.rrd")]) == 0
    own_m = places_m(last_ns)[0]
    for entity, R in (("ned/place/ship", np.eye(3)), ("ned/camera", R_BODY_CAM)):
        *_, (_, row) = rows(tmp_path / "flight.rrd", entity)
        np.testing.assert_allclose(component(row, "mat3x3").reshape(3, 3).T, R, atol=1e-6)
    *_, (_, row) = rows(tmp_path / "flight.rrd", "map/ship")
    assert component(row, "vectors") == pytest.approx(np.array([[0.0, -30.0]]))
    *_, (stamp_ns, row) = rows(tmp_path / "flight.rrd", "ned/target/t0/place")
    assert stamp_ns == stamps_ns(FRAMES)[-1]
    t_cam_m = next(
        cdr.PoseWithCovarianceStamped.decode(payload).t_cam_target_m
        for topic, _, payload, _ in frame(stamp_ns, stamp_ns)
        if topic is topics.POSE
    )
    np.testing.assert_allclose(component(row, "positions")[0], own_m + R_BODY_CAM @ t_cam_m, atol=1e-3)


def test_targets_are_taken_away_by_when_they_came_also_after_our_clock_was_set_back(tmp_path: Path) -> None:
    """The vehicle's clock is 1.5 s behind: a target that is told is not taken away for that."""
    path = tmp_path / "clock.rrd"
    rec = rr.RecordingStream("uavpose")
    rec.set_log_tick_enabled(False)
    rec.set_log_time_enabled(False)
    rec.save(path)
    fleet = Fleet()
    scene = Scene(rec, fleet, (8.0, 12.0, 2.5), lambda _: None)
    key, behind_ns = topics.publication_key(topics.POSE, UAV, "t0"), 1_500_000_000
    for number, stamp_ns in enumerate(stamps_ns(10), start=1):
        topic, target, payload, _ = next(frame(stamp_ns, stamp_ns))
        attachment = topics.attachment(number, stamp_ns, bytes(16))
        scene.take(Incoming(UAV, topic, target, key, payload, attachment), stamp_ns + behind_ns)
        scene.tick(stamp_ns + behind_ns)
    assert scene.drawn == 10
    scene.tick(stamps_ns(10)[-1] + behind_ns - 3_600_000_000_000)
    scene.finish()
    rec.disconnect()
    for where in ("ned", "map", "zoom"):
        cleared = [stamp_ns for stamp_ns, row in rows(path, f"{where}/target/t0") if clears(row)]
        assert cleared == [stamps_ns(10)[-1] + 1_000_000_000]


@pytest.fixture
def halves(tmp_path: Path) -> tuple[Path, Path]:
    """One flight in two recordings, as a recorder cuts it."""
    paths = tmp_path / "a.mcap", tmp_path / "b.mcap"
    files = [McapFile(path) for path in paths]
    for topic, target, payload, log_ns in samples(20):
        half = files[(log_ns - START_NS) // PERIOD_NS >= 10]
        half.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    for file in files:
        file.close()
    return paths


def test_the_second_recording_of_a_flight_is_drawn_as_the_first(
    halves: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "whole.rrd"
    assert main(["view", *map(str, halves), "--save", str(out)]) == 0
    assert [stamp_ns for stamp_ns, _ in rows(out, "ned/target/t0/body")] == stamps_ns(20)
    assert capsys.readouterr().err.splitlines()[-1] == f"20 poses drawn into {out}"


def test_what_is_refused_of_a_recording_is_told(
    halves: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "twice.rrd"
    assert main(["view", str(halves[0]), str(halves[0]), "--max-age", "0.001", "--save", str(out)]) == 0
    why = "20: stamp is too old, or older than one already taken"
    assert capsys.readouterr().err.splitlines()[-1] == f"0 poses drawn into {out}, 20 samples refused ({why})"


def test_a_recording_is_left_when_told_to_stop_and_what_was_drawn_is_kept(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    stop, said = threading.Event(), list[str]()

    def say(line: str) -> None:
        said.append(line)
        stop.set()

    out = tmp_path / "left.rrd"
    options = ViewOptions(
        halves,
        endpoint="",
        tls=None,
        uavs=(),
        domain=0,
        max_age_s=2.0,
        size_m=(8.0, 12.0, 2.5),
        save=out,
        web_port=None,
    )
    assert view(options, stop, say) == 0
    assert said == [f"{halves[0]}: read", f"10 poses drawn into {out}"]
    assert [stamp_ns for stamp_ns, _ in rows(out, "ned/target/t0/body")] == stamps_ns(10)


def test_what_is_told_live_is_drawn_until_told_to_stop(network: Network, tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    command = [sys.executable, "-m", "msgs.ground.cli", "view", "-e", network.endpoint, "--save", str(path)]
    viewer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert viewer.stderr is not None
    line = ""
    while "showing" not in line:
        line = viewer.stderr.readline()
        assert line, "the viewer ended early"
    with Node(network.daemon, UAV) as node:
        publishers = {topic.name: node.publisher(topic, target) for topic, target, _, _ in samples(1)}

        def put() -> None:
            now_ns = time.time_ns()
            for topic, _, payload, _ in frame(now_ns, now_ns):
                publishers[topic.name].put(payload)

        until(lambda: publishers[topics.POSE.name].sequence >= 100, put)
    viewer.terminate()
    _, said = viewer.communicate(timeout=60)
    assert viewer.returncode == 0
    drawn = int(said.split(" poses drawn")[0].split()[-1])
    assert drawn > 0  # a busy machine loses what comes too fast for it
    assert len(list(rows(path, "ned/target/t0/body"))) == drawn


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["missing.mcap", "--save", "out.rrd"], "missing.mcap: cannot be read: No such file or directory"),
        (["torn.mcap", "--save", "out.rrd"], "torn.mcap: is not a complete MCAP file"),
        (["--save", "no/folder/out.rrd"], "--save no/folder/out.rrd: cannot be written: No such file or directory"),
        (["--web", "65535", "-e", free_endpoint()], "--web 65535: must be a port"),
    ],
)
def test_what_cannot_be_viewed_is_a_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n and then nothing of the kind")
    assert main(["view", *arguments]) == 2
    assert sentence in capsys.readouterr().err
