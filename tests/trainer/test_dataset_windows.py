"""Windows cut from a dataset's pictures: the camera follows exactly, labels are where the picture shows them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_sampler
import tiny
import torch

from edge.estimator.window import fit_frame
from sim_replay.bop import BopFrame, BopTarget, SceneWriter
from sim_replay.datasets import open_dataset
from sim_replay.sample import AcquireView
from trainer.config import ConfigError, parse_config
from trainer.data import to_tensors, training_batch
from trainer.dataset_windows import DatasetSampler, MixedSampler
from trainer.export import stage_sampler
from trainer.losses import dense_terms, heatmap_loss, heatmap_target
from trainer.train import run_training

K = np.array([[1500.0, 0, 320], [0, 1480, 180], [0, 0, 1]])
WIDTH, HEIGHT = 640, 360
DOT_BGR = (0, 0, 255)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames whose target is a red disc around the projected origin; the last has none."""
    root = tmp_path_factory.mktemp("dots")
    rng = np.random.default_rng(3)
    with SceneWriter(root / "train" / "000003", jpeg_quality=98) as writer:
        for image_id in range(6):
            t = np.array([*rng.uniform([-40, -20], [40, 20]), 260.0])
            pixel = (K @ t)[:2] / t[2]
            image, mask = np.full((HEIGHT, WIDTH, 3), 128, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
            targets: tuple[BopTarget, ...] = ()
            if image_id < 5:
                centre = tuple(round(v * 16) for v in pixel)
                cv2.circle(image, centre, 12 * 16, DOT_BGR, -1, cv2.LINE_AA, shift=4)
                cv2.circle(mask, centre, 12 * 16, 255, -1, shift=4)
                y, x = np.nonzero(mask)
                box = np.array([x.min() - 0.5, y.min() - 0.5, x.max() + 0.5, y.max() + 0.5])
                pixels = int((mask > 0).sum())
                targets = (BopTarget(1, np.eye(3), t, box, box, pixels, pixels),)
            writer.add(BopFrame(image_id, K, targets), image, [mask > 0][: len(targets)])
    return root


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames with two red discs, 60 pixels apart."""
    root = tmp_path_factory.mktemp("pairs")
    with SceneWriter(root / "train" / "000001", jpeg_quality=98) as writer:
        for image_id in range(4):
            image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
            masks, targets = [], []
            for x in (200 + 40 * image_id, 260 + 40 * image_id):
                mask = np.zeros((HEIGHT, WIDTH), np.uint8)
                cv2.circle(image, (x, 180), 12, DOT_BGR, -1)
                cv2.circle(mask, (x, 180), 12, 255, -1)
                box = np.array([x - 12.5, 167.5, x + 12.5, 192.5])
                t = 260.0 * np.linalg.solve(K, [x, 180, 1.0])
                pixels = int((mask > 0).sum())
                targets.append(BopTarget(1, np.eye(3), t, box, box, pixels, pixels))
                masks.append(mask > 0)
            writer.add(BopFrame(image_id, K, tuple(targets)), image, masks)
    return root


def test_of_a_second_aircraft_in_the_window_nothing_is_asked(pairs: Path) -> None:
    batch = DatasetSampler(pairs, "train", 5, 192, 1.0).batch(0, 40)
    _, labels = to_tensors(batch, torch.device("cpu"))
    target = heatmap_target(labels, 24, 24).numpy()
    both = 0
    for k in np.flatnonzero(batch.present):
        red = batch.image_bgr[k, ..., 2].astype(float) - batch.image_bgr[k, ..., 1] > 100
        *_, centres = cv2.connectedComponentsWithStats(red.astype(np.uint8))
        away = np.linalg.norm(centres[1:] - batch.center_px[k], axis=1)
        for x, y in centres[1:][away > 15]:
            both += 1
            assert batch.others[k, int(y / 4), int(x / 4)]
            assert 0.99 < target[k, int(y / 8), int(x / 8)] < 1.0
    assert both > 8
    assert (target == 1.0).sum() == batch.present.sum()
    logits = torch.zeros(40, 24, 24, requires_grad=True)
    dense = torch.zeros(40, 4, 48, 48, requires_grad=True)
    (heatmap_loss(logits, torch.from_numpy(target)) + dense_terms(dense, labels)["mask"].sum()).backward()
    assert logits.grad is not None
    assert dense.grad is not None
    elsewhere = ~labels.others
    assert (dense.grad[:, 0][labels.others] == 0).all()
    assert (dense.grad[:, 0][elsewhere] != 0).all()
    unjudged = (target > 0.99) & (target < 1.0)
    assert logits.grad.abs().numpy()[unjudged].max() < 1e-9 < logits.grad.abs().numpy()[target == 0.0].min()


@pytest.mark.parametrize(("acquire_share", "view"), [(0.0, "crop"), (1.0, "crop"), (1.0, "frame")])
def test_the_target_is_seen_where_its_pose_and_K_project_it(
    dataset: Path, acquire_share: float, view: AcquireView
) -> None:
    batch = DatasetSampler(dataset, "train", 5, 96, acquire_share, view).batch(0, 48)
    assert 0 < batch.present.sum() < 48
    for k in np.flatnonzero(batch.present):
        projected = batch.K[k] @ batch.t_cam_target_m[k]
        projected = projected[:2] / projected[2]
        redness = batch.image_bgr[k, ..., 2].astype(float) - batch.image_bgr[k, ..., 1]
        y, x = np.nonzero(redness > 100)
        if min(x.min(), y.min()) > 0 and max(x.max(), y.max()) < 95:
            np.testing.assert_allclose(projected, [x.mean(), y.mean()], atol=0.6)
            np.testing.assert_allclose(batch.center_px[k], projected, atol=1.5)
        assert np.isnan(batch.noc[k]).all()
        assert batch.coverage[k].max() > (0.2 if view == "frame" else 0.9)  # a squashed disc is smaller than a cell


def test_a_squashed_frame_is_what_the_daemon_squashes(dataset: Path) -> None:
    batch = DatasetSampler(dataset, "train", 5, 96, 1.0, "frame").batch(0, 8)
    np.testing.assert_allclose(batch.K[:, 0, 0], K[0, 0] * 96 / WIDTH)
    np.testing.assert_allclose(batch.K[:, 1, 1], K[1, 1] * 96 / HEIGHT)
    pictures = [fit_frame(f.image_bgr(), (96, 96), "squash") for f in open_dataset(dataset, "train").labelled_frames()]
    for image, K_window in zip(batch.image_bgr, batch.K, strict=True):
        nearest = min(pictures, key=lambda p: float(np.abs(p[0].astype(float) - image).mean()))
        assert np.abs(nearest[0].astype(float) - image).mean() < 1.0
        np.testing.assert_allclose(nearest[1].intrinsics(K), K_window, rtol=1e-6)


def test_a_window_depends_on_its_index_alone(dataset: Path) -> None:
    one = DatasetSampler(dataset, "train", 5, 64, 0.3)
    np.testing.assert_array_equal(one.batch(0, 8).image_bgr[3:], one.batch(3, 5).image_bgr)


def test_mixing_keeps_the_share_and_unknown_labels_teach_nothing(dataset: Path) -> None:
    plates = synthetic_sampler.PlateSampler(1, 64)
    mixed = MixedSampler([DatasetSampler(dataset, "train", 5, 64, 0.0), plates], [0.25, 0.75]).batch(0, 8)
    assert np.isnan(mixed.noc).any(axis=(1, 2, 3)).tolist() == [True] * 2 + [False] * 6
    np.testing.assert_array_equal(mixed.image_bgr[2:], training_batch(plates.batch(0, 6)).image_bgr)
    _, labels = to_tensors(mixed, torch.device("cpu"))
    dense = torch.zeros(8, 4, 16, 16, requires_grad=True)
    terms = dense_terms(dense, labels)
    (terms["noc"].sum() + terms["mask"].sum()).backward()
    assert torch.isfinite(dense.grad).all()
    assert (dense.grad[:2, 1:] == 0).all()


def test_a_network_trains_on_a_dataset_named_in_its_configuration(dataset: Path, tmp_path: Path) -> None:
    source = f'[[data.datasets]]\npath = "{dataset}"\nshare = 1.0\nvalidation_split = "train"\n[schedule]'
    text = tiny.TOML.replace("[schedule]", source)
    trainer = run_training(parse_config(text, "own.toml"), text, tmp_path / "run", max_steps=1)
    assert trainer.samples == 4


def test_what_cannot_be_trained_on_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=str(tmp_path)):
        DatasetSampler(tmp_path, None, 1, 64, 0.3)
    shares = '[[data.datasets]]\npath = "a"\nshare = 0.7\n[[data.datasets]]\npath = "b"\nshare = 0.6\n[schedule]'
    with pytest.raises(ConfigError, match=r"own\.toml: data: .*add up to more than 1"):
        parse_config(tiny.TOML.replace("[schedule]", shares), "own.toml")


def test_a_run_on_a_dataset_that_is_not_there_says_so_and_leaves_nothing_to_resume(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    text = tiny.TOML.replace("[schedule]", f'[[data.datasets]]\npath = "{nowhere}"\nshare = 1.0\n[schedule]')
    with pytest.raises(ConfigError, match=rf"^{nowhere} is not a folder$"):
        run_training(parse_config(text, "own.toml"), text, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*.pt"))


def test_held_out_windows_are_of_the_validation_split(dataset: Path) -> None:
    source = f'[[data.datasets]]\npath = "{dataset}"\nshare = 1.0\nvalidation_split = "val"\n[schedule]'
    data = parse_config(tiny.TOML.replace("[schedule]", source), "own.toml").data
    assert stage_sampler(data, 77, 64, 0.0, held_out=False)().batch(0, 4).present.shape == (4,)
    with pytest.raises(ConfigError, match="'val'"):
        stage_sampler(data, 77, 64, 0.0)()
