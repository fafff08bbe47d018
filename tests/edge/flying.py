"""The daemon as a process, and a scene whose target it never loses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2

from .toy_scene import K, draw

POSITIONS = 8


@dataclass
class Flight:
    """A running daemon and its words so far."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)

    def until(self, text: str) -> str:
        """Read on until a line holds `text`; that line. Fails if the daemon ends first."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            if text in line:
                return line
        raise AssertionError(f"ended without {text!r}:\n{''.join(self.lines)}")


@contextmanager
def flying(
    tmp_path: Path, text: str, environment: dict[str, str] | None = None, program: Sequence[str] = ("-m", "edge.cli")
) -> Iterator[Flight]:
    """The daemon, once it has done its first frame."""
    config = tmp_path / "config.toml"
    config.write_text(text)
    command = [sys.executable, *program, "run", "--config", str(config)]
    surroundings = {**os.environ, **(environment or {})}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=surroundings) as daemon:
        flight = Flight(daemon)
        try:
            flight.until("first frame")
            yield flight
        finally:
            daemon.kill()


def write_swaying_scene(folder: Path) -> Path:
    """A target that sways by a few pixels, and begins again without a jump."""
    (folder / "rgb").mkdir(parents=True)
    order = [*range(POSITIONS), *range(POSITIONS - 2, 0, -1)]
    for index, step in enumerate(order):
        picture = draw((500.5 + 2 * step, 420.5))
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    cameras = {str(index): {"cam_K": K.ravel().tolist(), "depth_scale": 1.0} for index in range(len(order))}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def toml(scene: Path, model: Path, zenoh_port: int, more: str = "", fps: int = 10) -> str:
    """A configuration that flies round and round, without MAVLink."""
    return (
        f'[camera]\ntype = "sequence"\npath = "{scene}"\nfps = {fps}\nloop = true\n'
        f'[model]\npath = "{model}"\nthreads = 1\n'
        f'[zenoh]\nlisten = ["tcp/127.0.0.1:{zenoh_port}"]\n[mavlink]\nenabled = false\n{more}'
    )
