"""docs/cameras.md and the examples that it names: what is there is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from edge.cameras.capture import Capture
from edge.cameras.sequence import SequenceSource
from edge.config import load_config
from edge.config_camera import SequenceCamera

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
