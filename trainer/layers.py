"""Small layers that several parts of the network are made of."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def conv_bn_relu(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Convolution, batch norm, ReLU; padded to keep ceil(size / stride)."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a ReLU between."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, outputs))


class BoxReader(nn.Module):
    """Base of the heads that `trainer.refine` trains alone: convolutions over the 7x7 grid of features in the box, and
    what else is told of a peak, normalised. Their inputs are detached."""

    def __init__(self, channels: int, narrow: int, told: int) -> None:
        """`narrow`: channels of the convolutions; `told`: numbers beside the grid. `width` numbers are read."""
        super().__init__()
        self.width = 16 * narrow + told
        self.convs = nn.Sequential(conv_bn_relu(channels, narrow, 3), conv_bn_relu(narrow, narrow, 3, stride=2))
        self.norm = nn.BatchNorm1d(self.width)
        # Non-zero only while trainer.refine trains.
        self.dropout = nn.Dropout(0.0)

    def read(self, grid: Tensor, *told: Tensor) -> Tensor:
        """Grid [P, C, 7, 7] and the rest, each [P, n], to [P, width]."""
        rest = (value.detach() for value in told)
        return self.dropout(self.norm(torch.cat([self.convs(grid.detach()).flatten(1), *rest], dim=-1)))
