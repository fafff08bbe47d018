"""A network small enough for tests, and its configuration as TOML."""

from __future__ import annotations

import torch

from trainer.config import TrainerConfig, parse_config
from trainer.data import training_batch
from trainer.losses import Labels, to_tensors
from trainer.model import PoseNet

TOML = """
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
hypotheses = 4
dense = true
[loss]
heatmap = 1.0
hypothesis = 1.0
center = 1.0
origin = 1.0
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


def config() -> TrainerConfig:
    return parse_config(TOML, "tiny.toml")


def network(seed: int = 0) -> PoseNet:
    torch.manual_seed(seed)
    return PoseNet(config().model)


def batch(count: int = 4, size_px: int = 64, seed: int = 5) -> tuple[torch.Tensor, Labels]:
    """Images and labels of the synthetic sampler."""
    from synthetic_sampler import PlateSampler

    return to_tensors(training_batch(PlateSampler(seed, size_px).batch(0, count)), torch.device("cpu"))
