"""A toy model, a scene it can see, and the daemon's command as a process."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from edge import clock
from edge.estimator.model import load_model

from .flying import write_swaying_scene
from .looping import Gated
from .toy_model import write_toy_model
from .toy_scene import write_scene

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def toy_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_model(tmp_path_factory.mktemp("model") / "toy.onnx")


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "000001", frames=40)


@pytest.fixture(scope="session")
def swaying(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene in which the toy model never loses its target."""
    return write_swaying_scene(tmp_path_factory.mktemp("scenes") / "000001")


@pytest.fixture
def cli(tmp_path: Path) -> Cli:
    """Run `uavpose-edge` as a process in an empty folder."""

    def run(*arguments: str | Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "edge.cli", *map(str, arguments)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=timeout_s, check=False)

    return run


@pytest.fixture
def stepped() -> Iterator[int]:
    """The time, which stands still but for steps."""
    now_ns = time.monotonic_ns()
    clock.step_to(now_ns)
    yield now_ns
    clock.run_freely()


@pytest.fixture
def gated(toy_model: Path) -> Gated:
    return Gated(load_model(toy_model, 1))
