"""Norms folded while training: the values and gradients of evaluation mode, and nothing left behind."""

from __future__ import annotations

import contextlib

import pytest
import synthetic_sampler
import tiny
import torch
from test_backbones import settle_norms
from torch import nn

from trainer.backbones import build_backbone
from trainer.config import parse_config
from trainer.data import training_batch
from trainer.fixed_norms import folded_norms
from trainer.trainer import Trainer


def norm_statistics(model: nn.Module) -> list[torch.Tensor]:
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    return [s.clone() for m in norms for s in (m.running_mean, m.running_var) if s is not None]


@pytest.mark.parametrize("name", ["efficientnet_lite0", "repvit_small", "repvit_m0_9"])
def test_values_and_gradients_are_those_of_evaluation_mode(name: str) -> None:
    torch.manual_seed(0)
    model = build_backbone(name, pretrained=False).double()
    settle_norms(model)
    image = torch.randn(2, 3, 64, 96, dtype=torch.double)

    parameters = list(model.parameters())

    def features_and_gradients() -> list[torch.Tensor]:
        features = model(image)
        return [*features, *torch.autograd.grad(sum(f.pow(2).mean() for f in features), parameters)]

    model.train()
    with folded_norms(model):
        folded = features_and_gradients()
    model.eval()
    for got, expected in zip(folded, features_and_gradients(), strict=True):
        torch.testing.assert_close(got, expected)


def test_all_is_as_it_was_afterwards_even_after_a_forward_that_failed() -> None:
    network = tiny.network()
    settle_norms(network)
    image, _ = tiny.batch()
    parameters = list(network.named_parameters())
    with torch.no_grad():
        before = network.eval().perceive(image).F_global
        with folded_norms(network.train()), contextlib.suppress(RuntimeError):
            network.backbone(torch.zeros(1, 7, 64, 64))
        after = network.eval().perceive(image).F_global
        trained = network.train().perceive(image).F_global
    assert torch.equal(before, after)
    assert not torch.equal(before, trained), "norms over a batch's own statistics came back too"
    assert [(name, id(p)) for name, p in network.named_parameters()] == [(name, id(p)) for name, p in parameters]


@pytest.mark.parametrize("progress", [0.1, 0.9])
def test_a_step_moves_weights_and_no_statistics(progress: float) -> None:
    text = tiny.TOML.replace("warmup_samples = 8", "warmup_samples = 8\nrounded_from = 0.5\nfixed_norms = true")
    batch = training_batch(synthetic_sampler.PlateSampler(1, 64).batch(0, 4))
    trainer = Trainer(parse_config(text, "tiny.toml"), torch.device("cpu"))
    settle_norms(trainer.model)
    statistics = norm_statistics(trainer.model)
    start = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    trainer.step(batch, progress)
    for before, after in zip(statistics, norm_statistics(trainer.model), strict=True):
        assert torch.equal(before, after)
    for name in ("neck.fuse.0.weight", "neck.fuse.1.weight", "neck.fuse.1.bias", "dts.convs.0.0.weight"):
        assert not torch.equal(trainer.model.get_parameter(name), start[name]), name
