"""The last rendered windows, kept on the training device to be trained on again: mirrored, and in other light.

A GPU trains on several times as many windows as the processors beside it render.
"""

from __future__ import annotations

import torch
from torch import Tensor

from trainer.config import ConfigError
from trainer.losses import Labels

# Standard deviations of the logarithms of brightness and of tint, and the most noise, in grey levels.
LIGHT, TINT, NOISE_MAX = 0.15, 0.04, 4.0
_AS_HALF = ("coverage", "noc")


class Replay:
    """The last `capacity` windows, on the device of the first that is added."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._image: Tensor | None = None
        self._labels: Labels | None = None
        self._added = 0

    def add(self, image: Tensor, labels: Labels) -> None:
        """Keep images [N, H, W, 3] uint8 and their labels in place of the oldest; forget all of another size.

        Raises ConfigError if there is not enough memory for `capacity` of them.
        """
        if self._image is None or self._image.shape[1:] != image.shape[1:]:
            self._make_room(image, labels)
        assert self._image is not None
        assert self._labels is not None
        rows = (self._added + torch.arange(len(image), device=image.device)) % self.capacity
        self._image[rows] = image
        for kept, value in zip(self._labels, labels, strict=True):
            kept[rows] = value.to(kept.dtype)
        self._added += len(image)

    def _make_room(self, image: Tensor, labels: Labels) -> None:
        room = lambda value, dtype: value.new_empty((self.capacity, *value.shape[1:]), dtype=dtype)  # noqa: E731
        halves = {name: torch.float16 for name in _AS_HALF}
        self._image = self._labels = None  # frees the memory of another size
        self._added = 0
        try:
            self._image = room(image, image.dtype)
            self._labels = Labels(*(room(v, halves.get(n, v.dtype)) for n, v in labels._asdict().items()))
        except RuntimeError:  # PyTorch's out of memory, on any device
            raise ConfigError(
                f"[data] replay_windows: {self.capacity} windows do not fit in the memory of {image.device}; give fewer"
            ) from None

    def drawn(self, count: int, generator: torch.Generator) -> tuple[Tensor, Labels]:
        """So many of the windows with their labels, half of them mirrored, all in other light."""
        assert self._image is not None
        assert self._labels is not None
        device = self._image.device
        rows = torch.randint(min(self._added, self.capacity), (count,), generator=generator).to(device)
        turned = (torch.rand(count, generator=generator) < 0.5).to(device)
        image, labels = self._image[rows], Labels(*(value[rows] for value in self._labels))
        labels = labels._replace(**{name: getattr(labels, name).float() for name in _AS_HALF})
        other_image, other = mirrored(image, labels)
        chosen = [torch.where(turned.view(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(labels, other, strict=True)]
        return relit(torch.where(turned[:, None, None, None], other_image, image), generator), Labels(*chosen)


def mirrored(image: Tensor, labels: Labels) -> tuple[Tensor, Labels]:
    """Images [N, H, W, 3] with left and right exchanged, and the labels of what they then show.

    Aircraft are taken to be symmetric about their xz plane: a mirrored port wing is a starboard wing, and the body axes
    remain right-handed.
    """
    last_px = image.shape[2] - 1
    across_cam = torch.tensor([-1.0, 1.0, 1.0], device=image.device)
    across_body = torch.tensor([1.0, -1.0, 1.0], device=image.device)
    K, center_px = labels.K.clone(), labels.center_px.clone()
    K[:, 0, 2], center_px[:, 0] = last_px - K[:, 0, 2], last_px - center_px[:, 0]
    return image.flip(2), labels._replace(
        K=K,
        R_cam_target=across_cam[:, None] * labels.R_cam_target * across_body,
        t_cam_target_m=across_cam * labels.t_cam_target_m,
        center_px=center_px,
        coverage=labels.coverage.flip(2),
        noc=across_body[:, None, None] * labels.noc.flip(3),
        others=labels.others.flip(2),
    )


def relit(image: Tensor, generator: torch.Generator) -> Tensor:
    """Images [N, H, W, 3] uint8 brighter or darker, tinted, and with more noise."""
    count, device = len(image), image.device
    normal = torch.randn((count, 4), generator=generator)
    gain = torch.exp(LIGHT * normal[:, :1] + TINT * normal[:, 1:]).to(device)
    sigma = NOISE_MAX * torch.rand(count, generator=generator).to(device)
    noise = torch.randn(image.shape, device=device, dtype=torch.bfloat16) * sigma[:, None, None, None]
    return (image * gain[:, None, None] + noise).round_().clamp_(0, 255).to(torch.uint8)
