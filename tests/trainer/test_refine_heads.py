"""What the heads learn that `refine` trains, from evidence that is made up."""

from __future__ import annotations

import pytest
import torch

from trainer.choice import ChoiceHead, option_count
from trainer.presence import PresenceHead
from trainer.refine import Heads, Kept, fit
from trainer.refinement import Evidence, RefinementHead, answer_count

NO_ANGLES = torch.zeros(6000, 4)


def silent(_: str) -> None:
    pass


def made_up(count: int, strange: torch.Tensor, seed: int) -> Evidence:
    """Noise, with strangers in brighter channels."""
    generator = torch.Generator().manual_seed(seed)
    grid = torch.randn(count, 16, 7, 7, generator=generator)
    grid[:, 3:5] += 1.5 * strange[:, None, None, None]
    widths = (32, 32, answer_count(4), option_count(4))
    rest = (torch.randn(count, width, generator=generator) for width in widths)
    return Evidence(*(part.half() for part in (grid, *rest)))


def test_strangers_that_show_in_the_features_are_corrected_and_less_is_said_of_them() -> None:
    """Made up: known ones err by a Laplace law of scale 0.05; strangers, in brighter channels, 0.3 and 0.2 too far."""
    generator = torch.Generator().manual_seed(4)
    count = 6000
    strange = torch.rand(count, generator=generator) < 0.4
    scale = torch.where(strange, 0.3, 0.05)
    draw = torch.rand(count, 6, generator=generator) - 0.5
    residual = -scale[:, None] * draw.sign() * torch.log1p(-2 * draw.abs())
    residual[:, 2] += 0.2 * strange
    target = torch.rand(count, generator=generator) < 0.8
    residual[~target] = torch.nan
    kept = Kept(made_up(count, strange, 5), residual, strange, torch.full((count,), 0.5), target, NO_ANGLES[:count])
    torch.manual_seed(0)
    head = RefinementHead(16, 32, 4)
    fit(Heads(head, PresenceHead(16, 32, 4), None), kept, 5000, 12, silent)
    with torch.no_grad():
        refined = head(kept.rows(slice(5000, None)).evidence)
    held_out = strange[5000:]
    scale_of = torch.exp(refined.log_sigma[:, 2])
    assert scale_of[~held_out].median().item() == pytest.approx(0.05, rel=0.25)
    assert scale_of[held_out].median().item() == pytest.approx(0.3, rel=0.25)
    assert refined.correction[held_out].median().item() == pytest.approx(-0.2, abs=0.05)
    assert refined.correction[~held_out].abs().median().item() < 0.02


def test_what_shows_in_the_features_and_what_the_heatmap_says_are_both_heard() -> None:
    """Made up: one in three is no target, and shows in brighter channels; the heatmap alone is right in two of three.

    What is said is a probability, and told of as what it is worth."""
    generator = torch.Generator().manual_seed(6)
    count = 6000
    target = torch.rand(count, generator=generator) < 2 / 3
    right = torch.rand(count, generator=generator) < 2 / 3
    score = torch.where(target == right, 0.8, 0.2) + 0.1 * torch.rand(count, generator=generator)
    kept = Kept(made_up(count, ~target, 7), torch.zeros(count, 6), target & False, score, target, NO_ANGLES[:count])
    torch.manual_seed(0)
    head, said = PresenceHead(16, 32, 4), list[str]()
    fit(Heads(None, head, None), kept, 5000, 4, said.append)
    held_out = kept.rows(slice(5000, None))
    with torch.no_grad():
        told = head(held_out.evidence, held_out.score)
        of_no_evidence = head(held_out.evidence, torch.full_like(held_out.score, 0.5))
    assert told[held_out.target].median() > 0.9
    assert told[~held_out.target].median() < 0.1
    assert told.mean().item() == pytest.approx(2 / 3, abs=0.04)
    moved = told - of_no_evidence
    assert moved[held_out.score > 0.6].mean() > 0.0 > moved[held_out.score < 0.4].mean()
    limit = torch.quantile(told[held_out.target], 0.05)
    after = (told[~held_out.target] > limit).float().mean().item()
    assert said[-1].endswith(f"{after:.2%} after")
    assert after < 0.3


def test_batches_without_targets_spoil_no_head() -> None:
    """Six targets in two thousand peaks: most batches have none or one."""
    count = 2000
    target = torch.arange(count) % 400 == 7
    target[8] = True
    score = torch.full((count,), 0.5)
    kept = Kept(made_up(count, target, 8), torch.zeros(count, 6), target & False, score, target, NO_ANGLES[:count])
    heads = Heads(RefinementHead(16, 32, 4), PresenceHead(16, 32, 4), ChoiceHead(16, 32, 4))
    torch.manual_seed(0)
    for rows in (kept.rows(slice(100, 300)), kept.rows(slice(300, 500)), kept.rows(slice(0, 100))):
        loss = heads.loss(rows)
        loss.backward()
        assert loss.isfinite()
    for head in heads:
        assert head is not None
        assert all(weight.grad is None or weight.grad.isfinite().all() for weight in head.parameters())
    fit(heads, kept, 1900, 1, silent)
    assert all(value.isfinite().all() for head in heads if head is not None for value in head.state_dict().values())
