"""Training with fixed norm statistics: each norm is folded into the convolution before it, as in the exported graph.

Batch norm with batch statistics reads and writes every feature map several times, a quarter of a training step on a
CPU. Weights that are already trained need no new statistics.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import pairwise

import torch
from torch import Tensor, nn


def _pairs(model: nn.Module) -> list[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Convolutions without bias, each with the norm that its parent declares, and therefore applies, right after it."""
    return [
        (conv, norm)
        for parent in model.modules()
        for conv, norm in pairwise(parent.children())
        if isinstance(conv, nn.Conv2d) and conv.bias is None and isinstance(norm, nn.BatchNorm2d)
    ]


def _same(input: Tensor) -> Tensor:
    return input


@contextlib.contextmanager
def folded_norms(model: nn.Module) -> Iterator[None]:
    """In this context, norm statistics are fixed, and norms after a convolution are folded into its weights and bias.

    Values are those of evaluation mode, and gradients reach the same parameters.
    """
    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d)]
    pairs = _pairs(model)
    weights = [conv._parameters["weight"] for conv, _ in pairs]
    for norm in norms:
        norm.eval()
    for conv, norm in pairs:
        assert norm.running_mean is not None
        assert norm.running_var is not None
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        # Replaced in `_parameters`, which keeps the order of parameters.
        conv._parameters["weight"] = conv.weight * scale[:, None, None, None]  # type: ignore[assignment]
        conv._parameters["bias"] = norm.bias - norm.running_mean * scale  # type: ignore[assignment]
        norm.forward = _same  # type: ignore[method-assign]
    try:
        yield
    finally:
        for (conv, norm), weight in zip(pairs, weights, strict=True):
            conv._parameters["weight"], conv._parameters["bias"] = weight, None
            del norm.forward
