"""Training: `run_training` is the entry point, top-down. A step, and the state that is saved, is in `trainer.py`."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from trainer.checkpoint import RESUME_NAME, WEIGHTS_NAME, load_file, save_weights, write_atomic
from trainer.config import ConfigError, TrainerConfig, parse_config
from trainer.data import Feed, Sampler, TrainingBatch, render_once
from trainer.distributed import joined_group
from trainer.evaluate import measure, measure_each, predict_all, torch_predictor
from trainer.pictures import example_sheet
from trainer.plan import Plan
from trainer.runlog import RunLog, provenance, run_folder
from trainer.sources import refuse_unreadable, validated_from, warn_of_unseen_reduction, window_sampler
from trainer.trainer import Diverged, StepResult, Trainer, size_at

OpenSampler = Callable[[int, int], Callable[[], Sampler]]  # (seed, size_px) to a picklable opener


@contextlib.contextmanager
def kept_for_later(received: list[int], *signals: signal.Signals) -> Iterator[None]:
    """Signals are only appended to a list, so that the loop ends between two steps."""
    previous = {s: signal.signal(s, lambda number, _: received.append(number)) for s in signals}
    try:
        yield
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
    if not {"config", "trainer", "used_s", "planned_samples", "budget_s"} <= state.keys():
        raise ConfigError(f"{path}: contains no run to resume")
    earlier = parse_config(state["config"], f"{path} (config)")
    for section in ("model", "loss", "data", "schedule"):
        if getattr(earlier, section) != getattr(trainer.config, section):
            raise ConfigError(f"{path}: [{section}] differs from --config; give the same one or another --out")
    if earlier.run.bf16 != trainer.config.run.bf16:
        raise ConfigError(f"{path}: [run] bf16 differs from --config; give the same one or another --out")
    trainer.restore(state["trainer"])
    return Plan(int(state["planned_samples"]), float(state["used_s"]), state["budget_s"])


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
            if group.first:
                warn_of_unseen_reduction(config.contract)
            if resume:
                earlier = resume_run(out, trainer)
                plan = earlier.resumed(out, budget_s, samples)
            else:
                earlier = plan = Plan(samples or config.schedule.samples, 0.0, budget_s)
            loop = _Loop(trainer, config_text, out, plan, opener)
            before, now = (one.progress(trainer.samples, plan.used_before_s) for one in (earlier, plan))
            if now < before:
                loop.note(f"with the new plan the schedule goes back from {before:.0%} to {now:.0%}")
            stopped: list[int] = []
            # Only a second Ctrl-C ends the last validation: who starts a run may send it SIGTERM as well.
            with kept_for_later(stopped, signal.SIGTERM):
                with kept_for_later(stopped, signal.SIGINT):
                    loop.run(stopped, max_steps)
                loop.finish()
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
        # Samples and size at the last validation; of an earlier start, if it went no further.
        self.validated = None if self.log is None else self.log.validated

    def used_s(self) -> float:
        return self.plan.used_before_s + time.monotonic() - self.started_s

    def progress(self) -> float:
        """Of the schedule, 0..1; all processes must call it."""
        return self.group.agreed(self.plan.progress(self.trainer.samples, self.used_s()))

    def note(self, text: str) -> None:
        if self.log is not None:
            self.log.note(text)

    def run(self, stopped: list[int], max_steps: int | None) -> None:
        """Train and save a checkpoint."""
        last_step = None if max_steps is None else self.trainer.steps + max_steps
        reason, goes_on = "planned number of samples reached", "--resume --samples N"
        worth_saving = True
        try:
            self.size_px = size_at(self.config.schedule, self.progress())  # a resumed run may already be complete
            while (progress := self.progress()) < 1.0:
                size_px = size_at(self.config.schedule, progress)
                if self._train_at(size_px, stopped, last_step):
                    reason, goes_on = "stopped before the planned number of samples", "--resume"
                    break
            if self.plan.budget_s and self.used_s() >= self.plan.budget_s:
                reason, goes_on = "time budget used up", "--resume --budget-minutes M"
        except Diverged:
            worth_saving = False
            raise ConfigError(self._divergence()) from None
        finally:
            if self.trainer.steps > 0 and worth_saving:  # a run that failed before its first step cannot be resumed
                self.save()
        how = f"; {goes_on} continues" if self.trainer.steps > 0 else ""
        self.note(f"{reason}: {self.trainer.steps} steps, {self.trainer.samples} samples{how}")

    def finish(self) -> None:
        """Validate once more and close the log."""
        if self.log is None:
            return
        try:
            if self.trainer.steps > 0 and not self._is_validated(self.size_px):
                self.note("last validation (Ctrl-C skips it)")
                self.validate(self.size_px)
        finally:
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

    def _is_validated(self, size_px: int) -> bool:
        return self.validated == (self.trainer.samples, size_px)

    def validate(self, size_px: int) -> None:
        """Evaluate the averaged network on held-out windows of this size, rendered once; log metrics and examples."""
        if self.log is None or self._is_validated(size_px):
            return
        self.validated = (self.trainer.samples, size_px)
        if size_px not in self.held_out:
            data = self.config.data
            self.held_out[size_px] = render_once(self.opener(data.validation_seed, size_px), data.validation_samples)
        batches = self.held_out[size_px]
        predicted = predict_all(torch_predictor(self.trainer.average), batches)
        parts = validated_from(self.config.data, [len(batch.present) for batch in batches])
        each = measure_each(predicted, batches, parts)
        self.log.validation(self.trainer.steps, self.trainer.samples, size_px, measure(predicted, batches), each)
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
