"""The daemon's end of lock-step: time that only a player moves, and a frame for each word of his."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest

from edge import clock
from edge.cameras import open_capture
from edge.cameras.lockstep import LockstepCapture
from edge.cameras.source import EndOfStream
from edge.config_camera import SequenceCamera
from edge.errors import InputError
from tests.waiting import WITHIN_S

from .toy_scene import draw, write_scene


class Player:
    """The other end of the socket, a word at a time."""

    def __init__(self, scene: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            settings = SequenceCamera(type="sequence", path=scene, lockstep=f"127.0.0.1:{listening.getsockname()[1]}")
            supply, _ = open_capture(settings)
            self._socket, _ = listening.accept()
        assert isinstance(supply, LockstepCapture)
        self.capture = supply
        self._lines = self._socket.makefile("r")

    def say(self, line: str) -> None:
        self._socket.sendall(f"{line}\n".encode())

    def heard(self) -> str:
        return self._lines.readline().strip()

    def hang_up(self) -> None:
        self._lines.close()
        self._socket.close()


@pytest.fixture
def player(scene: Path) -> Iterator[Player]:
    player = Player(scene)
    yield player
    player.hang_up()
    player.capture.stop()
    clock.run_freely()


def test_time_and_frames_come_by_the_word_and_the_answer_after_the_links_have_settled(player: Player) -> None:
    settled: list[int] = []
    player.say("time 1000")
    player.capture.start(lambda: settled.append(clock.monotonic_ns()))
    assert player.heard() == "ready"
    assert (clock.monotonic_ns(), clock.utc_ns(), settled) == (1000, 1000, [])
    player.say("time 2500")
    assert player.capture.newest(5.0) is None
    assert (player.heard(), settled, clock.monotonic_ns()) == ("ok", [1000], 2500)
    player.say("frame 2")
    frame = player.capture.newest(5.0)
    assert frame is not None
    assert (frame.meta.sequence, frame.meta.capture_ns, frame.meta.arrival_ns) == (0, 2500, 2500)
    assert (player.heard(), settled) == ("ok", [1000, 2500])
    assert player.capture.newest(0.0) is None
    assert (player.heard(), settled) == ("ok", [1000, 2500, 2500])
    assert player.capture.counters() == {"captured": 1, "dropped": 0}


def test_a_picture_of_another_size_than_the_scene_s_first_ends_lock_step_too(tmp_path: Path) -> None:
    """Its pixels are not those that the scene's intrinsics are of."""
    scene = write_scene(tmp_path / "000001", frames=2)
    cv2.imwrite(str(scene / "rgb" / "000001.png"), draw((100.5, 100.5), (640, 360)))
    player = Player(scene)
    try:
        for line in ("time 1", "frame 0", "frame 1"):
            player.say(line)
        player.capture.start(lambda: None)
        assert player.capture.newest(5.0) is not None
        with pytest.raises(InputError, match=r"000001.png differs in size"):
            player.capture.newest(5.0)
    finally:
        player.hang_up()
        player.capture.stop()
        clock.run_freely()


def test_when_the_player_hangs_up_the_recording_is_over(player: Player) -> None:
    player.say("time 1")
    player.capture.start(lambda: None)
    player.hang_up()
    with pytest.raises(EndOfStream):
        player.capture.newest(5.0)


@pytest.mark.parametrize("end", ["hangs up at once", "hangs up after ready", "is silent and the daemon told to stop"])
def test_a_daemon_ends_before_the_player_s_first_word_as_after_a_recording(
    tmp_path: Path, scene: Path, toy_model: Path, end: str
) -> None:
    config = tmp_path / "config.toml"
    with socket.create_server(("127.0.0.1", 0)) as listening:
        config.write_text(
            f'[camera]\ntype = "sequence"\npath = "{scene}"\nlockstep = "127.0.0.1:{listening.getsockname()[1]}"\n'
            f'[model]\npath = "{toy_model}"\n[zenoh]\nenabled = false\n[mavlink]\nenabled = false\n'
        )
        command = [sys.executable, "-m", "edge.cli", "run", "--config", str(config)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as daemon:
            try:
                listening.settimeout(WITHIN_S)
                ours, _ = listening.accept()
                with ours, ours.makefile("r") as lines:
                    assert end == "hangs up at once" or lines.readline() == "ready\n"
                    if end.endswith("told to stop"):
                        daemon.send_signal(signal.SIGTERM)
                        daemon.wait(WITHIN_S)
                _, said = daemon.communicate(timeout=WITHIN_S)
            finally:
                daemon.kill()
    assert daemon.returncode == 0, said
    assert "Traceback" not in said
    assert "stopped: " in said.splitlines()[-1]


NO_WORD, LOCKSTEP = "neither time NS nor frame INDEX", ("camera", "lockstep")


@pytest.mark.parametrize(
    ("line", "sentence", "key"),
    [
        ("frame 99", "has no picture 99 among its 40 frames", ()),
        ("time 5", "the player's time goes back: 5 is before 10", LOCKSTEP),
        *((line, NO_WORD, LOCKSTEP) for line in ("time -3", "frame", "jump 3", "time 1e3", "frame \xff")),
    ],
)
def test_a_word_that_cannot_be_obeyed_is_told_with_its_key(
    player: Player, line: str, sentence: str, key: tuple[str, ...]
) -> None:
    player.say("time 10")
    player.capture.start(lambda: None)
    player.say(line)
    with pytest.raises(InputError, match=sentence) as refused:
        player.capture.newest(5.0)
    assert refused.value.key == key


def test_the_clock_is_the_host_s_until_it_is_stepped_and_never_goes_back() -> None:
    try:
        assert not clock.stepped()
        assert time.monotonic_ns() <= clock.monotonic_ns() <= time.monotonic_ns()
        assert time.time_ns() - clock.utc_ns() < 10**9
        clock.step_to(7)
        seen: list[int] = []
        other = threading.Thread(target=lambda: seen.append(clock.monotonic_ns()))
        other.start()
        other.join()
        assert (clock.stepped(), clock.monotonic_ns(), seen) == (True, 7, [7])
        with pytest.raises(ValueError, match="6 is before 7"):
            clock.step_to(6)
    finally:
        clock.run_freely()
    assert clock.monotonic_ns() > 7


def test_only_what_waits_for_the_host_reads_the_host_s_clock() -> None:
    """Cameras and dialled links that lock-step replaces, guards against a hang, tools that fly nothing."""
    waits = {"align", "cameras", "bench", "transports", "doctor.py", "watchdog.py", "supervisor.py", "clock.py"}
    edge = Path(clock.__file__).parent
    readers = [path for path in edge.rglob("*.py") if re.search(r"\btime\.(monotonic|time)(_ns)?\(", path.read_text())]
    assert edge / "clock.py" in readers
    assert {str(path.relative_to(edge)) for path in readers if not waits & {path.name, path.parent.name}} == set()
