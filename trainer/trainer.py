"""`Trainer`: one optimiser step, and all the state that a checkpoint saves. `train.py` is the run around it."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from trainer import equations as eq
from trainer.checkpoint import weights_to_start_from
from trainer.config import ScheduleConfig, TrainerConfig
from trainer.data import TrainingBatch
from trainer.distributed import Group
from trainer.fixed_norms import folded_norms
from trainer.graphed import Graphed
from trainer.guidance import drawn_guide, guided_peaks
from trainer.losses import Labels, joint_loss, to_tensors
from trainer.model import Decoded, Perception, PoseNet
from trainer.replay import Replay
from trainer.rounding import rounded


def learning_rate(schedule: ScheduleConfig, samples_done: int, progress: float) -> float:
    """Linear warm-up over samples, then cosine from lr to lr_final over progress 0..1."""
    warmup = min(1.0, (samples_done + 1) / max(schedule.warmup_samples, 1))
    cosine = 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return warmup * (schedule.lr_final + (schedule.lr - schedule.lr_final) * cosine)


def size_at(schedule: ScheduleConfig, progress: float) -> int:
    """Side of the training windows at this progress, pixels."""
    return [stage.size_px for stage in schedule.sizes if stage.from_progress <= progress][-1]


class Diverged(ArithmeticError):
    """The gradient is not finite. The optimiser step was skipped, but norm statistics may be corrupted."""


class StepResult(NamedTuple):
    loss: float
    rotation_deg: float  # mean over the batch's targets; NaN without any
    depth_rel: float  # likewise
    terms: dict[str, float]


class Trainer:
    """Network, moving average, optimiser and counters of one run."""

    def __init__(self, config: TrainerConfig, device: torch.device, group: Group | None = None) -> None:
        torch.manual_seed(config.data.seed)
        self.config, self.device, self.group = config, device, group or Group()
        self.model = PoseNet(config.model).to(device)
        for part in (self.model.backbone, self.model.neck, self.model.head_hm):
            part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        frozen_blocks = config.schedule.frozen_blocks
        self.frozen = self.model.backbone.first_layers(frozen_blocks) if frozen_blocks else []
        for layer in self.frozen:
            layer.requires_grad_(False)
        self.average = copy.deepcopy(self.model).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(self._parameter_groups(), lr=config.schedule.lr, fused=True)
        self.passes = Graphed(self._passes, self.model) if device.type == "cuda" else self._passes
        self.replay = Replay(config.data.replay_windows) if config.data.replays else None
        self.steps = 0
        self.samples = 0
        self.samples_before: int | None = 0  # of the runs behind the initial weights; None: unknown
        self.started_from = "public ImageNet weights" if config.model.pretrained else "scratch"

    def _parameter_groups(self) -> list[dict[str, Any]]:
        """No weight decay for vectors (norms, biases); the backbone's learning rate is scaled."""
        schedule = self.config.schedule
        groups: dict[tuple[float, float], list[nn.Parameter]] = {}
        for name, parameter in self.model.named_parameters():
            if not parameter.requires_grad:
                continue
            scale = schedule.backbone_lr_scale if name.startswith("backbone.") else 1.0
            decay = schedule.weight_decay if parameter.ndim > 1 else 0.0
            groups.setdefault((scale, decay), []).append(parameter)
        return [{"params": p, "lr_scale": scale, "weight_decay": decay} for (scale, decay), p in groups.items()]

    def step(self, batch: TrainingBatch, progress: float) -> StepResult:
        """One optimiser step over the batches of all processes, then the configured number over earlier windows.

        All randomness derives from (seed, step, rank), so a resumed run without replays repeats the step exactly.
        Raises Diverged, in all processes.
        """
        image, labels = to_tensors(batch, self.device)
        means = self._learn(image, labels, progress, self._generator())
        values = dict(zip(means, torch.stack(list(means.values())).tolist(), strict=True))
        self.samples += len(batch.present) * self.group.size
        if self.replay is not None:
            self.replay.add(image, labels)
            for _ in range(self.config.data.replays):
                generator = self._generator()
                self._learn(*self.replay.drawn(len(image), generator), progress, generator)
        return StepResult(values.pop("loss"), values.pop("rotation_deg"), values.pop("depth_rel"), values)

    def _generator(self) -> torch.Generator:
        draw_of = (self.config.data.seed * 1_000_003 + self.steps) + 7_919 * self.group.rank
        return torch.Generator().manual_seed(draw_of)

    def _learn(
        self, image: Tensor, labels: Labels, progress: float, generator: torch.Generator
    ) -> Mapping[str, Tensor]:
        """One step; gradients and norm statistics are averaged over all processes. Returns the means of `_passes`."""
        schedule = self.config.schedule
        self.model.train()
        for layer in self.frozen:
            layer.eval()  # keeps its norm statistics too
        teacher = max(0.0, 1.0 - progress / schedule.teacher_until) if schedule.teacher_until > 0 else 0.0
        guide = drawn_guide(len(image), teacher, generator).to(self.device)
        means = self.passes(progress >= schedule.rounded_from, image, *labels, guide)

        rate = learning_rate(schedule, self.samples, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["lr_scale"]
        self.group.average(p.grad for p in self.model.parameters() if p.grad is not None)
        if not nn.utils.clip_grad_norm_(self.model.parameters(), schedule.gradient_clip).isfinite():
            raise Diverged
        self.optimizer.step()
        self.group.average(b for b in self.model.buffers() if b.dtype.is_floating_point)
        self.steps += 1
        self._update_average()
        return means

    def _passes(self, with_rounding: bool, image: Tensor, *labels_guide: Tensor) -> dict[str, Tensor]:
        """Forward and backward pass: leaves the gradients, and returns loss, terms and errors of the batch, scalars."""
        labels, guide = Labels(*labels_guide[:-1]), labels_guide[-1]
        self.optimizer.zero_grad(set_to_none=True)
        with contextlib.ExitStack() as views:
            if self.config.schedule.fixed_norms:
                views.enter_context(folded_norms(self.model))
            if with_rounding:
                views.enter_context(rounded(self.model))
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.run.bf16):
                seen = self.model.perceive(image)
                dense = self.model.dense(seen.F_global).float() if self.config.model.dense else None
            seen = Perception(seen.F_global.float(), seen.heat_logits.float())
            out = self.model.decode(seen, labels.K, *guided_peaks(seen.heat_logits, labels, guide))
        loss, terms = joint_loss(seen.heat_logits, out, dense, labels, self.config.loss, self.config.model.ray)
        loss.backward()
        means = {"loss": loss, **terms, **_batch_errors(out, labels)}
        return {name: mean.detach() for name, mean in means.items()}

    @torch.no_grad()
    def _update_average(self) -> None:
        """Exponential moving average of weights and norm statistics; the first steps use a smaller decay."""
        decay = min(self.config.schedule.ema_decay, (1 + self.steps) / (10 + self.steps))
        means, values = (list(network.state_dict().values()) for network in (self.average, self.model))
        real = [k for k, mean in enumerate(means) if mean.dtype.is_floating_point]
        get_ema_multi_avg_fn(decay)([means[k] for k in real], [values[k] for k in real], None)
        for k in set(range(len(means))) - set(real):
            means[k].copy_(values[k])

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on."""
        return {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "steps": self.steps,
            "samples": self.samples,
            "samples_before": self.samples_before,
            "started_from": self.started_from,
        }

    def start_from(self, weights: Path) -> None:
        """Load another run's weights where name and shape match, and warn of others. Raises ConfigError if none do."""
        fitting, self.started_from, self.samples_before = weights_to_start_from(weights, self.model.state_dict())
        for network in (self.model, self.average):
            network.load_state_dict(fitting, strict=False)

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the state of an earlier run with the same network."""
        self.model.load_state_dict(state["model"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.steps, self.samples = state["steps"], state["samples"]
        self.started_from = state["started_from"]
        self.samples_before = state.get("samples_before")


@torch.no_grad()
def _batch_errors(out: Decoded, labels: Labels) -> dict[str, Tensor]:
    weight = labels.present / labels.present.sum()  # NaN if the batch shows no target
    angle = torch.rad2deg(eq.rotation_angle(out.R_ego[:, 0], labels.R_cam_target))
    Z = labels.t_cam_target_m[:, 2].clamp(min=1.0)
    off = (torch.exp(out.log_Z[:, 0]) / Z - 1).abs()
    return {"rotation_deg": (angle * weight).sum(), "depth_rel": (off * weight).sum()}
