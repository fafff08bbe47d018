"""Quantisation-aware training: convolutions with INT8 rounding and straight-through gradients.

The grid is that of export (trainer.graph): S8 weights per channel, and U8 inputs over the range of the batch. Folding a
norm into the convolution before it scales each channel's weights uniformly, so it does not change their rounding.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

# The submodules that trainer.graph quantises, except the refinement head, which not every network has.
ROUNDED_PARTS = ("backbone", "neck", "head_hm.0", "dts.convs")
IMAGE_CHANNELS = 3
_SMALLEST_SCALE = 1e-8


def rounded_weights(weight: Tensor) -> Tensor:
    """Weights [O, ...] on the symmetric S8 grid of each output channel; the gradient is that of `weight`."""
    largest = weight.detach().abs().amax(tuple(range(1, weight.ndim)), keepdim=True)
    return _Rounded.apply(weight, (largest / 127).clamp(min=_SMALLEST_SCALE))


class _Rounded(torch.autograd.Function):
    """Rounds to multiples of a scale that lie within the tensor's range: none is clipped, so gradients pass unchanged.

    PyTorch's own fake quantisation reads its zero points on the processor, for which a GPU waits.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, scale: Tensor) -> Tensor:
        return (x * (1.0 / scale)).round_().mul_(scale)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0], None


def rounded_activations(x: Tensor) -> Tensor:
    """A tensor on the U8 grid that spans its values and zero; the gradient is that of `x`."""
    low, high = torch.aminmax(x.detach())
    scale = ((high.float().clamp(min=0.0) - low.float().clamp(max=0.0)) / 255).clamp(min=_SMALLEST_SCALE)
    # 0 .. 255 steps are exact in bfloat16 too, and zero is a grid point.
    return _Rounded.apply(x, scale)


@contextlib.contextmanager
def rounded(model: nn.Module) -> Iterator[None]:
    """In this context, the convolutions of ROUNDED_PARTS compute with rounded weights and inputs.

    The first convolution's input is not rounded, as the image's bytes are integers already.
    """
    parts = (model.get_submodule(name) for name in ROUNDED_PARTS)
    convolutions = [module for part in parts for module in part.modules() if isinstance(module, nn.Conv2d)]
    floats: dict[nn.Module, nn.Parameter] = {}

    def put_rounded(conv: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...] | None:
        weight = conv._parameters["weight"]
        assert weight is not None
        floats[conv] = weight
        # Replaced in `_parameters`, which keeps the order of parameters.
        conv._parameters["weight"] = rounded_weights(weight)  # type: ignore[assignment]
        return None if conv.in_channels == IMAGE_CHANNELS else (rounded_activations(inputs[0]),)

    def put_back(conv: nn.Module, *_: object) -> None:
        conv._parameters["weight"] = floats.pop(conv)

    handles = [conv.register_forward_pre_hook(put_rounded) for conv in convolutions]
    handles += [conv.register_forward_hook(put_back, always_call=True) for conv in convolutions]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
