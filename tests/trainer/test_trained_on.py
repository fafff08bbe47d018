"""What a network was trained on, as its model files tell it, and datasets on which nothing can be measured."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny
from synthetic_sampler import PlateSampler

from msgs.contract import ModelContract
from sim_replay.bop import BopFrame, BopTarget, SceneWriter
from trainer.checkpoint import save_weights
from trainer.comparison import Tolerance, Views
from trainer.config import ConfigError, parse_config
from trainer.data import training_batch
from trainer.dataset_windows import DatasetSampler
from trainer.export import data_told, export_models, make_contract
from trainer.graph import read_contract
from trainer.sources import refuse_unreadable
from trainer.train import run_training

ANY = Tolerance(180.0, 100.0, 100.0, 100.0, 100.0)
WIDTH, HEIGHT, RADIUS_PX = 640, 360, 12


def discs(scene: Path, focal_px: float, Z_m: tuple[float, ...], beside_px: tuple[int, ...] = (0,)) -> None:
    """A picture for each depth, with a red disc at each place beside the middle."""
    K = np.array([[focal_px, 0, WIDTH / 2], [0, focal_px, HEIGHT / 2], [0, 0, 1]])
    with SceneWriter(scene, jpeg_quality=95) as writer:
        for image_id, depth_m in enumerate(Z_m):
            image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
            masks, targets = [], []
            for beside in beside_px:
                centre = np.array([WIDTH // 2 + beside, HEIGHT // 2])
                mask = np.zeros((HEIGHT, WIDTH), np.uint8)
                cv2.circle(image, centre.tolist(), RADIUS_PX, (0, 0, 255), -1)
                cv2.circle(mask, centre.tolist(), RADIUS_PX, 255, -1)
                box = np.concatenate([centre - RADIUS_PX - 0.5, centre + RADIUS_PX + 0.5])
                t_m = depth_m * np.linalg.solve(K, [*centre, 1.0])
                pixels = int(np.count_nonzero(mask))
                targets.append(BopTarget(1, np.eye(3), t_m, box, box, pixels, pixels))
                masks.append(mask > 0)
            writer.add(BopFrame(image_id, K, tuple(targets)), image, masks)


def on_dataset(root: Path, contract: str = "") -> str:
    source = f'[[data.datasets]]\npath = "{root}"\nvalidation_split = "val"\nshare = 1.0\n[schedule]'
    return tiny.TOML.replace("[schedule]", source) + contract


def exported(folder: Path, text: str) -> ModelContract:
    """The INT8 file's, of an untrained network said to be of that configuration."""
    run = folder / "run"
    save_weights(run / "weights.pt", tiny.network(), text, {"seed": 3, "samples": 0, "commit": "unknown"})
    files = export_models(run, folder / "models", samples=16, tolerance=ANY, say=lambda _: None)
    contracts = [read_contract(path) for path in files]
    assert contracts[0].trained_range_m == contracts[1].trained_range_m
    return contracts[1]


def test_the_contract_tells_what_was_trained_on_and_not_what_was_measured_on(tmp_path: Path) -> None:
    """The daemon widens its covariances beyond it: a network that saw 70 to 90 m knows nothing of 400."""
    discs(tmp_path / "own" / "train" / "000001", 1500.0, (69.5, 80.0, 90.5))
    discs(tmp_path / "own" / "val" / "000002", 150_000.0, (400.0, 450.0))
    contract = exported(tmp_path, on_dataset(tmp_path / "own"))
    assert contract.trained_range_m == (69.0, 91.0)
    assert contract.trained_focal_px[1] < 15_000.0


def test_a_dataset_is_told_by_its_name_also_if_it_is_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`calibrate-score` knows by it the images that were trained on."""
    (tmp_path / "hawks" / "runs").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "hawks" / "runs")
    for written, name in ((".", "runs"), ("..", "hawks"), ("/data/kites/", "kites")):
        assert data_told(parse_config(on_dataset(Path(written)), "own.toml").data) == f"{name}, split train: 100%"


def test_a_range_that_the_configuration_tells_is_the_contracts(tmp_path: Path) -> None:
    discs(tmp_path / "own" / "train" / "000001", 1500.0, (69.5, 80.0, 90.5))
    config = parse_config(on_dataset(tmp_path / "own", "trained_range_m = [60.0, 95.0]\n"), "own.toml")
    rendered = training_batch(PlateSampler(5, 64).batch(0, 8))
    contract = make_contract(config, {}, "0" * 64, Views([rendered], [rendered]), (0.3, 0.3))
    assert contract.trained_range_m == (60.0, 95.0)


def test_a_dataset_of_a_small_share_adds_all_the_depths_of_its_labels(tmp_path: Path) -> None:
    discs(tmp_path / "own" / "train" / "000001", 1500.0, (60.5, *np.linspace(200.0, 210.0, 30), 590.5))
    config = parse_config(on_dataset(tmp_path / "own").replace("share = 1.0", "share = 0.02"), "own.toml")
    rendered = training_batch(PlateSampler(5, 64).batch(0, 8))
    contract = make_contract(config, {}, "0" * 64, Views([rendered], [rendered]), (0.3, 0.3))
    assert contract.trained_range_m == (60.0, 591.0)


def test_rendered_windows_are_of_100_to_500_m_and_a_dataset_beside_them_adds_its_own(tmp_path: Path) -> None:
    discs(tmp_path / "own" / "train" / "000001", 1500.0, (69.5, 80.0))
    config = parse_config(on_dataset(tmp_path / "own").replace("share = 1.0", "share = 0.7"), "own.toml")
    rendered = training_batch(PlateSampler(5, 64).batch(0, 8))
    own = DatasetSampler(tmp_path / "own", "train", 1, 64, 0.0).batch(0, 8)
    contract = make_contract(config, {}, "0" * 64, Views([rendered], [own]), (0.3, 0.3))
    assert contract.trained_range_m == (69.0, 500.0)


def test_where_every_window_shows_two_aircraft_int8_is_held_against_fp32_by_the_rest(tmp_path: Path) -> None:
    for split in ("train", "val"):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0, 260.0), beside_px=(-8, 8))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        contract = exported(tmp_path, on_dataset(tmp_path / "own"))
    assert contract.precision == "int8"
    assert "track_pose_10deg_5pct" not in contract.metrics


def test_an_export_whose_held_out_windows_show_no_target_says_so(tmp_path: Path) -> None:
    """A validation split with a target in one of hundreds of images may give no window with it."""
    for split, beside_px in (("train", (0,)), ("val", ())):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0, 260.0), beside_px)
    with pytest.raises(ConfigError, match="none of the held-out windows of the track stage shows a target"):
        exported(tmp_path, on_dataset(tmp_path / "own"))
    assert not list((tmp_path / "models").iterdir())


@pytest.mark.parametrize(("empty", "purpose"), [("train", "train"), ("val", "validate")])
def test_pictures_that_show_no_target_are_refused_before_the_first_step(
    tmp_path: Path, empty: str, purpose: str
) -> None:
    for split in ("train", "val"):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0,), beside_px=() if split == empty else (0,))
    text = on_dataset(tmp_path / "own")
    with pytest.raises(ConfigError, match=f"no image to {purpose} on shows a target"):
        run_training(parse_config(text, "own.toml"), text, tmp_path / "run", max_steps=1)
    assert not (tmp_path / "run").exists()
    # Beside rendered windows, they show what is no aircraft.
    refuse_unreadable(parse_config(text.replace("share = 1.0", "share = 0.5"), "own.toml").data)


def test_a_range_that_runs_backwards_is_named_before_hours_of_training() -> None:
    with pytest.raises(ConfigError, match=r"own\.toml: contract\.trained_range_m: .*the lower one first"):
        parse_config(tiny.TOML + "trained_range_m = [500.0, 100.0]\n", "own.toml")
