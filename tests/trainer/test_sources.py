"""What training windows are drawn from, as the configuration says, and that none of it is in what is judged by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny

from sim_replay.airframes import AIRFRAMES
from sim_replay.bop import find_scenes
from tests.sim_replay.foreign import T_MM, write_models_info, write_scene
from tests.sim_replay.test_flown import fly
from trainer.config import ConfigError, DataConfig, DatasetSource
from trainer.data import TrainingBatch
from trainer.refine import fleet_size
from trainer.sources import refinement_sampler, refuse_unreadable, warn_of_unseen_reduction, window_sampler

DATA = tiny.config().data.model_copy(update={"empty_share": 0.0})


@pytest.mark.parametrize(("seed", "held_out", "invents"), [(5, False, True), (5, True, False), (4, False, False)])
def test_training_draws_its_share_of_invented_aircraft_and_the_judge_none(
    seed: int, held_out: bool, invents: bool
) -> None:
    """4 is the seed of the validation windows."""
    data = DATA.model_copy(update={"invented_share": 0.5})
    batch = window_sampler(data, seed, 64, held_out)().batch(0, 30)
    assert 0.2 < np.mean(batch.airframe_id >= fleet_size()) < 0.8 if invents else batch.airframe_id.max() < fleet_size()


@pytest.mark.parametrize(("seed", "held_out", "share"), [(5, False, 7 / 8), (5, True, 1 / 2), (4, False, 1 / 2)])
def test_training_draws_hard_airframes_more_often_and_the_judge_all_alike(
    seed: int, held_out: bool, share: float
) -> None:
    data = DATA.model_copy(update={"airframe_ids": [3, 6], "hard_airframe_ids": [6] * 6})
    ids = window_sampler(data, seed, 64, held_out)().batch(0, 48).airframe_id
    ids = ids[ids >= 0]  # -1: a window that shows too little of its target
    assert set(ids) == {3, 6}
    assert np.mean(ids == 6) == pytest.approx(share, abs=0.17)


def test_training_shows_its_share_of_flown_frames_and_the_judge_none(tmp_path: Path) -> None:
    dataset = fly(tmp_path, "--undistorted")
    flown_m = np.array([frame.targets[0].t_cam_target_m for scene in find_scenes(dataset) for frame in scene.frames])
    data = DATA.model_copy(update={"flown": [dataset], "flown_share": 0.5, "acquire_share": 0.0})
    samplers = {
        "train": window_sampler(data, 5, 64),
        "refine": refinement_sampler(data, 5, 64, 0.0),
        "validate": window_sampler(data, data.validation_seed, 64),
    }
    for purpose, sampler in samplers.items():
        t_m = sampler().batch(0, 16).t_cam_target_m
        of_flight = np.abs(t_m[:, None] - flown_m).max(axis=-1).min(axis=-1) < 1e-3
        assert of_flight.any() == (purpose != "validate"), purpose
        assert not of_flight.all(), purpose
    shown = {frame.targets[0].object_id - 1 for scene in find_scenes(dataset) for frame in scene.frames}
    others = data.model_copy(update={"airframe_ids": [next(n for n in range(len(AIRFRAMES)) if n not in shown)]})
    with pytest.raises(ConfigError, match="none of its frames shows one of the airframes to train on"):
        window_sampler(others, 5, 64)


def test_datasets_to_refine_on_share_alike_in_what_they_are_given(tmp_path: Path) -> None:
    """Half of 24 windows are of two datasets, of which one shows its targets twice as far."""
    depths_m = (T_MM[2] / 1e3, 2 * T_MM[2] / 1e3)
    for name, depth_m in zip(("near", "far"), depths_m, strict=True):
        write_models_info(tmp_path / name)
        scene = write_scene(tmp_path / name / "train" / "000000")
        text = (scene / "scene_gt.json").read_text()
        (scene / "scene_gt.json").write_text(text.replace(str(T_MM[2]), str(1e3 * depth_m)))
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, acquire_share=0.0)
    batch = refinement_sampler(data, 12, 64, 0.0, (tmp_path / "near", tmp_path / "far"), 0.5)().batch(0, 24)
    assert isinstance(batch, TrainingBatch)
    Z_m = batch.t_cam_target_m[np.isnan(batch.noc).all(axis=(1, 2, 3)), 2]
    assert [int(np.sum(Z_m == depth_m)) for depth_m in depths_m] == [6, 6]


def test_who_trains_on_datasets_alone_and_validates_on_none_validates_on_rendered_windows(tmp_path: Path) -> None:
    write_models_info(tmp_path)
    write_scene(tmp_path / "train" / "000000")
    source = DatasetSource(path=tmp_path, share=1.0)
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, acquire_share=0.0, empty_share=0.0, datasets=[source])
    refuse_unreadable(data)
    for seed, of_dataset in ((1, True), (2, False)):
        labels = window_sampler(data, seed, 64)().batch(0, 8).noc
        assert (np.isnan(labels).all(axis=(1, 2, 3)) == of_dataset).all()


@pytest.mark.parametrize(
    ("size_wh", "width_px"), [((384, 224), 384), ((1600, 896), 1593), ((1600, 448), None), ((768, 448), None)]
)
def test_an_acquire_stage_for_frames_of_a_size_that_no_window_has_is_warned_of(
    size_wh: tuple[int, int], width_px: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    contract = tiny.config().contract
    warn_of_unseen_reduction(contract.model_copy(update={"acquire_size_wh": size_wh}))
    assert (f"acquire_size_wh: frames of 16:9 will be reduced to a width of {width_px} px, but" in caplog.text) == (
        width_px is not None
    )
    assert (caplog.text == "") == (width_px is None)
