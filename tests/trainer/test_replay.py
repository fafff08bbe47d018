"""Windows that are trained on again: labels stay true when mirrored, and only the last ones are kept."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_sampler
import tiny
import torch
from synthetic_sampler import PlateSampler
from torch import Tensor

from sim_replay.sampler import WindowSampler
from trainer.config import ConfigError, parse_config
from trainer.data import DENSE_STRIDE, TrainingBatch, training_batch
from trainer.losses import Labels, to_tensors
from trainer.replay import Replay, mirrored, relit
from trainer.train import run_training
from trainer.trainer import Trainer

CPU = torch.device("cpu")
SIZE_PX = 128


@pytest.fixture(scope="module")
def rendered() -> TrainingBatch:
    return training_batch(WindowSampler(21, SIZE_PX, [0, 6, 13], 0.0, 0.0).batch(0, 12))


def off_px(labels: Labels, diameter_m: Tensor) -> np.ndarray:
    """Distances between cells that the aircraft fills and the projections of their object coordinates, by OpenCV."""
    off = []
    for k in torch.nonzero(labels.present)[:, 0]:
        row, column = torch.nonzero(labels.coverage[k] > 0.99, as_tuple=True)
        if len(row) == 0:
            continue
        points_m = (labels.noc[k][:, row, column].T * diameter_m[k]).double().numpy()
        turn, _ = cv2.Rodrigues(labels.R_cam_target[k].double().numpy())
        K, t_m = labels.K[k].double().numpy(), labels.t_cam_target_m[k].double().numpy()
        there, _ = cv2.projectPoints(points_m, turn, t_m, K, None)
        cells = DENSE_STRIDE * (torch.stack([column, row], dim=-1).double().numpy() + 0.5) - 0.5
        off.append(np.linalg.norm(there[:, 0] - cells, axis=-1))
    return np.concatenate(off)


def test_a_mirrored_aircraft_lies_where_its_mirrored_labels_say(rendered: TrainingBatch) -> None:
    image, labels = to_tensors(rendered, CPU)
    diameter_m = torch.from_numpy(rendered.diameter_m)
    as_drawn = off_px(labels, diameter_m)
    assert len(as_drawn) > 200
    assert np.median(as_drawn) < 0.5
    other_image, other = mirrored(image, labels)
    np.testing.assert_allclose(np.sort(off_px(other, diameter_m)), np.sort(as_drawn), atol=1e-2)
    assert torch.linalg.det(other.R_cam_target).allclose(torch.ones(len(image)), atol=1e-5)
    assert torch.equal(other_image[:, :, 0], image[:, :, SIZE_PX - 1])
    again_image, again = mirrored(other_image, other)
    assert torch.equal(again_image, image)
    for value, first in zip(again, labels, strict=True):
        torch.testing.assert_close(value, first, rtol=0, atol=1e-4, equal_nan=True)


def test_a_mirrored_right_wing_is_a_right_wing(rendered: TrainingBatch) -> None:
    """In the picture, where the mirrored labels say right of the body's middle, the mirrored left half lies."""
    image, labels = to_tensors(rendered, CPU)
    _, other = mirrored(image, labels)
    right, was_left = other.noc[:, 1] > 0.05, (labels.noc[:, 1] < -0.05).flip(2)
    assert right.any()
    assert torch.equal(right, was_left)


def test_other_light_keeps_what_is_shown() -> None:
    flat = torch.full((40, 32, 32, 3), 120, dtype=torch.uint8)
    flat[:, :, :16] = 60
    seen = relit(flat, torch.Generator().manual_seed(1)).float()
    left, right = seen[:, :, :16].mean((1, 2)), seen[:, :, 16:].mean((1, 2))
    torch.testing.assert_close(right / left, torch.full_like(left, 2.0), rtol=0.02, atol=0)
    assert right.std(0).min() > 8.0, "pictures differ in brightness"
    assert (right.max(1).values - right.min(1).values).median() > 3.0, "and in tint"


def test_the_last_windows_replace_the_first_and_a_new_size_all() -> None:
    replay, drawing = Replay(10), torch.Generator().manual_seed(2)
    image, labels = to_tensors(training_batch(PlateSampler(5, 64).batch(0, 16)), CPU)
    numbered = [labels._replace(airframe_id=torch.arange(first, first + 4)) for first in range(0, 16, 4)]
    for k, of_four in enumerate(numbered):
        rows = slice(4 * k, 4 * k + 4)
        replay.add(image[rows], Labels(*(v[rows] if n != "airframe_id" else v for n, v in of_four._asdict().items())))
    _, drawn = replay.drawn(200, drawing)
    assert set(drawn.airframe_id.tolist()) == set(range(6, 16))
    small = to_tensors(training_batch(PlateSampler(5, 32).batch(0, 4)), CPU)
    replay.add(*small)
    assert replay.drawn(8, drawing)[0].shape == (8, 32, 32, 3)


def test_more_windows_than_the_memory_holds_are_a_sentence() -> None:
    with pytest.raises(ConfigError, match="replay_windows: 100000000000 windows do not fit in the memory of cpu"):
        Replay(10**11).add(*to_tensors(training_batch(PlateSampler(5, 64).batch(0, 4)), CPU))


def test_replays_are_steps_over_windows_that_were_rendered_once() -> None:
    config = parse_config(tiny.TOML.replace("[data]", "[data]\nreplays = 2\nreplay_windows = 8"), "tiny.toml")
    trainer = Trainer(config, CPU)
    for first in range(0, 12, 4):
        trainer.step(training_batch(PlateSampler(3, 64).batch(first, 4)), 0.5)
    assert (trainer.steps, trainer.samples) == (9, 12)


def test_the_log_counts_rendered_images_by_the_clock(tmp_path: Path) -> None:
    text = tiny.TOML.replace("[data]", "[data]\nreplays = 1\nreplay_windows = 8")
    text = text.replace("samples = 16\nw", "samples = 40\nw").replace("log_every_steps = 1", "log_every_steps = 2")
    run_training(parse_config(text, "tiny.toml"), text, tmp_path / "run", open_sampler=synthetic_sampler.opener)
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if line["kind"] == "train"]
    assert [line["samples"] for line in steps] == list(range(4, 44, 4))
    # Time between the lines; the first includes starting the renderer, and a validation is in none.
    told_s = sum(4 / line["images_per_s"] for line in steps)
    assert 0.5 * lines[-1]["wall_s"] < told_s < 1.05 * lines[-1]["wall_s"]
