"""A run whose loss has no finite gradient any more ends with a sentence, and what it had saved stays."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from odd_samplers import GOOD_SAMPLES, SpoiltSampler
from synthetic_sampler import PlateSampler, opener

from trainer.checkpoint import RESUME_NAME, WEIGHTS_NAME
from trainer.config import ConfigError, parse_config
from trainer.data import training_batch
from trainer.evaluate import predict_all, torch_predictor
from trainer.pictures import example_sheet
from trainer.train import run_training

WILD = tiny.TOML.replace("warmup_samples = 8", "warmup_samples = 0\nlr = 1e12\nlr_final = 1e12")


def spoilt(seed: int, size_px: int) -> Callable[[], SpoiltSampler]:
    return partial(SpoiltSampler, seed, size_px)


def digests(out: Path) -> list[str]:
    return [hashlib.sha256((out / name).read_bytes()).hexdigest() for name in (WEIGHTS_NAME, RESUME_NAME)]


def test_what_was_saved_before_stays_and_is_named(tmp_path: Path) -> None:
    config = parse_config(tiny.TOML, "tiny.toml")
    run_training(config, tiny.TOML, tmp_path, open_sampler=spoilt, max_steps=2)
    saved = digests(tmp_path)
    with pytest.raises(ConfigError, match=rf"after {GOOD_SAMPLES} samples: .*--start-from .*weights\.pt"):
        run_training(config, tiny.TOML, tmp_path, open_sampler=spoilt, resume=True)
    assert digests(tmp_path) == saved


def test_a_rate_that_is_too_high_leaves_nothing_to_go_on_with(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\[schedule\] lr"):
        run_training(parse_config(WILD, "wild.toml"), WILD, tmp_path, open_sampler=opener)
    assert not (tmp_path / WEIGHTS_NAME).exists()
    assert not (tmp_path / RESUME_NAME).exists()


def test_an_answer_that_is_no_number_is_not_drawn() -> None:
    """The averaged network may answer so at a validation before the next step shows it."""
    batch = training_batch(PlateSampler(5, 64).batch(0, 4))
    answers = predict_all(torch_predictor(tiny.network()), [batch])
    lost = answers._replace(R_cam_target=np.full_like(answers.R_cam_target, torch.nan))
    assert example_sheet(batch, lost).any()
