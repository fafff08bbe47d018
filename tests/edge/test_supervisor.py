"""What the loop tells of itself where each part is well and the whole is not."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from edge.config import Config, ConfigFile
from edge.estimator.model import load_model
from edge.health import HealthState
from edge.outlets import Outlets
from edge.status_board import StatusBoard
from edge.supervisor import Supervisor
from edge.types import CameraInfo, FrameMeta

from .toy_scene import SIZE_WH, K

AGES = {"mavlink": 200.0, "zenoh": 500.0}  # the defaults


@pytest.mark.parametrize(
    ("latency_ms", "links_on", "withheld"),
    [
        (150, {"mavlink", "zenoh"}, set()),
        (300, {"mavlink", "zenoh"}, {"mavlink"}),
        (600, {"mavlink", "zenoh"}, {"mavlink", "zenoh"}),
        (300, {"zenoh"}, set()),
    ],
)
def test_a_camera_so_late_that_its_poses_are_withheld_is_no_good_state(
    toy_model: Path, latency_ms: int, links_on: set[str], withheld: set[str]
) -> None:
    links = {name: {"enabled": name in links_on} for name in AGES}
    config = Config.model_validate({"camera": {"type": "sequence", "path": "/scene"}, **links})
    board = StatusBoard(
        ConfigFile(Path("c.toml"), "", config), load_model(toy_model, 1), CameraInfo("toy", SIZE_WH, K, 30.0)
    )
    supervisor = Supervisor(config.health, True, Outlets(None, None), board, lambda: {}, lambda _: ())
    for index in range(3):
        now_ns = time.monotonic_ns()
        meta = FrameMeta(index, now_ns - latency_ms * 1_000_000, now_ns)
        supervisor.frame_done(meta, {"total": latency_ms * 1_000_000}, (), has_attitude=True)
        supervisor.turn()
    condition = supervisor.snapshot().condition
    assert {reason.kind for reason in condition.reasons} == {f"{link}_too_old" for link in withheld}
    assert (condition.state is HealthState.DEGRADED) == bool(withheld)
    for link in withheld:
        assert f"{latency_ms} ms from the exposure, [{link}] max_age_ms {AGES[link]:g}" in str(condition)
