"""The first convolution, with three input channels and a fast weight gradient on a CPU.

For this gradient oneDNN is about thirty times slower in the channels-last layout, which is faster for everything else,
than in channels-first: it took a quarter of a training step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class _ImageConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride = stride
        return F.conv2d(x, weight.to(x.dtype), None if bias is None else bias.to(x.dtype), stride)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, Tensor | None, None]:
        x, weight = ctx.saved_tensors
        gradient_bias = gradients[0].sum((0, 2, 3)).to(weight.dtype) if ctx.needs_input_grad[2] else None
        g, x, like = (a.contiguous(memory_format=torch.contiguous_format) for a in (gradients[0], x, weight))
        stride, wanted = [ctx.stride, ctx.stride], [False, True, False]
        dims = (g, x, like.to(g.dtype), None, stride, [0, 0], [1, 1], False, [0, 0], 1, wanted)
        return None, torch.ops.aten.convolution_backward(*dims)[1].to(weight.dtype), gradient_bias, None


class ImageConv2d(nn.Conv2d):
    """nn.Conv2d without bias or padding for images, which need no gradient: same parameters, values and export."""

    def __init__(self, channels: int, kernel: int, stride: int) -> None:
        super().__init__(3, channels, kernel, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type == "cpu" and torch.is_grad_enabled() and self.weight.requires_grad:
            x = x.to(torch.get_autocast_dtype("cpu")) if torch.is_autocast_enabled("cpu") else x
            return _ImageConvolution.apply(x, self.weight, self.bias, self.stride[0])
        return super().forward(x)
