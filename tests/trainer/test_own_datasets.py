"""Training on one's own datasets: odd files, cameras and splits that must change neither windows nor weights."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from edge.estimator.window import fit_frame
from sim_replay.bop import BopFrame, BopTarget, SceneWriter
from tests.trainer.test_trained_on import discs, on_dataset
from trainer.checkpoint import load_model, save_weights
from trainer.cli import main
from trainer.config import DatasetSource, parse_config
from trainer.dataset_windows import DatasetSampler
from trainer.export import stage_sampler
from trainer.held_out import Request, evaluate_file
from trainer.sources import validated_from, window_sampler
from trainer.train import run_training


def test_a_configuration_with_a_byte_order_mark_gives_weights_that_can_be_used_and_trained_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Some editors put one before UTF-8; it had gone into the checkpoint, which then was not valid TOML."""
    for split in ("train", "val"):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0, 260.0))
    config, run = tmp_path / "own.toml", tmp_path / "run"
    config.write_text("\ufeff" + on_dataset(tmp_path / "own"), encoding="utf-8")
    command = ["train", "--config", str(config), "--out", str(run)]
    assert main([*command, "--samples", "4"]) == 0
    assert load_model(run)[2]["samples"] == 4
    assert "frames of 16:9 will be reduced to a width of 128 px" in caplog.text  # tiny.TOML's
    assert main([*command, "--samples", "8", "--resume"]) == 0
    assert load_model(run)[2]["samples"] == 8


def test_an_aircraft_that_the_list_of_targets_leaves_out_is_not_learnt_as_background(tmp_path: Path) -> None:
    """Of two aircraft in each picture the list has one, which is in the window or not; the other is never judged."""
    discs(tmp_path / "test" / "000001", 1500.0, (200.0, 260.0), beside_px=(-8, 8))
    names = [{"scene_id": 1, "im_id": image, "obj_id": 1, "inst_count": 1} for image in (0, 1)]
    (tmp_path / "test_targets_bop19.json").write_text(json.dumps(names))
    batch = DatasetSampler(tmp_path, "test", 1, 64, 0.0).batch(0, 8)
    assert batch.others.any(axis=(1, 2)).all()


def test_of_an_upright_picture_the_windows_are_reduced_as_the_daemon_reduces_it(tmp_path: Path) -> None:
    """It is letterboxed, so its height decides: 448 of 640 rows are left, where 768 of 360 columns would enlarge it."""
    K = np.array([[1500.0, 0, 180], [0, 1500, 320], [0, 0, 1]])
    image = np.full((640, 360, 3), 128, np.uint8)
    box = np.array([169.5, 309.5, 190.5, 330.5])
    with SceneWriter(tmp_path / "train" / "000001") as writer:
        writer.add(BopFrame(0, K, (BopTarget(1, np.eye(3), np.array([0, 0, 260.0]), box, box, 441, 441),)), image)
    batch = DatasetSampler(tmp_path, "train", 1, 64, 1.0).batch(0, 60)
    scales = batch.K[:, 0, 0] / K[0, 0]
    flown = fit_frame(cv2.imread(str(tmp_path / "train" / "000001" / "rgb" / "000000.jpg")), (768, 448), "letterbox")[1]
    assert scales.min() < flown.scale_xy[0] < scales.max()


def test_acquire_windows_show_the_black_bars_beside_a_frame_and_track_windows_none(tmp_path: Path) -> None:
    """The daemon letterboxes the frame; a network that never saw a bar takes its edge for targets."""
    K, (width, height) = np.array([[1500.0, 0, 319.5], [0, 1500, 239.5], [0, 0, 1]]), (640, 480)
    box, t_m = np.array([9.5, 29.5, 30.5, 50.5]), 260.0 * np.linalg.solve(K, [20.0, 40.0, 1.0])
    with SceneWriter(tmp_path / "train" / "000001") as writer:
        image = np.full((height, width, 3), 150, np.uint8)
        writer.add(BopFrame(0, K, (BopTarget(1, np.eye(3), t_m, box, box, 441, 441),)), image)
    barred = 0
    for acquire_share in (0.0, 1.0):
        batch = DatasetSampler(tmp_path, "train", 1, 128, acquire_share).batch(0, 20)
        for image, K_window in zip(batch.image_bgr, batch.K, strict=True):
            u, v = np.meshgrid(np.arange(128), np.arange(128))
            in_frame = np.stack([u, v, np.ones_like(u)], axis=-1) @ (K @ np.linalg.inv(K_window)).T
            beside = (np.abs(in_frame[..., :2] - K[:2, 2]) - np.array([width, height]) / 2).max(axis=-1)
            assert image[beside < -3].min() > 140
            if acquire_share and (beside > 3).any():
                assert image[beside > 3].max() == 0
                barred += 1
            assert acquire_share or image.min() > 140
    assert 5 < barred < 20


def test_datasets_without_a_validation_split_leave_their_shares_to_the_others_in_proportion(tmp_path: Path) -> None:
    """Of 0.8, 0.1 and 0.1 the first has none: half of what is validated on is of each other, not nearly all of one."""
    depths_m = {"near": 100.0, "far": 300.0}
    for name, depth_m in {**depths_m, "most": 200.0}.items():
        for split in ("train", "val"):
            discs(tmp_path / name / split / "000001", 1500.0, (depth_m,))
    sources = [DatasetSource(path=tmp_path / "most", share=0.8)]
    sources += [DatasetSource(path=tmp_path / name, share=0.1, validation_split="val") for name in depths_m]
    data = tiny.config().data.model_copy(update={"datasets": sources})
    Z_m = stage_sampler(data, 77, 64, 0.0)().batch(0, 20).t_cam_target_m[:, 2]
    assert [int(np.sum(Z_m == depth_m)) for depth_m in depths_m.values()] == [10, 10]


def test_validation_windows_are_also_measured_by_where_they_come_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Improvement on one's own images does not show in the mean with many rendered windows."""
    for split in ("train", "val"):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0, 260.0))
    text = on_dataset(tmp_path / "own").replace("share = 1.0", "share = 0.3")
    config, run = parse_config(text, "own.toml"), tmp_path / "run"
    opened = window_sampler(config.data, config.data.validation_seed, 64)()
    batches = [opened.batch(first, 16) for first in (0, 16)]
    masks = validated_from(config.data, [16, 16])
    on_own = np.isin(np.concatenate([batch.t_cam_target_m[:, 2] for batch in batches]), (200.0, 260.0))
    np.testing.assert_array_equal(masks["own"], on_own)
    np.testing.assert_array_equal(masks["rendered"], ~on_own)
    run_training(config, text, run, max_steps=1)
    assert capsys.readouterr().out.count("validation at 64 px") == 1
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    windows = {line["kind"]: line["windows"] for line in lines if line["kind"] != "train"}
    assert windows == {"validation": 16, "validation/own": 4, "validation/rendered": 12}
    tags = EventAccumulator(str(run / "tensorboard")).Reload().Tags()["scalars"]
    assert {f"{kind}/recall" for kind in windows} <= set(tags)
    assert validated_from(config.data.model_copy(update={"datasets": []}), [16]) == {}


def test_sources_of_one_name_are_measured_each_by_itself(tmp_path: Path) -> None:
    depths_m = {"rendered": 150.0, "here/birds": 200.0, "there/birds": 250.0}
    for name, depth_m in depths_m.items():
        for split in ("train", "val"):
            discs(tmp_path / name / split / "000001", 1500.0, (depth_m,))
    sources = [DatasetSource(path=tmp_path / name, share=0.25, validation_split="val") for name in depths_m]
    data = tiny.config().data.model_copy(update={"datasets": sources})
    Z_m = window_sampler(data, data.validation_seed, 64)().batch(0, 16).t_cam_target_m[:, 2]
    masks = validated_from(data, [16])
    assert masks.keys() == {"rendered", *(str(tmp_path / name)[1:] for name in depths_m)}
    for name, depth_m in depths_m.items():
        np.testing.assert_array_equal(masks[str(tmp_path / name)[1:]], Z_m == depth_m)
    np.testing.assert_array_equal(masks["rendered"], ~np.isin(Z_m, list(depths_m.values())))


def test_rendered_windows_are_rendered_for_a_checkpoint_of_a_dataset_that_is_no_longer_there(tmp_path: Path) -> None:
    text = on_dataset(tmp_path / "moved")
    assert parse_config(text, "own.toml").data.rendered_share == 0.0
    save_weights(tmp_path / "run" / "weights.pt", tiny.network(), text, {"seed": 3, "samples": 0, "commit": "unknown"})
    measured = evaluate_file(Request(tmp_path / "run", samples=16, seed=77, stage="track"))
    assert measured["windows"] == pytest.approx(16.0)
