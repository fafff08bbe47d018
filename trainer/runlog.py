"""The log of a training run: printed lines, JSON lines, TensorBoard scalars, and provenance."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.tensorboard import SummaryWriter

from sim_replay.lock import take_lock
from sim_replay.packages import packages
from trainer.checkpoint import RESUME_NAME, WEIGHTS_NAME
from trainer.config import ConfigError, TrainerConfig, made_folder
from trainer.evaluate import null_where_unknown
from trainer.unfinished import unfinished

RUN_NAME = "run.json"
LOCK_NAME = ".lock"
# Code that affects the rendered windows and the training.
SOURCES = ("trainer", "sim_replay", "msgs")


@contextmanager
def run_folder(out: Path, resume: bool, hold: bool = True) -> Iterator[None]:
    """A run's folder; `hold` locks it against a second run until this one ends.

    Raises ConfigError if another run is using it, if a new one would overwrite a run or weights, or if there are only
    weights to resume from.
    """
    with _alone_in(out) if hold and (not resume or out.is_dir()) else nullcontext():
        can_resume, weights = (out / RESUME_NAME).exists(), out / WEIGHTS_NAME
        if can_resume and not resume:
            raise ConfigError(f"{out}: already contains a run; add --resume or give another --out")
        if weights.exists() and not can_resume:
            told = f"{out}: already contains weights, but no {RESUME_NAME} to continue from"
            raise ConfigError(f"{told}; give another --out, and --start-from {weights} to begin with these")
        yield


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    path = made_folder(out) / LOCK_NAME
    try:
        lock = take_lock(path)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from error
    if lock is None:
        raise ConfigError(f"{out}: is in use by another run; give another --out")
    with lock:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def commit_of(tree: Path) -> str:
    """The commit of a source tree, with `+` if SOURCES have uncommitted changes; "unknown" outside of git."""
    try:
        ask = lambda *words: subprocess.check_output(["git", *words], cwd=tree, stderr=subprocess.DEVNULL, text=True)  # noqa: E731
        head, changed = ask("rev-parse", "HEAD").strip(), ask("status", "--porcelain", "--", *SOURCES).strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if changed else "")


def provenance(config: TrainerConfig) -> dict[str, str | int | float]:
    """What is needed to reproduce the run, apart from its configuration."""
    return {
        "seed": config.data.seed,
        "commit": commit_of(Path(__file__).parent.parent),
        "torch": str(torch.__version__),
        **packages(),
        "python": platform.python_version(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else platform.machine(),
    }


def starts_of(out: Path) -> list[dict[str, Any]]:
    """The records of each start of the run in a run folder's run.json, in order; empty without the file.

    Raises ConfigError for a damaged file.
    """
    path = out / RUN_NAME
    if not path.exists():
        return []
    try:
        return list(json.loads(path.read_text(encoding="utf-8"))["starts"])
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    except (KeyError, TypeError):
        raise ConfigError(f"{path}: has no list of starts") from None


def _write_whole(path: Path, text: str) -> None:
    """Write to a temporary file and rename, so that a crash or a full disk leaves the last complete file.

    Raises ConfigError.
    """
    try:
        with unfinished(path) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _is_of_the_past(line: str, samples: int) -> bool:
    """Whether a line of log.jsonl is complete and belongs to at most this number of samples."""
    try:
        return bool(json.loads(line)["samples"] <= samples)
    except ValueError:
        return False


class RunLog:
    """Writes into a run folder; every line is on disk when its call returns."""

    def __init__(self, out: Path, config_text: str, start: Mapping[str, str | int | float | None]) -> None:
        """`start` describes this start of the run; run.json keeps one record per start.

        After a crash, log entries beyond "from_samples" are removed, since those samples are repeated. Raises
        ConfigError if the folder cannot be written.
        """
        made_folder(out)
        _write_whole(out / "config.toml", config_text)
        digest = hashlib.sha256(config_text.encode()).hexdigest()
        starts = [*starts_of(out), {**start, "config_sha256": digest}]
        _write_whole(out / RUN_NAME, json.dumps({"starts": starts}, indent=2) + "\n")
        samples = int(start["from_samples"] or 0)
        log = out / "log.jsonl"
        lines = log.read_text(encoding="utf-8").splitlines(keepends=True) if log.exists() else []
        kept = [line for line in lines if _is_of_the_past(line, samples)]
        if len(kept) < len(lines):
            _write_whole(log, "".join(kept))
        told = [record for record in map(json.loads, kept) if record.get("kind") == "validation"]
        self.validated = (int(told[-1]["samples"]), int(told[-1]["size_px"])) if told else None  # samples and size
        self._lines = log.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(out / "tensorboard"), purge_step=samples + 1)
        self._started_s = time.monotonic()
        self._reset(samples)

    def _reset(self, samples: int) -> None:
        self._values: dict[str, list[float]] = {}
        self._since_s, self._since_samples = time.monotonic(), samples

    def add(self, loss: float, terms: dict[str, float], rotation_deg: float, depth_rel: float) -> None:
        """Add one step's values; `report` averages them. An error is NaN if the step saw no target."""
        for name, value in {"loss": loss, **terms, "rotation_deg": rotation_deg, "depth_rel": depth_rel}.items():
            self._values.setdefault(name, []).append(value)

    def report(self, step: int, samples: int, progress: float, rate: float) -> None:
        """Print a line and write a JSON record with the means since the last report."""
        known = {name: [value for value in values if not math.isnan(value)] for name, values in self._values.items()}
        means = {name: sum(values) / len(values) if values else math.nan for name, values in known.items()}
        per_s = (samples - self._since_samples) / max(time.monotonic() - self._since_s, 1e-6)
        told_apart = ("loss", "rotation_deg", "depth_rel", "geodesic")
        terms = " ".join(f"{name} {value:.3f}" for name, value in means.items() if name not in told_apart)
        print(
            f"step {step:6d}  samples {samples:7d}  {100 * progress:5.1f} %  {per_s:5.1f} images/s  lr {rate:.1e}  "
            f"loss {means['loss']:.3f}  rotation error {means['rotation_deg']:5.1f} deg  "
            f"depth error {100 * means['depth_rel']:5.1f} %  [{terms}]",
            flush=True,
        )
        record = {"step": step, "samples": samples, "progress": progress, "images_per_s": per_s, "lr": rate, **means}
        self._record("train", samples, record)
        self._reset(samples)

    def validation(
        self,
        step: int,
        samples: int,
        size_px: int,
        metrics: dict[str, float],
        each: Mapping[str, Mapping[str, float]],
    ) -> None:
        """Metrics on all held-out windows, and on `each` part of them, by its name; the latter are not printed."""
        print(
            f"validation at {size_px} px after {samples} samples: "
            f"rotation error mean {metrics['E_r_mean_deg']:.1f} median {metrics['E_r_median_deg']:.1f} deg, "
            f"depth error median {100 * metrics['depth_rel_median']:.1f} %, "
            f"Pose@10°/5 % {100 * metrics['pose_10deg_5pct']:.1f} %, box IoU {metrics['box_iou_mean']:.2f}, "
            f"recall {100 * metrics['recall']:.1f} %, false positives {100 * metrics['false_alarms']:.1f} %, "
            f"score AUC {metrics['score_auc']:.3f}",
            flush=True,
        )
        here = {"step": step, "samples": samples, "size_px": size_px}
        self._record("validation", samples, {**here, **metrics})
        for name, measured in each.items():
            self._record(f"validation/{name}", samples, {**here, **measured})
        self._reset(samples)

    def picture(self, name: str, samples: int, image_bgr: NDArray[np.uint8]) -> None:
        """An image [H, W, 3] on TensorBoard."""
        self._board.add_image(name, image_bgr[..., ::-1].copy(), samples, dataformats="HWC")

    def note(self, text: str) -> None:
        print(text, flush=True)

    def _record(self, kind: str, samples: int, values: dict[str, float]) -> None:
        record = {"kind": kind, "wall_s": time.monotonic() - self._started_s, **null_where_unknown(values)}
        self._lines.write(json.dumps(record, allow_nan=False) + "\n")
        self._lines.flush()
        for name, value in values.items():
            self._board.add_scalar(f"{kind}/{name}", value, samples)

    def close(self) -> None:
        self._lines.close()
        self._board.close()
