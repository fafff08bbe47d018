"""The quick depthwise gradients are the gradients."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from trainer.depthwise import DepthwiseConv2d


@pytest.mark.parametrize(("kernel", "stride", "padding"), [(5, 1, 2), (5, 2, 0), (3, 2, 0), (3, 2, 1), (3, 1, 1)])
@pytest.mark.parametrize("size", [11, 12])
def test_gradients_equal_autograd_of_the_plain_convolution(kernel: int, stride: int, padding: int, size: int) -> None:
    torch.manual_seed(kernel + stride)
    ours = DepthwiseConv2d(6, kernel, stride, padding).double()
    plain = nn.Conv2d(6, 6, kernel, stride, padding, groups=6, bias=False).double()
    plain.load_state_dict(ours.state_dict())
    x = torch.randn(2, 6, size, size, dtype=torch.double)
    a, b = x.clone().requires_grad_(), x.clone().requires_grad_()
    y = ours(a)
    pull = torch.randn_like(y)
    y.backward(pull)
    plain(b).backward(pull)
    torch.testing.assert_close(a.grad, b.grad)
    torch.testing.assert_close(ours.weight.grad, plain.weight.grad)
