"""Neck: strides 8, 16 and 32 aligned at stride 8 and fused to F_global (paper: overall framework)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainer.layers import conv_bn_relu


class AlignFuseNeck(nn.Module):
    """Three feature maps to F_global [N, C, H/8, W/8]: 1x1 to C, bilinear to stride 8, concatenate, fuse."""

    def __init__(self, feature_channels: tuple[int, int, int], channels: int) -> None:
        super().__init__()
        self.align = nn.ModuleList(conv_bn_relu(inputs, channels, 1) for inputs in feature_channels)
        self.mix = conv_bn_relu(3 * channels, channels, 1)
        self.fuse = conv_bn_relu(channels, channels, 3)

    def forward(self, features: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        f8, f16, f32 = (align(feature) for align, feature in zip(self.align, features, strict=True))
        f16 = F.interpolate(f16, scale_factor=2.0, mode="bilinear", align_corners=False)
        f32 = F.interpolate(f32, scale_factor=4.0, mode="bilinear", align_corners=False)
        return self.fuse(self.mix(torch.cat([f8, f16, f32], dim=1)))
