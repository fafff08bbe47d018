"""docs/cameras.md and the examples that it names: what is there is true."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from edge.cameras.capture import Capture
from edge.cameras.sequence import SequenceSource
from edge.cameras.zenoh_topic import ZenohSource
from edge.config import load_config
from edge.config_camera import SequenceCamera, ZenohCamera
from edge.types import Frame
from sim_replay.ports import free_port
from tests.waiting import until

from .pictures import INTRINSICS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "cameras.md").read_text()
ROWS = dict(re.findall(r"^\| `(\w+)` \|.*`(deploy/examples/camera-\w+\.toml)` \|$", PAGE, re.MULTILINE))


def test_every_kind_of_camera_has_its_example() -> None:
    assert set(ROWS) == {"device", "stream", "zenoh", "file", "folder", "sequence"}
    assert {ROOT / path for path in ROWS.values()} == set((ROOT / "deploy" / "examples").glob("camera-*.toml"))


@pytest.mark.parametrize("kind", sorted(ROWS))
def test_an_example_is_a_valid_configuration_of_its_kind(kind: str) -> None:
    assert load_config(ROOT / ROWS[kind]).config.camera.type == kind


def test_the_counters_are_those_of_the_page() -> None:
    source = SequenceSource(SequenceCamera(type="sequence", path=ROOT))
    told = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \| ", PAGE, re.MULTILINE))))
    assert set(Capture(source, False).counters()) <= told | {"dropped"}


def test_the_page_s_publisher_is_a_camera_with_its_own_stamps(tmp_path: Path) -> None:
    program = next(
        block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "import cv2, numpy" in block
    )
    assert not re.search(r"\b(?:msgs|edge|sim_replay)\b", program)
    example = load_config(ROOT / ROWS["zenoh"]).config.camera
    assert isinstance(example, ZenohCamera)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    path = tmp_path / "publisher.py"
    path.write_text(program.replace(example.connect, endpoint))
    settings = example.model_copy(update={"connect": endpoint, "intrinsics": INTRINSICS})
    process = subprocess.Popen([sys.executable, path], cwd=tmp_path)
    capture = Capture(ZenohSource(settings), opened=False)  # opens it again until the publisher listens
    capture.start()
    frames: list[Frame] = []

    def take() -> None:
        frame = capture.newest(0.1)
        if frame is not None:
            frames.append(frame)

    try:
        until(lambda: len(frames) == 2, take, what="two frames")
    finally:
        capture.stop()
        process.kill()
        process.wait()
    for frame in frames:
        assert frame.image_bgr.shape == (1080, 1920, 3)
        assert frame.image_bgr[540].min() < 80  # the disc
        assert frame.meta.capture_ns < frame.meta.arrival_ns
    counted = capture.counters()
    assert {name for name, count in counted.items() if name.startswith("camera_") and count} == set()
