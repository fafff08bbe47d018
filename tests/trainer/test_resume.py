"""A stopped and resumed run is the unbroken run, bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest
import synthetic_sampler
import torch

from trainer.config import ConfigError, parse_config
from trainer.train import Trainer, run_training

TINY = """
[model]
configuration = "edge"
backbone = "repvit_small"
pretrained = false
channels = 16
hidden = 32
soft_argmax_sigma_cells = 1.0
box_anchor_px = 32.0
origin_range = 0.5
focal = "geometric"
depth = "rotation_aware"
uncertainty = true
dense = true
[loss]
heatmap = 1.0
mask = 1.0
noc = 1.0
uncertainty = 0.1
[data]
seed = 3
validation_seed = 4
batch_size = 4
validation_samples = 16
[schedule]
samples = 16
warmup_samples = 8
sizes = [{ from_progress = 0.0, size_px = 64 }, { from_progress = 0.7, size_px = 96 }]
[run]
threads = 1
log_every_steps = 1
[contract]
name = "tiny"
acquire_size_wh = [128, 96]
acquire_fit = "letterbox"
track_size_wh = [64, 64]
track_window_scale = 2.0
"""


def train(out: Path, steps: int | None, resume: bool = False) -> Trainer:
    config = parse_config(TINY, "tiny.toml")
    return run_training(config, TINY, out, resume=resume, max_steps=steps, open_sampler=synthetic_sampler.opener)


def test_two_and_two_steps_equal_four(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", None)
    train(tmp_path / "parts", 2)
    parts = train(tmp_path / "parts", None, resume=True)
    assert whole.steps == parts.steps == 4
    assert whole.samples == parts.samples == 16
    for ours, theirs in ((whole.model, parts.model), (whole.average, parts.average)):
        for (name, a), b in zip(ours.state_dict().items(), theirs.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
    lines = (tmp_path / "parts" / "log.jsonl").read_text().splitlines()
    assert len([line for line in lines if '"train"' in line]) == 4


def test_a_run_is_not_overwritten_and_another_config_is_refused(tmp_path: Path) -> None:
    train(tmp_path / "run", 1)
    with pytest.raises(ConfigError, match="--resume"):
        train(tmp_path / "run", 1)
    other = TINY.replace("mask = 1.0", "mask = 2.0")
    config = parse_config(other, "other.toml")
    with pytest.raises(ConfigError, match=r"resume\.pt: \[loss\] differs"):
        run_training(config, other, tmp_path / "run", resume=True, open_sampler=synthetic_sampler.opener)
