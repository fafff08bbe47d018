"""Training that sees INT8's rounding: the same grid as the exported file's, and nothing left behind."""

from __future__ import annotations

import contextlib

import numpy as np
import synthetic_sampler
import tiny
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trainer.config import parse_config
from trainer.data import training_batch
from trainer.rounding import rounded, rounded_activations, rounded_weights
from trainer.trainer import Trainer

finite = st.floats(-50, 50, width=32)


@given(arrays(np.float32, (3, 2, 3, 3), elements=finite))
def test_weights_lie_on_255_levels_of_their_channel_half_a_step_away(values: np.ndarray) -> None:
    weight = torch.from_numpy(values)
    got = rounded_weights(weight)
    step = weight.flatten(1).abs().amax(1)[:, None, None, None] / 127
    assert torch.all((got - weight).abs() <= 0.501 * step + 1e-6)
    for channel, s in zip(got, step.flatten(), strict=True):
        levels = channel / s if s > 1e-6 else channel * 0
        torch.testing.assert_close(levels, levels.round(), atol=1e-3, rtol=0)


@given(arrays(np.float32, (2, 3, 4, 4), elements=finite))
def test_activations_lie_on_256_levels_and_zero_is_one_of_them(values: np.ndarray) -> None:
    x = torch.from_numpy(values)
    got = rounded_activations(x)
    step = (max(x.max().item(), 0.0) - min(x.min().item(), 0.0)) / 255
    assert torch.all((got - x).abs() <= 1.01 * step + 1e-6)
    assert len(torch.unique(got)) <= 256
    assert rounded_activations(torch.cat([x.flatten(), torch.zeros(1)]))[-1] == 0


def test_gradients_pass_the_rounding_by() -> None:
    weight = torch.randn(4, 3, 3, 3, requires_grad=True)
    x = torch.randn(2, 3, 8, 8, requires_grad=True)
    (rounded_weights(weight).sum() + rounded_activations(x).sum()).backward()
    torch.testing.assert_close(weight.grad, torch.ones_like(weight))
    torch.testing.assert_close(x.grad, torch.ones_like(x))


def test_a_network_computes_otherwise_while_it_lasts_and_as_before_afterwards() -> None:
    network = tiny.network().eval()
    image, _ = tiny.batch()
    names = [name for name, _ in network.named_parameters()]
    with torch.no_grad():
        before = network.perceive(image).F_global
        with rounded(network):
            during = network.perceive(image).F_global
        after = network.perceive(image).F_global
    assert torch.equal(before, after)
    assert not torch.equal(before, during)
    torch.testing.assert_close(during, before, atol=0.1 * before.abs().max().item(), rtol=0)
    assert [name for name, _ in network.named_parameters()] == names


def test_weights_come_back_after_a_forward_that_failed() -> None:
    network = tiny.network()
    names = [name for name, _ in network.named_parameters()]
    with rounded(network), contextlib.suppress(RuntimeError):
        network.backbone(torch.zeros(1, 7, 64, 64))
    assert [name for name, _ in network.named_parameters()] == names
    assert all(
        isinstance(p, torch.nn.Parameter) for m in network.modules() for p in m._parameters.values() if p is not None
    )


def test_a_step_of_rounded_training_moves_float_weights() -> None:
    text = tiny.TOML.replace("warmup_samples = 8", "warmup_samples = 8\nrounded_from = 0.5")
    batch = training_batch(synthetic_sampler.PlateSampler(1, 64).batch(0, 4))
    losses = []
    for progress in (0.49, 0.5):
        trainer = Trainer(parse_config(text, "tiny.toml"), torch.device("cpu"))
        start = trainer.model.neck.state_dict()["fuse.0.weight"].clone()
        losses.append(trainer.step(batch, progress).loss)
        moved = trainer.model.neck.state_dict()["fuse.0.weight"]
        assert not torch.equal(moved, start)
        assert len(torch.unique(moved)) > 1000
    assert losses[0] != losses[1]
