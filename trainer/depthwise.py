"""Depthwise convolution with fast gradients on a CPU.

oneDNN is fast for gradients of depthwise 3x3 convolutions of stride 1, and up to 200 times slower for others, which
then take more than half of a training step. Here they are reduced to the fast case: the gradient of stride s is that of
stride 1 with zeros inserted, and a 5x5 kernel's weight gradient consists of four overlapping 3x3 ones.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class _Depthwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, stride: int, padding: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride, ctx.padding = stride, padding
        return F.conv2d(x, weight, bias, stride, padding, groups=x.shape[1])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None, None]:
        x, weight = ctx.saved_tensors
        gradient_bias = gradients[0].sum((0, 2, 3)).to(weight.dtype) if ctx.needs_input_grad[2] else None
        g = _at_every_pixel(gradients[0], x, ctx.stride, weight.shape[-1] // 2 - ctx.padding)
        turned = weight.flip(2, 3).to(g.dtype)
        gradient_x = F.conv2d(g, turned, None, 1, weight.shape[-1] // 2, groups=x.shape[1])
        return gradient_x, _weight_gradient(g, weight, x.to(g.dtype)), gradient_bias, None, None


def _at_every_pixel(g: Tensor, x: Tensor, stride: int, first: int) -> Tensor:
    """The output gradient g of an equivalent stride-1 convolution that keeps the size of x: g at first, first + stride,
    ..., 0 elsewhere."""
    if stride == 1 and first == 0:
        return g.contiguous(memory_format=torch.channels_last)
    count, channels, rows, columns = x.shape
    dense = g.new_zeros(count, rows, columns, channels).permute(0, 3, 1, 2)
    stop_row, stop_column = first + g.shape[2] * stride, first + g.shape[3] * stride
    dense[:, :, first:stop_row:stride, first:stop_column:stride] = g
    return dense


def _weight_gradient(g: Tensor, weight: Tensor, x: Tensor) -> Tensor:
    """The sum over images and pixels of g times each tap's input, 3x3 taps at a time."""
    kernel, rows, columns = weight.shape[-1], g.shape[2] + 2, g.shape[3] + 2
    if kernel == 3:
        return _gradient_3x3(g, x, weight, padding=1)
    seen = F.pad(x, [kernel // 2] * 4)
    gradient = torch.empty_like(weight)
    for i in (0, kernel - 3):
        for j in (0, kernel - 3):
            part = seen[:, :, i : i + rows, j : j + columns].contiguous(memory_format=torch.channels_last)
            gradient[:, :, i : i + 3, j : j + 3] = _gradient_3x3(g, part, weight[..., :3, :3], padding=0)
    return gradient


def _gradient_3x3(g: Tensor, x: Tensor, weight: Tensor, padding: int) -> Tensor:
    """oneDNN's weight gradient of a depthwise 3x3 convolution of stride 1; only the shape of `weight` matters."""
    ones, pads = [1, 1], [padding, padding]
    dims = (g, x, weight.to(g.dtype), None, ones, pads, ones, False, [0, 0], weight.shape[0], [False, True, False])
    return torch.ops.aten.convolution_backward(*dims)[1].to(weight.dtype)


class DepthwiseConv2d(nn.Conv2d):
    """nn.Conv2d with groups = channels and a 3x3 or 5x5 kernel: same parameters, values and export."""

    def __init__(self, channels: int, kernel: int, stride: int, padding: int) -> None:
        super().__init__(channels, channels, kernel, stride, padding, groups=channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        slow = self.kernel_size != (3, 3) or self.stride != (1, 1)
        if slow and x.device.type == "cpu" and torch.is_grad_enabled() and self.weight.requires_grad:
            return _Depthwise.apply(x, self.weight, self.bias, self.stride[0], int(self.padding[0]))
        return super().forward(x)
