"""The rig that timelines act on: a daemon with a camera, an autopilot, a router and a subscriber, all real processes.

camera ─zenoh─▶ daemon ─zenoh─▶ TCP relay ─▶ router ─▶ subscriber
                  ▲└──MAVLink──▶ UDP relay ─▶ autopilot
                  └── recordings (on a volume of their own, where the host allows it)
"""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.picture_file import read_pixels
from edge.cameras.sequence import read_scene
from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from edge.links.signing_key import write_new_key
from msgs.command_line import EXIT_BAD_INPUT
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.faults.camera import TOPIC
from sim_replay.faults.messages import OWN_LAT_LON_ALT, OWN_UP_M
from sim_replay.faults.processes import Process
from sim_replay.faults.relay import TcpRelay, UdpRelay
from sim_replay.faults.timeline import Start, Who
from sim_replay.faults.witness import Witness
from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK, free_port
from sim_replay.telemetry import COLUMNS, FLOWN_CSV, Telemetry, write_telemetry

START_S = 120.0
UPTIME_NS = 734_567_891_234  # of an autopilot that was already running
VOLUME_MB = 4
UAV = "uav1"
# The subscriber reports everything, however late: the judge decides what is stale.
PATIENT = ("--wait-s", str(START_S), "--all", "--max-age-s", "3600")
KEY = "mavlink.key"
ICAO_ADDRESS = 0xF00000
SERVING: tuple[Who, ...] = ("camera", "router", "daemon")  # each listens at its own port throughout


@dataclass(frozen=True)
class RigSettings:
    """What flies. With `volume`, recordings go to a small file system of their own that can be filled."""

    out: Path
    scene: Path = BUNDLED_SEQUENCE
    model: Path = SHIPPED_MODEL
    fps: float = 10.0
    volume: bool = False
    signed: bool = False  # daemon and autopilot share a key


class Rig:
    """Used with `with`; afterwards all processes have ended and `daemon.log` is in the folder."""

    def __init__(self, settings: RigSettings) -> None:
        self.settings = settings
        self.witness = Witness()
        self.processes: dict[Who, Process] = {}
        self.extras: list[Process] = []  # started by acts, ended with the rig
        self._boot_at_ns = time.monotonic_ns() - UPTIME_NS
        self._camera_port, self._router_port, self._own_port = (free_port(socket.SOCK_STREAM) for _ in range(3))
        self.mavlink_port = free_port(socket.SOCK_DGRAM)

    def __enter__(self) -> Rig:
        self.settings.out.mkdir(parents=True, exist_ok=True)
        self.mavlink = UdpRelay((LOOPBACK, self.mavlink_port))
        self.zenoh = TcpRelay((LOOPBACK, self._router_port))
        try:
            self._write_files()
            for who in ("camera", "router", "autopilot", "daemon", "subscriber"):
                self.start(Start(do="start", who=who))
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all, peers first, so that their summaries cover all that the daemon sent."""
        for process in (*self.extras, *self.processes.values()):
            if process.exit_code is None:
                process.send_signal(signal.SIGCONT)
        for process in self.extras:
            process.end(signal.SIGKILL)
        for who in ("subscriber", "autopilot", "daemon", "router", "camera"):
            if who in self.processes:
                self.processes[who].end()
        self.mavlink.close()
        self.zenoh.close()
        log = "".join(f"{line}\n" for _, line in self.witness.said)
        (self.settings.out / "daemon.log").write_text(log, encoding="utf-8")

    @property
    def daemon(self) -> Process:
        return self.processes["daemon"]

    def running(self, who: Who) -> Process:
        """Raises InputError if it has ended, so that there is nothing to act on."""
        process = self.processes[who]
        if process.exit_code is not None:
            raise InputError(f"the {who} is not running: the timeline must `start` it before acting on it")
        return process

    @property
    def own_endpoint(self) -> str:
        """Where the daemon serves on-board tools."""
        return f"tcp/{LOOPBACK}:{self._own_port}"

    @property
    def model_file(self) -> Path:
        """The daemon's own copy."""
        return self.settings.out / "model.onnx"

    @property
    def recordings(self) -> Path:
        return self.settings.out.resolve() / "recordings"

    def start(self, step: Start) -> None:
        """Start a process and wait until it is ready; a running one of that name is killed.

        For a server, the port must first be free again. An autopilot is killed once its successor sends, but before
        that if the successor has another clock: if two send alternately, each change of sender looks like a reboot.

        Raises InputError if the daemon rejects its configuration, PlayError if anything else does not start.
        """
        who = step.who
        before = self.processes.get(who)
        if before is not None and (who in SERVING or step.rebooted or step.clock_ahead_s):
            before.end(signal.SIGKILL)
        self.witness.forget_ready(who)
        if who == "daemon":
            self.witness.forget_counters()
        said_before = len(self.witness.said)
        if who == "daemon":
            process = Process(self._daemon_command(), self.witness.hear_daemon)
        else:
            process = Process(self._command(step), lambda line, _: self.witness.hear(who, line))
        self.processes[who] = process

        def ready() -> bool:
            if who == "daemon":
                return any("ready: " in line for _, line in self.witness.said[said_before:])
            return self._router_answers() if who == "router" else who in self.witness.ready

        up = self.witness.wait_for(lambda: process.exit_code is not None or ready(), START_S)
        if before is not None:
            before.end(signal.SIGKILL)
        if not up or process.exit_code is not None:
            raise self._not_started(who, process)

    def _not_started(self, who: str, process: Process) -> Exception:
        if process.exit_code is None:
            return PlayError(f"the {who} was not ready within {START_S:.0f} s")
        process.reap()
        words = [line for _, line in self.witness.said] if who == "daemon" else self.witness.complaints
        last = words[-1] if words else "it said nothing"
        sentence = f"the {who} ended with exit code {process.exit_code}: {last}"
        return InputError(sentence) if process.exit_code == EXIT_BAD_INPUT else PlayError(sentence)

    def _router_answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((LOOPBACK, self._router_port)) == 0

    def _command(self, step: Start) -> list[str | Path]:
        python: list[str | Path] = [sys.executable, "-m"]
        if step.who == "camera":
            camera: list[str | Path] = [*python, "sim_replay.faults.camera", "--scene", self.settings.scene]
            return [*camera, "--listen", f"tcp/{LOOPBACK}:{self._camera_port}", "--fps", str(self.settings.fps)]
        if step.who == "router":
            return [*python, "msgs.ground.cli", "router", "--config", self.settings.out / "router.toml"]
        if step.who == "subscriber":
            endpoint = f"tcp/{LOOPBACK}:{self._router_port}"
            return [*python, "sim_replay.subscriber", "--connect", endpoint, "--uav", UAV, *PATIENT]
        now_ns = time.monotonic_ns()
        self._boot_at_ns = now_ns if step.rebooted else self._boot_at_ns - round(step.clock_ahead_s * 1e9)
        return [
            *(*python, "sim_replay.autopilot", "--all", "--telemetry", self.settings.out / FLOWN_CSV),
            *("--endpoint", f"{LOOPBACK}:{self.mavlink.port}", "--start-at-ns", str(now_ns)),
            *("--boot-at-ns", str(self._boot_at_ns), "--system-id", str(step.system_id)),
            *(("--signing-key", self.settings.out / KEY) if self.settings.signed else ()),
        ]

    def _daemon_command(self) -> list[str | Path]:
        command = Path(sys.executable).parent / "uavpose-edge"
        run: list[str | Path] = [command, "run", "--config", self.settings.out / "config.toml"]
        return [*in_volume(self.recordings), *run] if self.settings.volume else run

    def _write_files(self) -> None:
        out = self.settings.out
        shutil.copyfile(self.settings.model, self.model_file)
        self.recordings.mkdir(exist_ok=True)
        if self.settings.signed and not (out / KEY).exists():
            write_new_key(out / KEY)
        (out / "router.toml").write_text(f'listen = ["tcp/{LOOPBACK}:{self._router_port}"]\n', encoding="utf-8")
        write_telemetry(out / FLOWN_CSV, at_rest())
        (out / "config.toml").write_text(self._config(), encoding="utf-8")

    def _config(self) -> str:
        picture = read_scene(self.settings.scene)[0]
        height, width = read_pixels(picture.path, cv2.IMREAD_COLOR).shape[:2]
        K = picture.K
        return "\n".join([
            "[vehicle]",
            f"name = {json.dumps(UAV)}",
            "[camera]",
            'type = "zenoh"',
            f"topic = {json.dumps(TOPIC)}",
            f'connect = "tcp/{LOOPBACK}:{self._camera_port}"',
            "[camera.intrinsics]",
            f"fx = {K[0, 0]}\nfy = {K[1, 1]}\ncx = {K[0, 2]}\ncy = {K[1, 2]}\nwidth = {width}\nheight = {height}",
            "[model]",
            f"path = {json.dumps(self.model_file.name)}\nthreads = 1",
            "[zenoh]",
            f'listen = ["{self.own_endpoint}"]',
            f'connect = ["tcp/{LOOPBACK}:{self.zenoh.port}"]',
            "[mavlink]",
            f'endpoints = ["udpin:{LOOPBACK}:{self.mavlink_port}"]',
            f"follow_target = true\nadsb_icao_address = {ICAO_ADDRESS}",
            f"signing_key = {json.dumps(KEY)}" if self.settings.signed else "",
            "[recorder]",
            f"enabled = true\nfolder = {json.dumps(str(self.recordings))}\nfree_min_mb = 0",
            "[health]",
            "no_frame_s = 1.0",
        ]) + "\n"  # fmt: skip


def at_rest() -> Telemetry:
    """An own ship that hovers level, facing north: these tests are not about flying."""
    row = np.zeros(len(COLUMNS) - 1)
    row[0] = 1.0
    row[9], row[-3:] = -OWN_UP_M, OWN_LAT_LON_ALT
    return Telemetry(np.array([0, 1_000_000_000]), np.stack([row, row]))


def in_volume(folder: Path) -> list[str | Path]:
    """Prefix for a command, so that `folder` is a small file system that only this command sees."""
    script = f'mount -t tmpfs -o size={VOLUME_MB}m none "$0" && exec "$@"'
    return ["unshare", "--map-root-user", "--mount", "sh", "-c", script, folder]


def can_mount(folder: Path) -> bool:
    """Whether this host allows a user to do so."""
    if shutil.which("unshare") is None:
        return False
    tried = subprocess.run([*in_volume(folder.resolve()), "true"], capture_output=True, check=False)
    return tried.returncode == 0
