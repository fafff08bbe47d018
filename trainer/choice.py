"""The choice head: which of the rotation hypotheses is likeliest, from all that the network sees of the target.

The network's own logits are a linear function of features that it shares with eight rotations. This head also sees the
whole box and the rotations themselves. Its inputs are detached: `trainer.refine` trains it alone, after the network.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainer.layers import BoxReader, mlp

# Scale of the Laplace distribution of angles about the right hypothesis, rad.
SPREAD_RAD = 0.1


def option_count(hypotheses: int) -> int:
    """Numbers per peak that `options_of` returns."""
    return 2 + 1 + 1 + 2 + 6 * hypotheses + hypotheses


def options_of(log_size: Tensor, log_f: Tensor, plane_xy: Tensor, r_6d: Tensor, logits: Tensor) -> Tensor:
    """What is to be chosen from, scaled to about one: log sizes [P, 2] px, their ratio, log focal length [P] px, ray
    [P, 2], every hypothesis [P, 6 K] as two columns of its rotation, and last the logarithms of their probabilities,
    from logits [P, K]."""
    ratio = log_size[:, :1] - log_size[:, 1:]
    scalars = [log_size - 3.5, ratio, log_f[:, None] - 7.0, 5.0 * plane_xy]
    return torch.cat([*scalars, r_6d, F.log_softmax(logits, dim=-1)], dim=-1)


class ChoiceHead(BoxReader):
    """Grid [P, C, 7, 7], f_trans and f_rot [P, hidden], and options to logits [P, K]."""

    def __init__(self, channels: int, hidden: int, hypotheses: int) -> None:
        super().__init__(channels, hidden // 8, 2 * hidden + option_count(hypotheses))
        self.hypotheses = hypotheses
        self.decide = nn.Sequential(mlp(self.width, hidden, hidden), nn.ReLU(inplace=True))
        # One layer of both: OpenVINO 2026.4 crashes on a sum of a layer's output and the logits times a learnt factor.
        self.choose = nn.Linear(hidden + hypotheses, hypotheses)
        self.lean(0.0)

    def forward(self, grid: Tensor, f_trans: Tensor, f_rot: Tensor, options: Tensor) -> Tensor:
        decided = self.decide(self.read(grid, f_trans, f_rot, options))
        return self.choose(torch.cat([decided, options[:, -self.hypotheses :].detach()], dim=-1))

    @torch.no_grad()
    def lean(self, share: float) -> None:
        """Return log-odds that are `share` of the way from the network's own to this head's, from now on."""
        self.choose.weight.mul_(share)
        self.choose.weight[:, -self.hypotheses :].diagonal().add_(1.0 - share)
        self.choose.bias.mul_(share)


def choice_nll(logits: Tensor, angle_rad: Tensor) -> Tensor:
    """Negative log-likelihood [N], up to a constant, of the true rotation under a mixture of the K hypotheses, from
    logits [N, K] and the angle [N, K] of each to the truth."""
    return -torch.logsumexp(F.log_softmax(logits, dim=-1) - angle_rad / SPREAD_RAD, dim=-1)
