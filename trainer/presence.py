"""The presence head: whether a peak is an aircraft, from all that the network sees there.

The heatmap's own head sees three cells around a peak. This one sees the whole box, the decoders' features and what they
make of them. Its inputs are detached: `trainer.refine` trains it alone, after the network. Several, trained on
different things, each know something: their mean keeps most of it (docs/ablation.md#beside).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trainer.layers import BoxReader, mlp
from trainer.refinement import Evidence, answer_count

# A peak's score in float32 is not exact enough to tell its odds beyond these.
SCORE_MARGIN = 1e-6


class PresenceHead(BoxReader):
    """Evidence and heatmap scores [P] to scores [P]: probabilities if targets are as frequent as in its training."""

    def __init__(self, channels: int, hidden: int, hypotheses: int, beside: int = 0) -> None:
        """`beside`: how many more there are of its kind."""
        super().__init__(channels, hidden // 8, 2 * hidden + answer_count(hypotheses))
        self.decide = nn.Sequential(mlp(self.width, hidden, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, 1))
        self.gain = nn.Parameter(torch.ones(1))
        self.beside = nn.ModuleList(PresenceHead(channels, hidden, hypotheses) for _ in range(beside))

    def logits(self, evidence: Evidence, score: Tensor) -> Tensor:
        """Log-odds [P] of a target: the mean of its own and of those beside it."""
        of_each = [self._own_logits(evidence, score)]
        for other in self.beside:
            assert isinstance(other, PresenceHead)
            of_each.append(other.logits(evidence, score))
        return torch.stack(of_each).mean(dim=0) if self.beside else of_each[0]

    def _own_logits(self, evidence: Evidence, score: Tensor) -> Tensor:
        read = self.read(evidence.grid, evidence.f_trans, evidence.f_rot, evidence.answers)
        return self.gain * torch.logit(score, eps=SCORE_MARGIN) + self.decide(read)[:, 0]

    def forward(self, evidence: Evidence, score: Tensor) -> Tensor:
        return torch.sigmoid(self.logits(evidence, score))
