"""Peak and box with which each training window is decoded: the true ones at first, later the network's own."""

from __future__ import annotations

import torch
from torch import Tensor

from trainer import equations as eq
from trainer.losses import SMALLEST_SIZE_PX, Labels, center_cell


def guided_peaks(
    heat_logits: Tensor, labels: Labels, teacher: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Peaks (cells [N, 1, 2]) and box sizes ([N, 1, 2] px, 0: use the predicted one) to decode the images with.

    With probability `teacher` the true centre's cell, sometimes off by one, and the true box, jittered; otherwise the
    highest heatmap cell near the true centre, and the predicted box.
    """
    count, rows, columns = heat_logits.shape
    cell = center_cell(labels.center_px, rows, columns)
    draw = torch.rand((count, 5), generator=generator).to(heat_logits.device)
    step = torch.where(draw[:, :2] < 0.15, -1.0, torch.where(draw[:, :2] > 0.85, 1.0, 0.0))
    limit = torch.tensor([columns - 1.0, rows - 1.0], device=heat_logits.device)
    jittered = torch.minimum(torch.clamp(cell + step, min=0.0), limit)

    reach = torch.clamp(labels.size_px / (4 * eq.STRIDE), min=1.0)
    x, y = torch.arange(columns, device=cell.device), torch.arange(rows, device=cell.device)
    near_x = (x - cell[:, :1]).abs() <= reach[:, :1]
    near_y = (y - cell[:, 1:]).abs() <= reach[:, 1:]
    near = near_y[:, :, None] & near_x[:, None, :]
    best = heat_logits.detach().masked_fill(~near, -torch.inf).flatten(1).argmax(1)
    highest = torch.stack([best % columns, best // columns], dim=-1).to(cell.dtype)

    taught = (draw[:, 4] < teacher)[:, None]
    noise = torch.exp(0.3 * (draw[:, 2:4] - 0.5))
    size = torch.clamp(labels.size_px, min=SMALLEST_SIZE_PX) * noise
    peaks = torch.where(taught, jittered, highest)
    return peaks[:, None], torch.where(taught, size, torch.zeros_like(size))[:, None]
