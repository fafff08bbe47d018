"""The last look at a pose: what its range is to be corrected by, and how sure all of it is.

It reads all that the decoders had and answered, and teaches none of them: how well they know an aircraft is another
question than where it is, and a network that is taught both at once answers the second worse.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trainer.layers import conv_bn_relu, mlp

SIGMAS = 6  # origin u, v in box sides sqrt(w h), log Z, rotation x, y, z in `cam`, rad
RANGE = 2  # of these
LOG_SIGMA_RANGE = (-7.0, 1.5)
# What it reads of a picture like none before may be far off all that it learnt from; its correction shall not be.
CORRECTION_MAX = 0.7


class Evidence(NamedTuple):
    """What is known of P peaks before it."""

    grid: Tensor  # [P, C, 7, 7], F_global over the box
    f_trans: Tensor  # [P, hidden]
    f_rot: Tensor  # [P, hidden]
    answers: Tensor  # [P, answer_count(K)], see `answers_of`


class Refined(NamedTuple):
    """What is to be added to log Z, and the Laplace scales after that."""

    correction: Tensor  # [P]
    log_sigma: Tensor  # [P, 6], in SIGMAS' units


def answer_count(hypotheses: int) -> int:
    """How many numbers `answers_of` makes of a peak."""
    return 2 + 1 + 1 + 1 + 2 + hypotheses + 9


def answers_of(
    log_size: Tensor, log_f: Tensor, log_Z: Tensor, plane_xy: Tensor, hypothesis_logits: Tensor, R_ego: Tensor
) -> Tensor:
    """What the network answers, brought to about one: log sizes [P, 2] px, their ratio, log focal length [P] px, log Z
    [P] m, ray [P, 2], probabilities of the hypotheses from logits [P, K], and rotation [P, 3, 3]."""
    ratio = log_size[:, :1] - log_size[:, 1:]
    scalars = [log_size - 3.5, ratio, log_f[:, None] - 7.0, log_Z[:, None] - 5.5, 5.0 * plane_xy]
    return torch.cat([*scalars, torch.softmax(hypothesis_logits, dim=-1), R_ego.flatten(1)], dim=-1)


class RefinementHead(nn.Module):
    """Evidence to Refined."""

    def __init__(self, channels: int, hidden: int, hypotheses: int) -> None:
        super().__init__()
        narrow = hidden // 4
        self.convs = nn.Sequential(conv_bn_relu(channels, narrow, 3), conv_bn_relu(narrow, narrow, 3, stride=2))
        told = 2 * hidden + answer_count(hypotheses)
        self.norm = nn.BatchNorm1d(16 * narrow + told)
        # Only a fit by itself drops any: see trainer.refine.
        self.dropout = nn.Dropout(0.0)
        self.decide = nn.Sequential(mlp(16 * narrow + told, hidden, hidden), nn.ReLU(inplace=True))
        self.range = nn.Linear(hidden, 1)
        self.sigma = nn.Linear(hidden, SIGMAS)
        with torch.no_grad():
            self.range.weight.zero_()
            self.range.bias.zero_()

    def forward(self, evidence: Evidence) -> Refined:
        grid, *rest = (value.detach() for value in evidence)
        seen = self.dropout(self.norm(torch.cat([self.convs(grid).flatten(1), *rest], dim=-1)))
        decided = self.decide(seen)
        correction = torch.clamp(self.range(decided)[:, 0], -CORRECTION_MAX, CORRECTION_MAX)
        return Refined(correction, torch.clamp(self.sigma(decided) - 2.0, *LOG_SIGMA_RANGE))
