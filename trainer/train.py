"""Training: `run_training` is the entry point, top-down; `Trainer` is the state, which a checkpoint saves in full."""

from __future__ import annotations

import contextlib
import copy
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from trainer import equations as eq
from trainer.checkpoint import RESUME_NAME, WEIGHTS_NAME, load_file, save_weights, weights_to_start_from, write_atomic
from trainer.config import ConfigError, ScheduleConfig, TrainerConfig, parse_config
from trainer.data import Feed, Sampler, TrainingBatch, render_once
from trainer.distributed import Group, joined_group
from trainer.evaluate import measure, predict_all, torch_predictor
from trainer.fixed_norms import folded_norms
from trainer.graphed import Graphed
from trainer.guidance import drawn_guide, guided_peaks
from trainer.losses import Labels, joint_loss, to_tensors
from trainer.model import Decoded, Perception, PoseNet
from trainer.pictures import example_sheet
from trainer.plan import Plan
from trainer.replay import Replay
from trainer.rounding import rounded
from trainer.runlog import RunLog, provenance, run_folder
from trainer.sources import refuse_unreadable, window_sampler

OpenSampler = Callable[[int, int], Callable[[], Sampler]]  # (seed, size_px) to a picklable opener


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
    rotation_deg: float  # mean over the batch's targets
    depth_rel: float  # mean over the batch's targets
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
    weight = labels.present / labels.present.sum().clamp(min=1.0)
    angle = torch.rad2deg(eq.rotation_angle(out.R_ego[:, 0], labels.R_cam_target))
    Z = labels.t_cam_target_m[:, 2].clamp(min=1.0)
    off = (torch.exp(out.log_Z[:, 0]) / Z - 1).abs()
    return {"rotation_deg": (angle * weight).sum(), "depth_rel": (off * weight).sum()}


@contextlib.contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """A list that SIGTERM and SIGINT append to, so that the loop ends between two steps."""
    received: list[int] = []
    previous = {s: signal.signal(s, lambda number, _: received.append(number)) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def resume_run(out: Path, trainer: Trainer) -> Plan:
    """Restore `trainer` from the run folder and return its plan. Raises ConfigError.

    The configuration may differ from the checkpoint's only in [contract] and [run] (except [run] bf16). With the same
    number of processes the run continues exactly as if it had not been interrupted; with another number the effective
    batch size changes, which run.json records.
    """
    path = out / RESUME_NAME
    state = load_file(path)
    if not {"config", "trainer", "used_s"} <= state.keys():
        raise ConfigError(f"{path}: contains no run to resume")
    earlier = parse_config(state["config"], f"{path} (config)")
    for section in ("model", "loss", "data", "schedule"):
        if getattr(earlier, section) != getattr(trainer.config, section):
            raise ConfigError(f"{path}: [{section}] differs from --config; give the same one or another --out")
    if earlier.run.bf16 != trainer.config.run.bf16:
        raise ConfigError(f"{path}: [run] bf16 differs from --config; give the same one or another --out")
    trainer.restore(state["trainer"])
    # Older files lack the plan: theirs was the configuration's.
    budget_s = state.get("budget_s")
    return Plan(int(state.get("planned_samples", earlier.schedule.samples)), float(state["used_s"]), budget_s)


def run_training(
    config: TrainerConfig,
    config_text: str,
    out: Path,
    *,
    budget_s: float | None = None,
    resume: bool = False,
    samples: int | None = None,
    open_sampler: OpenSampler | None = None,
    max_steps: int | None = None,
    start_from: Path | None = None,
) -> Trainer:
    """Train until the planned samples, the time budget, `max_steps` of this start, or a signal; save a checkpoint.

    Progress, which drives the schedule, is the larger of samples done / planned and time used / budget.
    A resumed run keeps its planned `samples` and its time budget unless others are given. Raises ConfigError.
    """
    torch.set_num_threads(config.run.threads)
    torch.backends.cudnn.benchmark = True  # windows of one size: choosing the fastest convolution once pays
    refuse_unreadable(config.data)
    opener = open_sampler or (lambda seed, size: window_sampler(config.data, seed, size))
    with joined_group() as group:
        trainer = Trainer(config, group.device, group)
        if resume and start_from is not None:
            raise ConfigError(
                f"--start-from {start_from}: not with --resume, which continues from the run's own weights"
            )
        if start_from is not None:
            trainer.start_from(start_from)
        with run_folder(out, resume, hold=group.first):
            if resume:
                earlier = resume_run(out, trainer)
                plan = earlier.resumed(out, budget_s, samples)
            else:
                earlier = plan = Plan(samples or config.schedule.samples, 0.0, budget_s)
            loop = _Loop(trainer, config_text, out, plan, opener)
            before, now = (one.progress(trainer.samples, plan.used_before_s) for one in (earlier, plan))
            if now < before:
                loop.note(f"with the new plan the schedule goes back from {before:.0%} to {now:.0%}")
            with stop_on_signals() as stopped:
                loop.run(stopped, max_steps)
    return trainer


class _Loop:
    """Data feeds, time budget, log and checkpoints around a Trainer."""

    def __init__(self, trainer: Trainer, config_text: str, out: Path, plan: Plan, opener: OpenSampler) -> None:
        self.trainer, self.config, self.config_text = trainer, trainer.config, config_text
        self.out, self.plan, self.opener = out, plan, opener
        self.started_s = time.monotonic()
        self.saved_s = self.started_s
        self.group = trainer.group
        self.provenance = {**provenance(trainer.config), "processes": self.group.size}
        asked = {"from_samples": trainer.samples, "planned_samples": plan.samples, "budget_s": plan.budget_s}
        start = {**self.provenance, **asked, "started_from": trainer.started_from}
        self.log = RunLog(out, config_text, start) if self.group.first else None
        self.size_px = size_at(self.config.schedule, 0.0)
        self.held_out: dict[int, list[TrainingBatch]] = {}
        self.validated: tuple[int, int] | None = None  # samples and size at the last validation

    def used_s(self) -> float:
        return self.plan.used_before_s + time.monotonic() - self.started_s

    def progress(self) -> float:
        return self.group.agreed(self.plan.progress(self.trainer.samples, self.used_s()))[
            0
        ]  # collective: all processes must call it

    def note(self, text: str) -> None:
        if self.log is not None:
            self.log.note(text)

    def run(self, stopped: list[int], max_steps: int | None) -> None:
        last_step = None if max_steps is None else self.trainer.steps + max_steps
        reason = "planned number of samples reached"
        worth_saving = True
        try:
            self.size_px = size_at(self.config.schedule, self.progress())  # a resumed run may already be complete
            while (progress := self.progress()) < 1.0:
                size_px = size_at(self.config.schedule, progress)
                if self._train_at(size_px, stopped, last_step):
                    reason = "stopped before the planned number of samples"
                    break
            if self.plan.budget_s and self.used_s() >= self.plan.budget_s:
                reason = "time budget used up"
        except Diverged:
            worth_saving = False
            raise ConfigError(self._divergence()) from None
        finally:
            if self.trainer.steps > 0 and worth_saving:  # a run that failed before its first step cannot be resumed
                self.save()
        self.validate(self.size_px)
        self.note(f"{reason}: {self.trainer.steps} steps, {self.trainer.samples} samples; resume with --resume")
        if self.log is not None:
            self.log.close()

    def _divergence(self) -> str:
        """Error message with a remedy; resuming would not help, as the same steps would diverge again."""
        told = (
            f"{self.out}: training stopped after {self.trainer.samples} samples: the gradient of the loss is not "
            "finite; the most frequent cause is a too high [schedule] lr"
        )
        weights = self.out / WEIGHTS_NAME
        if not weights.exists():
            return told
        return f"{told}. {WEIGHTS_NAME} was saved before that: start another run with --start-from {weights}"

    def _train_at(self, size_px: int, stopped: list[int], last_step: int | None) -> bool:
        """Train with windows of one size until the schedule changes it or ends. True: stopped before that."""
        trainer, data, run = self.trainer, self.config.data, self.config.run
        self.size_px = size_px
        self.note(f"from sample {trainer.samples} on: windows of {size_px} px")
        opener = self.opener(data.seed, size_px)
        rank, ranks = self.group.rank, self.group.size
        with Feed(opener, data.batch_size, trainer.samples, data.workers, data.prefetch, rank, ranks) as feed:
            while (progress := self.progress()) < 1.0 and size_at(self.config.schedule, progress) == size_px:
                told_to_stop = self.group.largest(float(bool(stopped))) > 0
                if told_to_stop or (last_step is not None and trainer.steps >= last_step):
                    return True
                result = trainer.step(feed.next(), progress)
                self._record(result, progress)
                if trainer.samples % run.validate_every_samples < data.batch_size * ranks:
                    self.validate(size_px)
                if time.monotonic() - self.saved_s > run.checkpoint_every_s:
                    self.save()
        return False

    def _record(self, result: StepResult, progress: float) -> None:
        if self.log is None:
            return
        trainer = self.trainer
        self.log.add(result.loss, result.terms, result.rotation_deg, result.depth_rel)
        if trainer.steps % self.config.run.log_every_steps == 0:
            self.log.report(trainer.steps, trainer.samples, progress, trainer.optimizer.param_groups[-1]["lr"])

    def validate(self, size_px: int) -> None:
        """Evaluate the averaged network on held-out windows of this size, rendered once; log metrics and examples."""
        if self.log is None or self.validated == (self.trainer.samples, size_px):
            return
        self.validated = (self.trainer.samples, size_px)
        if size_px not in self.held_out:
            data = self.config.data
            self.held_out[size_px] = render_once(self.opener(data.validation_seed, size_px), data.validation_samples)
        batches = self.held_out[size_px]
        predicted = predict_all(torch_predictor(self.trainer.average), batches)
        self.log.validation(self.trainer.steps, self.trainer.samples, size_px, measure(predicted, batches))
        self.log.picture("held out", self.trainer.samples, example_sheet(batches[0], predicted))

    def save(self) -> None:
        """Write both files, weights.pt first, so that resume.pt is never newer than weights.pt."""
        self.saved_s = time.monotonic()
        if self.log is None:
            return
        state = {"trainer": self.trainer.state(), "used_s": self.used_s(), "config": self.config_text}
        state |= {"planned_samples": self.plan.samples, "budget_s": self.plan.budget_s}
        training = {
            **self.provenance,
            "started_from": self.trainer.started_from,
            "samples": self.trainer.samples,
            "steps": self.trainer.steps,
        }
        if self.trainer.samples_before is not None:
            training["samples_before"] = self.trainer.samples_before
        training["resolution_px"] = self.size_px
        save_weights(self.out / WEIGHTS_NAME, self.trainer.average, self.config_text, training)
        write_atomic(self.out / RESUME_NAME, state)
