"""Windows cut from a dataset's pictures: the camera follows exactly, labels are where the picture shows them."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_sampler
import tiny
import torch

from edge.estimator.window import fit_frame
from sim_replay.bop import BopFrame, BopTarget, SceneWriter
from sim_replay.datasets import box_of_mask, open_dataset
from sim_replay.sample import AcquireView, SampleBatch
from trainer.cli import EDGE_CONFIG
from trainer.config import ConfigError, DataConfig, parse_config
from trainer.data import TrainingBatch, training_batch
from trainer.dataset_windows import DatasetSampler, MixedSampler
from trainer.export import stage_sampler
from trainer.losses import dense_terms, heatmap_loss, heatmap_target, to_tensors
from trainer.refine import fleet_size
from trainer.sources import refinement_sampler, refuse_unreadable
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


@pytest.mark.parametrize("acquire_share", [0.0, 1.0])
def test_behind_a_lens_labels_are_where_the_straightened_picture_shows_the_target(
    tmp_path: Path, acquire_share: float
) -> None:
    wide_K, lens = np.array([[300.0, 0, 319.5], [0, 300, 179.5], [0, 0, 1]]), (-0.3, 0.02, 0.004, -0.003, 0.0)
    around = np.linspace(0.0, 2 * np.pi, 90)
    with SceneWriter(tmp_path / "train" / "000000", jpeg_quality=98) as writer:
        for image_id, (x, y) in enumerate([(-0.8, 0.1), (0.7, -0.3), (0.75, 0.2), (0.1, 0.45), (-0.6, -0.4)]):
            t = 260.0 * np.array([x, y, 1.0])
            ring = t + 13.0 * np.column_stack([np.cos(around), np.sin(around), np.zeros_like(around)])
            outline, _ = cv2.projectPoints(ring, np.zeros(3), np.zeros(3), wide_K, np.array(lens))
            image, mask = np.full((HEIGHT, WIDTH, 3), 128, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
            corners = [np.round(outline * 16).astype(np.int32)]
            cv2.fillPoly(image, corners, DOT_BGR, cv2.LINE_AA, shift=4)
            cv2.fillPoly(mask, corners, 255, shift=4)
            target = BopTarget(1, np.eye(3), t, box_of_mask(mask > 0), None, int((mask > 0).sum()))
            writer.add(BopFrame(image_id, wide_K, (target,), distortion=lens), image)
    batch = DatasetSampler(tmp_path, "train", 5, 128, acquire_share).batch(0, 40)
    judged = 0
    for k in np.flatnonzero(batch.present):
        redness = batch.image_bgr[k, ..., 2].astype(float) - batch.image_bgr[k, ..., 1]
        box = box_of_mask(redness > 64)
        assert box is not None
        if box.min() > 0 and box.max() < 126:
            judged += 1
            sides = box[2:] - box[:2]
            np.testing.assert_allclose(batch.center_px[k], (box[:2] + box[2:]) / 2, atol=0.05 * sides.max() + 0.5)
            np.testing.assert_allclose(batch.size_px[k], sides, rtol=0.2)  # the box that its sides' middles bound
    assert judged > 10


@pytest.mark.parametrize("acquire_share", [0.0, 1.0])
def test_of_a_camera_whose_pixels_are_not_square_the_windows_are(tmp_path: Path, acquire_share: float) -> None:
    """A disc that faces the camera is one in every window, though the picture shows an ellipse half as high."""
    squeezed_K = np.array([[1500.0, 0, 320], [0, 750.0, 180], [0, 0, 1]])
    with SceneWriter(tmp_path / "train" / "000000", jpeg_quality=98) as writer:
        for image_id, centre in enumerate([(320, 180), (200, 120), (450, 240)]):
            image, mask = np.full((HEIGHT, WIDTH, 3), 128, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
            cv2.ellipse(image, centre, (30, 15), 0, 0, 360, DOT_BGR, -1)
            cv2.ellipse(mask, centre, (30, 15), 0, 0, 360, 255, -1)
            t = 260.0 * np.linalg.solve(squeezed_K, [*centre, 1.0])
            target = BopTarget(1, np.eye(3), t, box_of_mask(mask > 0), None, int((mask > 0).sum()))
            writer.add(BopFrame(image_id, squeezed_K, (target,)), image)
    batch = DatasetSampler(tmp_path, "train", 5, 128, acquire_share).batch(0, 80)
    np.testing.assert_allclose(batch.K[:, 0, 0], batch.K[:, 1, 1], rtol=1e-6)
    judged = 0
    for k in np.flatnonzero(batch.present):
        box = box_of_mask(batch.image_bgr[k, ..., 2].astype(float) - batch.image_bgr[k, ..., 1] > 64)
        assert box is not None
        if box.min() > 0 and box.max() < 126:
            judged += 1
            assert box[2] - box[0] == pytest.approx(box[3] - box[1], rel=0.1, abs=2.0)
            np.testing.assert_allclose(batch.size_px[k], box[2:] - box[:2], rtol=0.1, atol=2.0)
    assert judged > 4


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


def test_of_a_target_that_a_window_shows_too_little_of_nothing_is_asked_and_it_is_no_background(tmp_path: Path) -> None:
    """A disc of 240 pixels in windows of at most 128: never 35 % of its box."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(mask, (320, 180), 120, 255, -1)
    image = np.where(mask[..., None] > 0, np.array(DOT_BGR), 128).astype(np.uint8)
    target = BopTarget(1, np.eye(3), np.array([0.0, 0.0, 60.0]), box_of_mask(mask > 0), None, int((mask > 0).sum()))
    with SceneWriter(tmp_path / "train" / "000000", jpeg_quality=98) as writer:
        writer.add(BopFrame(0, K, (target,)), image, [mask > 0])
    batch = DatasetSampler(tmp_path, "train", 5, 128, 1.0).batch(0, 16)
    assert not batch.present.any()
    red = (batch.image_bgr[..., 2].astype(float) - batch.image_bgr[..., 1] > 64).reshape(16, 32, 4, 32, 4).all((2, 4))
    assert red.sum() > 1000
    assert batch.others[red].all()
    _, labels = to_tensors(batch, torch.device("cpu"))
    assert heatmap_target(labels, 16, 16)[torch.from_numpy(red[:, ::2, ::2])].min() > 0.99


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
    for split in ("train", "val"):
        shutil.copytree(dataset / "train", tmp_path / "own" / split)
    source = f'[[data.datasets]]\npath = "{tmp_path / "own"}"\nshare = 1.0\nvalidation_split = "val"\n[schedule]'
    text = tiny.TOML.replace("[schedule]", source)
    trainer = run_training(parse_config(text, "own.toml"), text, tmp_path / "run", max_steps=1)
    assert trainer.samples == 4


@pytest.mark.parametrize(("split", "named"), [("vall", "'vall'"), ("train", "is both trained on and validated on")])
def test_a_wrong_validation_split_is_told_before_the_first_step(
    dataset: Path, tmp_path: Path, split: str, named: str
) -> None:
    source = f'[[data.datasets]]\npath = "{dataset}"\nshare = 0.5\nvalidation_split = "{split}"\n[schedule]'
    text = tiny.TOML.replace("[schedule]", source)
    with pytest.raises(ConfigError, match=named):
        run_training(parse_config(text, "own.toml"), text, tmp_path / "run", max_steps=1)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("split", ["train", "val"])
def test_a_broken_image_is_told_before_the_first_step(dataset: Path, tmp_path: Path, split: str) -> None:
    """It would end the run whenever it is drawn, at night; one of the validation split at the first validation."""
    root = tmp_path / "own"
    for name in ("train", "val"):
        shutil.copytree(dataset / "train", root / name)
    source = f'[[data.datasets]]\npath = "{root}"\nshare = 0.5\nvalidation_split = "val"\n[schedule]'
    data = parse_config(tiny.TOML.replace("[schedule]", source), "own.toml").data
    refuse_unreadable(data)
    first, second, *_ = sorted((root / split / "000003" / "rgb").iterdir())
    with first.open("ab") as file:
        file.write(b"something that a camera appends" * 1000)
    refuse_unreadable(data)
    second.write_bytes(second.read_bytes()[:-100])
    with pytest.raises(ConfigError, match=rf"{second} is cut short.*gray$"):
        refuse_unreadable(data)
    first.write_bytes(b"")
    next((root / split / "000003" / "mask_visib").iterdir()).write_bytes(b"")
    with pytest.raises(ConfigError, match=rf"{first} is not a readable picture \(and 2 more\)"):
        refuse_unreadable(data)


def test_the_examples_of_the_page_on_datasets_are_configurations() -> None:
    page = (Path(__file__).parents[2] / "docs" / "datasets.md").read_text()
    examples = re.findall(r"```toml\n(\[\[data\.datasets\]\].*?)```", page, re.DOTALL)
    shares = [
        [
            source.share
            for source in parse_config(tiny.TOML.replace("[schedule]", text + "[schedule]"), "own").data.datasets
        ]
        for text in examples
    ]
    assert shares == [[0.3], [0.8, 0.2]]
    (flown,) = re.findall(r"```toml\n(flown = .*?)```", page, re.DOTALL)
    copied = EDGE_CONFIG.read_text().replace("[data]\n", "[data]\n" + flown)
    assert parse_config(copied + examples[0], "own").data.flown_share == 0.55


def test_a_mask_that_cannot_belong_to_its_image_is_named(dataset: Path, tmp_path: Path) -> None:
    """Of another size, it would teach the mask head that the aircraft is background."""
    root = tmp_path / "dots"
    shutil.copytree(dataset, root)
    half = cv2.imencode(".png", np.full((HEIGHT // 2, WIDTH // 2), 255, np.uint8))[1].tobytes()
    for content, told in ((half, "640 x 360 pixels, its mask 320 x 180"), (b"", r"_000000\.png is not a readable")):
        for path in (root / "train" / "000003" / "mask_visib").iterdir():
            path.write_bytes(content)
        with pytest.raises(ConfigError, match=told):
            DatasetSampler(root, "train", 5, 64, 0.0).batch(0, 40)


def test_what_cannot_be_trained_on_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=str(tmp_path)):
        DatasetSampler(tmp_path, None, 1, 64, 0.3)
    shares = '[[data.datasets]]\npath = "a"\nshare = 0.7\n[[data.datasets]]\npath = "b"\nshare = 0.6\n[schedule]'
    with pytest.raises(ConfigError, match=r"own\.toml: data: .*add up to more than 1"):
        parse_config(tiny.TOML.replace("[schedule]", shares), "own.toml")


def told_by_poses_alone(root: Path, Z_mm: list[float]) -> Path:
    """A scene without a word of where in its pictures the targets are seen."""
    scene = root / "train" / "000004"
    (scene / "rgb").mkdir(parents=True)
    for image_id in range(len(Z_mm)):
        cv2.imwrite(str(scene / "rgb" / f"{image_id:06d}.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    camera = {"cam_K": K.ravel().tolist()}
    pose = {"obj_id": 7, "cam_R_m2c": np.eye(3).ravel().tolist()}
    poses = {str(k): [pose | {"cam_t_m2c": [0, 0, z]}] for k, z in enumerate(Z_mm)}
    (scene / "scene_camera.json").write_text(json.dumps({str(k): camera for k in range(len(Z_mm))}))
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    return scene


def test_a_target_of_which_nothing_tells_where_it_is_seen_is_not_taken_for_background(tmp_path: Path) -> None:
    scene = told_by_poses_alone(tmp_path, [-200e3, 200e3])
    box = {f"{kind}_{axis}": v for kind, v in (("min", -5e3), ("size", 1e4)) for axis in "xyz"}
    models = tmp_path / "models" / "models_info.json"
    models.parent.mkdir()
    models.write_text(json.dumps({"7": {"diameter": 1e4}}))
    with pytest.raises(ConfigError, match=r"000004: .* picture 1 .* obj_id 7: give scene_gt_info\.json, masks, or"):
        DatasetSampler(tmp_path, "train", 1, 64, 0.0)
    models.write_text(json.dumps({"7": {"diameter": 1e4} | box}))
    batch = DatasetSampler(tmp_path, "train", 1, 64, 0.0).batch(0, 16)
    assert 0 < batch.present.sum() < 16  # what lies behind the camera is not seen
    models.unlink()
    seen = {"0": [{"bbox_visib": [-1, -1, -1, -1]}], "1": [{"bbox_visib": [300, 170, 40, 20]}]}
    (scene / "scene_gt_info.json").write_text(json.dumps(seen))
    assert DatasetSampler(tmp_path, "train", 1, 64, 0.0).batch(0, 16).present.any()


def test_targets_out_of_the_range_that_is_told_are_refused_or_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name, Z_mm in {"metres": [200.0, 150.0], "mixed": [200e3, 650e3], "right": [50e3, 600e3]}.items():
        scene = told_by_poses_alone(tmp_path / name, Z_mm)
        (scene / "scene_gt_info.json").write_text(json.dumps({k: [{"bbox_visib": [300, 170, 40, 20]}] for k in "01"}))
    with pytest.raises(ConfigError, match=r"metres: .* 0\.15 to 0\.2 m .* 50 to 600 m; cam_t_m2c is in millimetres"):
        DatasetSampler(tmp_path / "metres", "train", 1, 64, 0.0)
    DatasetSampler(tmp_path / "right", "train", 1, 64, 0.0)
    assert not caplog.text
    DatasetSampler(tmp_path / "mixed", "train", 1, 64, 0.0)
    assert "mixed: 1 of 2 targets lie where no depth can be learnt" in caplog.text


def test_a_run_on_a_dataset_that_is_not_there_says_so_and_leaves_nothing_to_resume(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    text = tiny.TOML.replace("[schedule]", f'[[data.datasets]]\npath = "{nowhere}"\nshare = 1.0\n[schedule]')
    with pytest.raises(ConfigError, match=rf"^{nowhere} is not a folder$"):
        run_training(parse_config(text, "own.toml"), text, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*.pt"))


def test_what_is_validated_on_is_not_trained_on_under_another_name(dataset: Path, tmp_path: Path) -> None:
    for split in ("train_pbr", "val"):
        shutil.copytree(dataset / "train", tmp_path / "own" / split)
    for sources in (
        [{"split": "train", "validation_split": "train_pbr"}],
        [{"split": "train", "validation_split": "val"}, {"split": "val"}],
        [{"split": "val"}, {"split": "train", "validation_split": "val"}],
    ):
        datasets = [{"path": str(tmp_path / "own"), "share": 0.5} | source for source in sources]
        told = {"seed": 1, "validation_seed": 2, "batch_size": 8, "datasets": datasets}
        with pytest.raises(ConfigError, match="is both trained on and validated on"):
            refuse_unreadable(DataConfig.model_validate(told))


def test_refining_with_no_share_of_the_datasets_takes_none(dataset: Path) -> None:
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, airframe_ids=[0, 3, 6])
    batch = refinement_sampler(data, 12, 96, 1.0, (dataset, dataset), 0.0)().batch(0, 8)
    assert isinstance(batch, SampleBatch)


def test_refining_takes_its_share_of_the_windows_from_datasets(dataset: Path) -> None:
    """Object coordinates are known for rendered windows only."""
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, airframe_ids=[0, 3, 6])
    batch = refinement_sampler(data, 12, 96, 1.0, (dataset,), 0.25)().batch(0, 24)
    assert isinstance(batch, TrainingBatch)
    of_dataset = np.isnan(batch.noc).all(axis=(1, 2, 3))
    assert of_dataset.sum() == 6
    assert not (batch.airframe_id[of_dataset] >= fleet_size()).any()
    assert (batch.airframe_id[~of_dataset & batch.present] >= fleet_size()).all()


def test_a_dataset_to_refine_on_that_is_not_there_is_told_before_anything_is_rendered(tmp_path: Path) -> None:
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, airframe_ids=[0, 3, 6])
    with pytest.raises(ConfigError, match="nowhere"):
        refinement_sampler(data, 12, 96, 0.35, (tmp_path / "nowhere",), 0.5)


def test_held_out_windows_are_of_the_validation_split(dataset: Path) -> None:
    source = f'[[data.datasets]]\npath = "{dataset}"\nshare = 1.0\nvalidation_split = "val"\n[schedule]'
    data = parse_config(tiny.TOML.replace("[schedule]", source), "own.toml").data
    assert stage_sampler(data, 77, 64, 0.0, held_out=False)().batch(0, 4).present.shape == (4,)
    with pytest.raises(ConfigError, match="'val'"):
        stage_sampler(data, 77, 64, 0.0)()
