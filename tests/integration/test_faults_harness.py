"""The harness of faults itself: what it says of a bad timeline, and that its judge sees what it is there to see."""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import InputError
from msgs.mavlink import FrameReader, MAVLink, dialect
from sim_replay.faults import hostile, run
from sim_replay.faults.judge import pose_faults
from sim_replay.faults.messages import AUTOPILOT, SUBSCRIBER
from sim_replay.faults.relay import LinkState, TcpRelay, UdpRelay, message_id
from sim_replay.faults.rig import SERVING, Rig, RigSettings
from sim_replay.faults.timeline import Start, Who, load_timeline
from sim_replay.faults.witness import ExposedFrame, ReceivedPose
from sim_replay.ports import LOOPBACK

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
FRAMES = [ExposedFrame(T0 + k * 100 * MS, T0 + k * 100 * MS, frozen=k >= 20) for k in range(40)]
WAIT_S = 30.0


def pose(frame: int, age_ms: float, peer: str = AUTOPILOT, off_ms: float = 0.0) -> ReceivedPose:
    capture_ns = FRAMES[frame].stamp_ns + round(off_ms * MS)
    return ReceivedPose(peer, capture_ns, FRAMES[frame].exposed_ns + round(age_ms * MS))


def test_fresh_poses_of_frames_that_were_exposed_are_no_fault() -> None:
    assert pose_faults([pose(3, 20.0), pose(4, 190.0, off_ms=0.4), pose(5, 450.0, SUBSCRIBER)], FRAMES) == []


@pytest.mark.parametrize(
    ("received", "words"),
    [
        (pose(3, 1500.0), "1500 ms after"),
        (pose(3, 1500.0, SUBSCRIBER), "1500 ms after"),
        (pose(25, 20.0), "frozen"),
        (pose(3, 20.0, off_ms=50.0), "never exposed"),
        (replace(pose(3, 20.0), q_ned_cam_wxyz=(1.0, 0.0, 0.0, 0.0)), "nobody flew"),
    ],
)
def test_a_stale_a_frozen_and_an_invented_pose_are_found(received: ReceivedPose, words: str) -> None:
    (fault,) = pose_faults([pose(1, 20.0), received], FRAMES)
    assert words in fault


def test_a_camera_whose_clock_is_slow_does_not_make_an_old_pose_young() -> None:
    fast = [ExposedFrame(T0, T0 + 2_000 * MS, frozen=False)]
    young_by_its_stamp = ReceivedPose(AUTOPILOT, T0 + 2_000 * MS, T0 + 2_010 * MS)
    (fault,) = pose_faults([young_by_its_stamp], fast)
    assert "2010 ms after" in fault


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('title = "x"\n', "[[step]]: is missing"),
        ('title = "x"\n[[step]]\nfor_s = 1\n', "step 1: 'do' is missing"),
        ('title = "x"\n[[step]]\ndo = "explode"\n', "step 1: 'do' must be one of 'hold', 'start', 'signal'"),
        ('title = "x"\n[[step]]\ndo = "hold"\nfor_s = 1\nsoftly = true\n', "softly: unknown key"),
        ('title = "x"\n[[step]]\ndo = "link"\nwhich = "mavlink"\ndrop = ["NONE"]\n', "NONE is not a MAVLink message"),
        ("title = \n", "not valid TOML"),
        ('title = "x"\n[[step]]\ndo = "expect_said"\npattern = "no frame ("\n', "pattern: is not a regular expression"),
        ('title = "x"\n[[step]]\ndo = "disk"\nfull = true\n', "step 1: full and read_only need `volume = true`"),
        ('title = "x"\n[[step]]\ndo = "start"\nwho = "camera"\nrebooted = true\n', "rebooted applies to an autopilot"),
        ('title = "x"\n[[step]]\ndo = "link"\nwhich = "zenoh"\ndrop = ["HEARTBEAT"]\n', "drop lists MAVLink messages"),
    ],
)
def test_a_bad_timeline_is_told_by_file_and_key(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError) as told:
        load_timeline(path)
    assert str(told.value).startswith(str(path))
    assert words in str(told.value)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, small_scene: Path, toy_model: Path) -> Iterator[Rig]:
    with Rig(RigSettings(tmp_path_factory.mktemp("rig"), small_scene, toy_model, fps=30.0)) as rig:
        yield rig


def play_steps(rig: Rig, folder: Path, steps: str) -> run.Outcome:
    path = folder / "own.toml"
    path.write_text(f'title = "x"\n{steps}')
    return run.play_timeline(rig, load_timeline(path), print)


def test_counters_of_a_daemon_that_was_started_again_count_from_nothing(rig: Rig, tmp_path: Path) -> None:
    assert rig.witness.wait_for(lambda: rig.witness.counters.get("captured", 0) > 300, 60.0)
    steps = '[[step]]\ndo = "signal"\nwho = "daemon"\nname = "KILL"\n[[step]]\ndo = "start"\nwho = "daemon"\n'
    steps += '[[step]]\ndo = "expect_counter"\nname = "captured"\nwithin_s = 8.0\n'  # at 30 a second: 240 at most
    assert play_steps(rig, tmp_path, steps).wrong == []


def test_what_still_runs_and_holds_a_port_is_replaced(rig: Rig, tmp_path: Path) -> None:
    before = {who: rig.processes[who] for who in SERVING}
    for who in SERVING:
        steps = f'[[step]]\ndo = "start"\nwho = "{who}"\n[[step]]\ndo = "expect_poses"\n'
        assert play_steps(rig, tmp_path, steps).wrong == []
        assert before[who].exit_code is not None
        assert rig.processes[who].exit_code is None


def test_what_was_not_seen_is_told_as_it_was(rig: Rig, tmp_path: Path) -> None:
    steps = '[[step]]\ndo = "signal"\nwho = "camera"\nname = "STOP"\n'
    steps += '[[step]]\ndo = "expect_still"\nname = "captured_"\nfor_s = 1.0\n'
    steps += '[[step]]\ndo = "expect_silence"\nfor_s = 90.0\nwithin_s = 3.0\n'
    outcome = play_steps(rig, tmp_path, steps)
    rig.processes["camera"].send_signal(signal.SIGCONT)
    assert "captured_ (which the daemon has not told of) stood still" in outcome.seen[0]["seen"]
    assert outcome.wrong[0].startswith("no silence of 90 s within 3 s, but of ")


@pytest.mark.parametrize("who", ["daemon", "subscriber"])
def test_a_process_that_ends_by_itself_is_told_also_if_nothing_more_is_expected_of_it(
    rig: Rig, tmp_path: Path, who: Who
) -> None:
    path = tmp_path / "held.toml"
    path.write_text('title = "x"\n[[step]]\ndo = "hold"\nfor_s = 0.1\n')

    def say(text: str) -> None:
        if text.startswith("  hold"):
            rig.processes[who].send_signal(signal.SIGABRT)
            assert rig.processes[who].wait(WAIT_S) == -6

    outcome = run.play_timeline(rig, load_timeline(path), say)
    assert outcome.wrong == [f"the {who} ended with exit code -6, which no step asked for"]
    rig.start(Start(do="start", who=who))
    steps = f'[[step]]\ndo = "signal"\nwho = "{who}"\nname = "KILL"\n'
    assert play_steps(rig, tmp_path, steps).wrong == []
    rig.start(Start(do="start", who=who))


def test_a_scene_of_another_picture_format_is_shown_as_a_camera_would(
    small_scene: Path, toy_model: Path, tmp_path: Path
) -> None:
    """BOP datasets have TIFF files of 16 bits too; the daemon takes only what drivers publish."""
    scene = tmp_path / "000001"
    (scene / "gray").mkdir(parents=True)
    for path in sorted((small_scene / "rgb").iterdir())[:8]:
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 257
        cv2.imwrite(str(scene / "gray" / f"{path.stem}.tif"), pixels)
    shutil.copy(small_scene / "scene_camera.json", scene)
    with Rig(RigSettings(tmp_path / "rig", scene, toy_model)) as rig:
        steps = '[[step]]\ndo = "expect_poses"\nwithin_s = 30.0\n'
        assert play_steps(rig, tmp_path, steps).wrong == []


def test_to_act_upon_what_does_not_run_any_more_is_refused_by_name(rig: Rig, tmp_path: Path) -> None:
    killed = '[[step]]\ndo = "signal"\nwho = "camera"\nname = "KILL"\n'
    for step in ('do = "camera"\nfrozen = true\n', 'do = "signal"\nwho = "camera"\nname = "STOP"\n'):
        with pytest.raises(InputError, match=r"^the camera is not running"):
            play_steps(rig, tmp_path, f"{killed}[[step]]\n{step}")
        rig.start(Start(do="start", who="camera"))


def test_the_command_takes_bundled_timelines_by_name_and_refuses_a_missing_one(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    run.register(parser.add_subparsers())
    for name in run.bundled():
        load_timeline(run.TIMELINES / f"{name}.toml")
    args = parser.parse_args(["faults", "--timeline", str(tmp_path / "none.toml"), "--out", str(tmp_path)])
    with pytest.raises(InputError, match=r"none\.toml: is neither a file nor .*: all-at-once, .*, zenoh-cut"):
        args.run(args)


def test_what_a_timeline_needs_is_told_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parser = argparse.ArgumentParser()
    run.register(parser.add_subparsers())
    paths = {}
    for name in ("plain", "signed", "volume"):
        paths[name] = tmp_path / f"{name}.toml"
        key = "" if name == "plain" else f"{name} = true\n"
        paths[name].write_text(f'title = "x"\n{key}[[step]]\ndo = "hold"\nfor_s = 1\n')
    monkeypatch.setenv("PATH", str(tmp_path))  # no unshare, as on a host that lets nobody mount
    for name in ("signed", "volume"):
        words = ["faults", "--timeline", str(paths["plain"]), "--timeline", str(paths[name]), "--out", str(tmp_path)]
        args = parser.parse_args(words)
        with pytest.raises(InputError, match=rf"^{paths[name]}: {name} "):
            args.run(args)


@pytest.fixture
def udp() -> Iterator[tuple[UdpRelay, socket.socket, socket.socket]]:
    """A relay between two sockets: the autopilot's, and the daemon's, which has heard from the other."""
    with socket.socket(type=socket.SOCK_DGRAM) as autopilot, socket.socket(type=socket.SOCK_DGRAM) as daemon:
        for end in (autopilot, daemon):
            end.bind((LOOPBACK, 0))
            end.settimeout(WAIT_S)
        with closing(UdpRelay(daemon.getsockname())) as relay:
            autopilot.connect((LOOPBACK, relay.port))
            autopilot.send(b"first")
            _, address = daemon.recvfrom(100)
            daemon.connect(address)
            yield relay, autopilot, daemon


def test_a_udp_relay_passes_both_ways_and_one_that_is_cut_neither(
    udp: tuple[UdpRelay, socket.socket, socket.socket],
) -> None:
    relay, autopilot, daemon = udp
    relay.state = LinkState(cut=True)
    autopilot.send(b"lost")
    daemon.send(b"lost")
    autopilot.settimeout(0.5)
    with pytest.raises(TimeoutError):
        autopilot.recv(100)
    relay.state = LinkState(delay_s=0.01)
    autopilot.send(b"up")
    daemon.send(b"down")
    autopilot.settimeout(WAIT_S)
    assert (daemon.recv(100), autopilot.recv(100)) == (b"up", b"down")


def test_a_udp_relay_drops_messages_by_their_id(udp: tuple[UdpRelay, socket.socket, socket.socket]) -> None:
    relay, autopilot, daemon = udp
    mav = MAVLink(None, srcSystem=1, srcComponent=1)
    attitude = bytes(dialect.MAVLink_attitude_quaternion_message(0, 1, 0, 0, 0, 0, 0, 0).pack(mav))
    time = bytes(dialect.MAVLink_system_time_message(1, 2).pack(mav))
    relay.state = LinkState(drop_ids=frozenset({dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION}))
    autopilot.send(attitude)
    autopilot.send(time)
    assert daemon.recv(100) == time
    assert message_id(attitude) == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
    assert message_id(b"\xfe" + bytes(20)) is None


def test_a_tcp_relay_holds_bytes_back_while_it_is_cut_and_loses_none() -> None:
    sent = random.Random(1).randbytes(300_000)
    with socket.create_server((LOOPBACK, 0)) as server, closing(TcpRelay(server.getsockname())) as relay:
        relay.state = LinkState(cut=True)
        with socket.create_connection((LOOPBACK, relay.port)) as near:
            far, _ = server.accept()
            sender = threading.Thread(target=near.sendall, args=(sent,))
            sender.start()
            far.settimeout(0.5)
            with pytest.raises(TimeoutError):
                far.recv(1)
            relay.state = LinkState()
            far.settimeout(WAIT_S)
            received = b""
            while len(received) < len(sent):
                received += far.recv(65536)
            sender.join()
            far.close()
    assert received == sent


def test_hostile_frames_have_valid_checksums_and_random_ones_are_no_frames() -> None:
    reader = FrameReader(datagram=True)
    datagrams = list(hostile.take_bytes(hostile.hostile_datagrams(), 5_000))
    messages = [message for datagram in datagrams for message in reader.feed(datagram)]
    assert len(messages) == sum(islice(cycle(hostile.FRAMES_IN_DATAGRAM), len(datagrams)))
    assert reader.bad_runs == 0
    noise = hostile.take_bytes(hostile.random_datagrams(random.Random(0)), 50_000)
    assert [message for datagram in noise for message in reader.feed(datagram)] == []
