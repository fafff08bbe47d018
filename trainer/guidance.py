"""Peak and box with which each training window is decoded: the true ones at first, later the network's own."""

from __future__ import annotations

import torch
from torch import Tensor

from trainer import equations as eq
from trainer.losses import SMALLEST_SIZE_PX, Labels, center_cell


def drawn_guide(count: int, teacher: float, generator: torch.Generator) -> Tensor:
    """Numbers [count, 5] for `guided_peaks`, on the processor: steps in x and y, log scales of the box's sides, and 1
    in a share `teacher` of the images, which are to be guided by the truth, 0 in others."""
    draw = torch.rand((count, 5), generator=generator)
    draw[:, 4] = (draw[:, 4] < teacher).float()
    draw[:, 2:4] = 0.3 * (draw[:, 2:4] - 0.5)
    draw[:, :2] = (draw[:, :2] > 0.85).float() - (draw[:, :2] < 0.15).float()
    return draw


def guided_peaks(heat_logits: Tensor, labels: Labels, guide: Tensor) -> tuple[Tensor, Tensor]:
    """Peaks (cells [N, 1, 2]) and box sizes ([N, 1, 2] px, 0: use the predicted one) to decode the images with.

    By the truth: the true centre's cell, sometimes off by one, and the true box, jittered; otherwise the highest
    heatmap cell near the true centre, and the predicted box.
    """
    rows, columns = heat_logits.shape[1:]
    cell = center_cell(labels.center_px, rows, columns)
    limit = eq.constant((columns - 1.0, rows - 1.0), cell)
    jittered = torch.minimum(torch.clamp(cell + guide[:, :2], min=0.0), limit)

    reach = torch.clamp(labels.size_px / (4 * eq.STRIDE), min=1.0)
    x, y = torch.arange(columns, device=cell.device), torch.arange(rows, device=cell.device)
    near_x = (x - cell[:, :1]).abs() <= reach[:, :1]
    near_y = (y - cell[:, 1:]).abs() <= reach[:, 1:]
    near = near_y[:, :, None] & near_x[:, None, :]
    best = heat_logits.detach().masked_fill(~near, -torch.inf).flatten(1).argmax(1)
    highest = torch.stack([best % columns, best // columns], dim=-1).to(cell.dtype)

    taught = guide[:, 4:] > 0
    size = torch.clamp(labels.size_px, min=SMALLEST_SIZE_PX) * torch.exp(guide[:, 2:4])
    peaks = torch.where(taught, jittered, highest)
    return peaks[:, None], torch.where(taught, size, torch.zeros_like(size))[:, None]
