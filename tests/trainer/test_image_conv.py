"""The quick gradient of the first convolution is the gradient."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from trainer.image_conv import ImageConv2d


@pytest.mark.parametrize("size", [15, 16])
@pytest.mark.parametrize("layout", [torch.channels_last, torch.contiguous_format])
def test_weight_gradient_equals_autograd_of_the_plain_convolution(size: int, layout: torch.memory_format) -> None:
    torch.manual_seed(size)
    ours = ImageConv2d(8, 3, 2).double().to(memory_format=layout)  # type: ignore[call-overload]
    plain = nn.Conv2d(3, 8, 3, 2, bias=False).double()
    plain.load_state_dict(ours.state_dict())
    x = torch.randn(2, 3, size, size, dtype=torch.double).contiguous(memory_format=layout)
    y, expected = ours(x), plain(x)
    torch.testing.assert_close(y, expected)
    pull = torch.randn_like(y)
    y.backward(pull)
    expected.backward(pull)
    torch.testing.assert_close(ours.weight.grad, plain.weight.grad)
