"""The refinement head: predicts a correction of the range, and the uncertainty (sigma) of the whole pose.

It reads the decoders' features and outputs, detached: training the shared features for uncertainty as well made the
pose itself less accurate (docs/ablation.md).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trainer.layers import BoxReader, mlp

SIGMAS = 6  # origin u, v in box sides sqrt(w h), log Z, rotation x, y, z in `cam`, rad
RANGE = 2  # of these
LOG_SIGMA_RANGE = (-7.0, 1.5)
# Limits the correction when the inputs lie far outside the training distribution.
CORRECTION_MAX = 0.7


class Evidence(NamedTuple):
    """Inputs of the heads that `trainer.refine` trains, for P peaks."""

    grid: Tensor  # [P, C, 7, 7], F_global over the box
    f_trans: Tensor  # [P, hidden]
    f_rot: Tensor  # [P, hidden]
    answers: Tensor  # [P, answer_count(K)], see `answers_of`
    options: Tensor  # [P, option_count(K)], see `trainer.choice.options_of`


class Refined(NamedTuple):
    """The correction to add to log Z, and the Laplace scales of the corrected pose."""

    correction: Tensor  # [P]
    log_sigma: Tensor  # [P, 6], in SIGMAS' units


def answer_count(hypotheses: int) -> int:
    """Numbers per peak that `answers_of` returns."""
    return 2 + 1 + 1 + 1 + 2 + hypotheses + 9


def answers_of(
    log_size: Tensor, log_f: Tensor, log_Z: Tensor, plane_xy: Tensor, hypothesis_logits: Tensor, R_ego: Tensor
) -> Tensor:
    """The decoders' outputs, scaled to about one: log sizes [P, 2] px, their ratio, log focal length [P] px, log Z
    [P] m, ray [P, 2], probabilities of the hypotheses from logits [P, K], and rotation [P, 3, 3]."""
    ratio = log_size[:, :1] - log_size[:, 1:]
    scalars = [log_size - 3.5, ratio, log_f[:, None] - 7.0, log_Z[:, None] - 5.5, 5.0 * plane_xy]
    return torch.cat([*scalars, torch.softmax(hypothesis_logits, dim=-1), R_ego.flatten(1)], dim=-1)


class RefinementHead(BoxReader):
    """Evidence to Refined."""

    def __init__(self, channels: int, hidden: int, hypotheses: int) -> None:
        super().__init__(channels, hidden // 4, 2 * hidden + answer_count(hypotheses))
        self.decide = nn.Sequential(mlp(self.width, hidden, hidden), nn.ReLU(inplace=True))
        self.range = nn.Linear(hidden, 1)
        self.sigma = nn.Linear(hidden, SIGMAS)
        with torch.no_grad():
            self.range.weight.zero_()
            self.range.bias.zero_()

    def forward(self, evidence: Evidence) -> Refined:
        decided = self.decide(self.read(evidence.grid, evidence.f_trans, evidence.f_rot, evidence.answers))
        correction = torch.clamp(self.range(decided)[:, 0], -CORRECTION_MAX, CORRECTION_MAX)
        return Refined(correction, torch.clamp(self.sigma(decided) - 2.0, *LOG_SIGMA_RANGE))
