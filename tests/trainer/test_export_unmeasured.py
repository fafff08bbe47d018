"""Files for timing: the network of a configuration or checkpoint, in seconds, that nobody flies by mistake."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import tiny

from edge.estimator.decode import Shown, decode
from edge.estimator.model import Peaks
from edge.estimator.window import PixelMap
from msgs.contract import OUTPUT_NAMES
from trainer.checkpoint import save_weights
from trainer.cli import main
from trainer.export import export_unmeasured
from trainer.graph import open_session, read_contract


def export(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "trainer.cli", "export", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(tiny.TOML)
    return path


@pytest.mark.parametrize("source", ["--untrained", "--checkpoint"])
def test_a_network_is_written_to_be_timed_and_not_flown(tmp_path: Path, config: Path, source: str) -> None:
    arguments = ["--untrained", config]
    if source == "--checkpoint":
        save_weights(tmp_path / "run" / "weights.pt", tiny.network(), tiny.TOML, {"seed": 3, "samples": 9})
        arguments = ["--checkpoint", tmp_path / "run", "--unmeasured"]
    done = export(*arguments, "--out", tmp_path / "models")
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "models").iterdir()
    assert path.name == "tiny-unmeasured-fp32.onnx"
    contract = read_contract(path)
    assert contract.metrics == {}
    assert contract.training["samples"] == (0 if source == "--untrained" else 9)
    image = np.random.default_rng(1).integers(0, 255, (1, 64, 64, 3), dtype=np.uint8)
    K = np.array([[[900.0, 0, 32], [0, 900, 32], [0, 0, 1]]], np.float32)
    outputs = dict(zip(OUTPUT_NAMES, open_session(path).run(None, {"image": image, "K": K}), strict=True))
    assert outputs["t_cam_target_m"].shape == (1, contract.max_peaks, 3)
    assert (outputs["score"] < min(contract.acquire_score_min, contract.track_score_min)).all()


def test_targets_of_a_file_that_nobody_measured_are_of_no_untrained_size(tmp_path: Path, config: Path) -> None:
    """A checkpoint is evaluated through such a file: its estimates are told as the network has them."""
    contract = read_contract(export_unmeasured(config, tmp_path, untrained=True))
    size_wh = (640, 480)
    K = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    shown = Shown(PixelMap((1.0, 1.0), (0.0, 0.0)), K, size_wh, size_wh)
    center, sigma = np.array([[[300.0, 200.0]]], np.float32), np.full((1, 1, 6), 0.05, np.float32)
    for size_px in (9.0, 300.0):
        peaks = Peaks(
            score=np.ones((1, 1), np.float32),
            center_px=center,
            size_px=np.full((1, 1, 2), size_px, np.float32),
            origin_px=center,
            t_cam_target_m=np.array([[[0.0, 0.0, 300.0]]], np.float32),
            R_cam_target=np.eye(3, dtype=np.float32)[None, None],
            sigma=sigma,
        )
        (estimate,) = decode(peaks, 0, shown, contract, "track", 0.5, Counter())
        assert np.sqrt(estimate.covariance[2, 2]) == pytest.approx(0.05 * 300.0, rel=1e-3)


def test_a_configuration_that_is_wrong_is_named(
    tmp_path: Path, config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config.write_text(tiny.TOML.replace('backbone = "repvit_small"', 'backbone = "vgg"'))
    assert main(["export", "--untrained", str(config), "--out", str(tmp_path / "models")]) == 2
    said = capsys.readouterr().err
    assert "tiny.toml" in said
    assert "backbone" in said
