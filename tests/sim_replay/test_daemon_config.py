"""What a replay writes for the daemon is what the daemon reads, wherever the files lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.config import load_config
from edge.config_camera import SequenceCamera
from edge.estimator.given_size import TargetSize
from edge.pictures import Rate
from sim_replay.daemon_config import sequence_config
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.ground_truth import read_sequence

ODD = 'Müller\'s "\U0001f6e9" \\new'


def test_the_daemon_reads_what_was_asked_for(tmp_path: Path) -> None:
    bundled = read_sequence(BUNDLED_SEQUENCE)
    folder = tmp_path / ODD
    sequence = replace(bundled, scene=replace(bundled.scene, folder=folder))
    sequence = replace(sequence, readout_ms=-21.5, own_ship_mask=folder / "own.png")
    path = tmp_path / "config.toml"
    camera = {"start_at_ns": 12, "loop": True}
    asked = (sequence, folder / "a.onnx", "tcp/127.0.0.1:7001", 14001, camera)
    path.write_text(sequence_config(*asked, target_size=TargetSize(11.0, 8.3)), encoding="utf-8")
    config = load_config(path).config
    assert isinstance(config.camera, SequenceCamera)
    assert (config.camera.path, config.camera.fps, config.camera.readout_ms) == (folder, sequence.fps, -21.5)
    assert config.camera.own_ship_mask == folder / "own.png"
    assert (config.camera.start_at_ns, config.camera.loop) == (12, True)
    assert config.model.path == folder / "a.onnx"
    assert (config.target.wingspan_m, config.target.length_m) == (11.0, 8.3)
    assert (config.vehicle.name, config.zenoh.listen) == ("uav1", ["tcp/127.0.0.1:7001"])
    assert config.mavlink.endpoints == ["udpin:127.0.0.1:14001"]
    np.testing.assert_allclose(config.mount.mount().R_body_cam, sequence.mount.R_body_cam, atol=1e-9)
    np.testing.assert_allclose(config.mount.mount().t_body_cam_m, sequence.mount.t_body_cam_m)


@pytest.mark.parametrize("fps", [10.0, 15.0, 24.0, 30.0, 60.0, 120.0])
def test_every_image_of_a_sequence_is_recorded(fps: float, tmp_path: Path) -> None:
    sequence, path = replace(read_sequence(BUNDLED_SEQUENCE), fps=fps), tmp_path / "config.toml"
    path.write_text(sequence_config(sequence, None, "tcp/127.0.0.1:7001", 14001, {}, tmp_path))
    limit = Rate(load_config(path).config.recorder.image_max_hz)
    assert all(limit.due(round(frame * 1e9 / fps)) for frame in range(300))
