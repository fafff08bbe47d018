"""What the ground sees and keeps: `watch` and `record` as processes beside real sessions."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from mcap.reader import make_reader
from rich.console import Console
from scipy.spatial.transform import Rotation

from msgs import cdr, client, topics
from msgs.ground.cli import main
from msgs.ground.feed import linked, listening
from msgs.ground.fleet import Fleet
from msgs.ground.watch import WatchOptions, _watch_json
from msgs.publish import Node, TopicPublisher
from msgs.session import peer_config, router_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from ..conftest import Network

R_NED_BODY = Rotation.from_euler("ZYX", [80.0, 5.0, -10.0], degrees=True)
R_BODY_CAM = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
R_NED_TARGET = Rotation.from_euler("ZYX", [200.0, 12.0, 33.0], degrees=True)


class Vehicle:
    """A vehicle that flies at its target at 20 m/s, on a session of its own or another's."""

    def __init__(self, session: zenoh.Session, name: str, stack: ExitStack) -> None:
        self.node = stack.enter_context(Node(session, name))
        self.token = session.liveliness().declare_token(topics.alive_token(name))
        self.publishers: dict[str, TopicPublisher] = {}
        self.began_s = time.monotonic()
        self.last_z_m = 0.0

    def put(self, topic: topics.Topic, message: cdr.Payload, target: str | None = None) -> None:
        if topic.name not in self.publishers:
            self.publishers[topic.name] = self.node.publisher(topic, target)
        self.publishers[topic.name].put(message.encode())

    def tell(self) -> None:
        """One frame's worth."""
        stamp_ns = time.time_ns()
        self.last_z_m = 300.0 - 20.0 * (time.monotonic() - self.began_s)
        t, R = np.array([30.0, -40.0, self.last_z_m]), (R_NED_BODY * R_BODY_CAM).inv() * R_NED_TARGET
        covariance = np.diag([1.0, 1.0, 25.0, 0.01, 0.01, 0.01])
        hypothesis = cdr.Hypothesis("fixed_wing", 0.83, t, R.as_quat(), covariance)
        one = cdr.Detection3D(stamp_ns, "camera_optical_frame", (hypothesis,), t, R.as_quat(), np.zeros(3), "t0")
        body = cdr.TransformStamped(stamp_ns, "base_link_ned", "base_link_frd", np.zeros(3), R_NED_BODY.as_quat())
        camera = cdr.TransformStamped(
            stamp_ns, "base_link_frd", "camera_optical_frame", np.zeros(3), R_BODY_CAM.as_quat()
        )
        self.put(topics.TF, cdr.TFMessage((body, camera)))
        self.put(topics.DETECTIONS, cdr.Detection3DArray(stamp_ns, "camera_optical_frame", (one,)))
        pose = cdr.PoseWithCovarianceStamped(stamp_ns, "camera_optical_frame", t, R.as_quat(), covariance)
        self.put(topics.POSE, pose, "t0")

    def tell_health(self) -> None:
        status = cdr.DiagnosticStatus(1, "uavpose_edge", "degraded; no own attitude", "uav", (("dropped", "3"),))
        self.put(topics.DIAGNOSTICS, cdr.DiagnosticArray(time.time_ns(), "", (status,)))


class Lines:
    """What a process prints, read as it comes."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.all: list[str] = []
        self._thread = threading.Thread(target=self._read, args=(process,), daemon=True)
        self._thread.start()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.all.append(line)

    def ended(self) -> None:
        """Wait for the last word, before the pipe is closed."""
        self._thread.join(20.0)

    def objects(self, kind: str) -> list[dict[str, object]]:
        return [one for one in map(json.loads, list(self.all)) if one["type"] == kind]


@contextmanager
def ground(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], Lines]]:
    """`uavpose-ground` as a process."""
    command = [sys.executable, "-m", "msgs.ground.cli", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        lines = Lines(process)
        try:
            yield process, lines
        finally:
            process.kill()
            lines.ended()


def test_json_lines_tell_poses_health_events_and_who_comes_and_goes(network: Network) -> None:
    with ExitStack() as stack, ground("watch", "--json", "-e", network.endpoint) as (process, lines):
        uav1, uav2 = (Vehicle(network.daemon, name, stack) for name in ("uav1", "uav2"))
        uav1.put(topics.EVENTS, cdr.Log(time.time_ns(), 20, "uavpose_edge", "tracking"))

        def tell() -> None:
            uav1.tell()
            ray = cdr.Vector3Stamped(time.time_ns(), "camera_optical_frame", np.array([0.6, 0.0, 0.8]))
            uav1.put(topics.DIRECTION, ray, "t1")
            uav2.tell()
            uav1.tell_health()

        def full() -> list[dict[str, object]]:
            """Poses of which all is told: what else a frame brings may come after its pose, or be lost."""
            known = ("closing_mps", "attitude_deg", "score")
            return [one for one in lines.objects("pose") if None not in (one[key] for key in known)]

        def refused(uav: str) -> str:
            return next((str(one["counts"]) for one in reversed(lines.objects("refused")) if one["uav"] == uav), "")

        def complete() -> bool:
            heard = {one["uav"] for one in full()}
            others = all(lines.objects(kind) for kind in ("health", "event", "direction"))
            return heard == {"uav1", "uav2"} and others

        until(complete, tell)
        last = full()[-1]
        x, y, z = last["t_cam_target_m"]  # type: ignore[misc]
        direction = (R_NED_BODY * R_BODY_CAM).apply([x, y, z])
        assert last["range_m"] == pytest.approx(np.linalg.norm([x, y, z]))
        assert last["bearing_deg"] == pytest.approx(np.degrees(np.arctan2(direction[1], direction[0])) % 360)
        assert last["elevation_deg"] == pytest.approx(np.degrees(np.arcsin(-direction[2] / np.linalg.norm(direction))))
        assert last["attitude_deg"] == pytest.approx([33.0, 12.0, 200.0])
        assert 15.0 < last["closing_mps"] < 25.0  # type: ignore[operator]
        assert (last["score"], last["frame"]) == (0.83, "ned")
        assert last["sigma_rotation_deg"] == pytest.approx(np.degrees(0.1))
        assert 0.0 <= last["age_s"] < 2.0  # type: ignore[operator]
        seen = next(one for one in lines.objects("direction") if one["frame"] == "ned")
        ahead, right, down = (R_NED_BODY * R_BODY_CAM).apply([0.6, 0.0, 0.8])
        assert (seen["uav"], seen["target"], seen["ray_cam"]) == ("uav1", "t1", [0.6, 0.0, 0.8])
        assert seen["bearing_deg"] == pytest.approx(np.degrees(np.arctan2(right, ahead)) % 360)
        assert seen["elevation_deg"] == pytest.approx(np.degrees(np.arcsin(-down)))
        assert lines.objects("health")[0]["values"] == {"dropped": "3"}
        assert [one["event"] for one in lines.objects("event")] == ["tracking"]
        assert {(one["uav"], one["alive"]) for one in lines.objects("vehicle")} == {("uav1", True), ("uav2", True)}
        assert [one["up"] for one in lines.objects("link")] == [True]
        uav2.publishers[topics.POSE.name].put(b"junk")
        until(lambda: "'not little-endian CDR': 1" in refused("uav2"), what="the count of what is refused")
        uav2.token.undeclare()
        until(lambda: lines.objects("vehicle")[-1] == {"type": "vehicle", "uav": "uav2", "alive": False})
        process.terminate()
        assert process.wait(60.0) == 0


def test_lines_that_cannot_be_written_any_more_end_it_with_a_sentence(network: Network, tmp_path: Path) -> None:
    """A file that may not grow beyond 4 kB stands for a full disk."""
    words = [sys.executable, "-m", "msgs.ground.cli", "watch", "--json", "-e", network.endpoint]
    shell = ["bash", "-c", 'ulimit -f 4 && exec "$@" >poses.jsonl', "bash", *words]
    with ExitStack() as stack:
        process = stack.enter_context(subprocess.Popen(shell, cwd=tmp_path, stderr=subprocess.PIPE, text=True))
        uav1 = Vehicle(network.daemon, "uav1", stack)
        until(lambda: process.poll() is not None, uav1.tell, what="the end of watch")
        assert process.stderr is not None
        assert process.stderr.read() == "standard output: cannot be written: File too large\n"
        assert process.returncode == 2


def test_the_table_shows_vehicles_and_targets_and_junk_is_refused(network: Network) -> None:
    with ExitStack() as stack, ground("watch", "-e", network.endpoint) as (process, lines):
        uav1 = Vehicle(network.daemon, "uav1", stack)

        def tell() -> None:
            uav1.tell()
            uav1.tell_health()
            uav1.publishers[topics.POSE.name].put(b"junk")

        until(lambda: sum("uav1/t0" in line for line in lines.all) > 1, tell)
        process.terminate()
        assert process.wait(60.0) == 0, process.stderr and process.stderr.read()
        text = "".join(lines.all)
    assert "uav1/t0" in text
    assert "200/+12/+33" in text
    assert "degraded" in text
    assert f"{network.endpoint}: up" in text


def test_the_router_may_come_later_and_come_again() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack, ground("watch", "--json", "-e", endpoint) as (_, lines):
        daemon = stack.enter_context(zenoh.open(peer_config([], [endpoint])))
        uav1 = Vehicle(daemon, "uav1", stack)
        links: list[object] = []
        for _ in range(2):
            before = len(lines.objects("pose"))
            links.append(True)
            with zenoh.open(router_config([endpoint])):
                until(lambda before=before: len(lines.objects("pose")) > before + 3, uav1.tell)  # type: ignore[misc]
                until(lambda: [one["up"] for one in lines.objects("link")] == links)
            links.append(False)
            until(lambda: [one["up"] for one in lines.objects("link")] == links)


def test_what_is_recorded_is_what_came_from_every_vehicle(network: Network, tmp_path: Path) -> None:
    with (
        ExitStack() as stack,
        ground("record", "-e", network.endpoint, "--dir", tmp_path, "--free-mb", 0) as (
            process,
            _,
        ),
    ):
        uav1, uav2 = (Vehicle(network.daemon, name, stack) for name in ("uav1", "uav2"))
        uav1.put(topics.EVENTS, cdr.Log(time.time_ns(), 20, "uavpose_edge", "before"))

        def tell() -> None:
            uav1.tell()
            uav2.tell()

        until(lambda: any(path.stat().st_size > 20_000 for path in tmp_path.iterdir()), tell)
        process.terminate()
        assert process.wait(60.0) == 0
    (path,) = tmp_path.iterdir()
    with open(path, "rb") as file:
        read = [(channel, message) for _, channel, message in make_reader(file).iter_messages()]
    came = [(channel.topic, message) for channel, message in read]
    assert {channel.metadata["zenoh_session"] for channel, _ in read} == {str(network.daemon.zid())}
    assert all(len(bytes.fromhex(channel.metadata["gid"])) == 16 for channel, _ in read)
    for uav in ("uav1", "uav2"):
        poses = [cdr.PoseWithCovarianceStamped.decode(m.data) for name, m in came if name == f"/{uav}/target/t0/pose"]
        assert all(pose.t_cam_target_m[0] == 30.0 for pose in poses)
        assert len(poses) > 3
    assert [cdr.Log.decode(m.data).msg for name, m in came if name == "/uav1/events"] == ["before"]
    assert all(0 <= m.log_time - m.publish_time < 10**10 for _, m in came)


@pytest.mark.parametrize("name", ["file", "file/within"])
def test_a_folder_that_cannot_be_recorded_into_is_told_before_anything_flies(
    name: str, network: Network, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main(["record", "-e", network.endpoint, "--dir", str(tmp_path / name), "--seconds", "0.5"]) == 2
    assert f"--dir {tmp_path / name}: cannot be written: " in capsys.readouterr().err


def test_a_link_that_is_down_is_told_so_from_the_first() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        with zenoh.open(router_config([endpoint])):
            opened = stack.enter_context(client.connect(endpoint))
            until(lambda: linked(opened))
        until(lambda: not linked(opened))
        stop, console = threading.Event(), Console(file=io.StringIO())
        stop.set()
        _watch_json(WatchOptions(endpoint), Fleet(), opened, stop, console)
        assert isinstance(console.file, io.StringIO)
        assert console.file.getvalue() == '{"type": "link", "up": false}\n'


def test_who_bears_no_vehicle_s_name_is_not_told_of(network: Network) -> None:
    here: list[str] = []
    with ExitStack() as stack:
        opened = stack.enter_context(client.connect(network.endpoint))
        stack.enter_context(listening(opened, (), 0, lambda _: None, lambda uav, _: here.append(uav)))
        for name in ("my-uav", "\x1b[2J", "uav1"):
            stack.enter_context(network.daemon.liveliness().declare_token(f"uavpose/@v1/{name}/alive"))
        until(lambda: "uav1" in here)
    assert set(here) == {"uav1"}


@pytest.mark.parametrize("number", ["nan", "inf", "-1", "much", "1e305"])
@pytest.mark.parametrize("option", ["watch --max-age", "view --max-age", "record --free-mb"])
def test_what_is_no_number_from_nought_on_is_a_sentence(
    option: str, number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([*option.split(), number, "--seconds", "0.1"])
    assert f"argument {option.split()[1]}: {number} is not a number of at least 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", ["watch --seconds 1e10", "watch --seconds 0", "view --seconds 1e10", "record --file-mb 1e305"]
)
def test_what_is_no_positive_number_or_a_huge_one_is_a_sentence(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    command, option, number = words.split()
    with pytest.raises(SystemExit, match="2"):
        main([command, option, number, "-e", free_endpoint()])
    said = f"argument {option}: {number} is not a positive number of at most 1000000000\n"
    assert capsys.readouterr().err.endswith(said)


@pytest.mark.parametrize("domain", ["-1", "233", "0.5", "uav1", ""])
def test_what_is_no_ros_domain_is_a_sentence(domain: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["watch", "-e", free_endpoint(), "--domain", domain, "--seconds", "0.1"])
    assert f"{domain} is not a ROS domain, 0 to 232" in capsys.readouterr().err
