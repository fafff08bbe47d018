"""Where scenes lie, what they are numbered and which split and dataset they are of, however they are packed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_replay.bop import BopError, find_scenes
from sim_replay.datasets import Dataset, open_dataset
from tests.sim_replay.foreign import K, write_json, write_models_info, write_scene


def numbers(dataset: Dataset) -> dict[str, int]:
    return {scene.folder.name: scene.scene_id for scene in dataset.scenes}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_models_info(tmp_path / "hawks")
    for number in (0, 1, 12):
        write_scene(tmp_path / "hawks" / "test" / f"{number:06d}")
    return tmp_path / "hawks"


def test_numbered_scenes_keep_their_numbers_and_others_count_on_above_them(root: Path) -> None:
    for name in ("000001_old", "000000_copy"):
        write_scene(root / "test" / name)
    assert numbers(open_dataset(root)) == {"000000": 0, "000001": 1, "000012": 12, "000000_copy": 13, "000001_old": 14}


def test_two_scenes_of_one_number_are_refused(root: Path) -> None:
    write_scene(root / "test" / "12")
    write_scene(root / "val" / "000012")  # another split counts for itself
    with pytest.raises(BopError, match=r"test/000012 and .*test/12: both are scene 12 of one split"):
        open_dataset(root)


def test_a_split_is_the_first_folder_below_the_dataset_however_deep_its_scenes_lie(root: Path) -> None:
    for name in ("test/part1/000003", "train/part1/000000", "train/part2/000001"):
        write_scene(root / name)
    assert numbers(open_dataset(root, "test")) == {"000000": 0, "000001": 1, "000003": 3, "000012": 12}
    assert numbers(open_dataset(root, "train")) == {"000000": 0, "000001": 1}
    for folder in (root / "train", root / "train" / "part2", root / "train" / "part2" / "000001"):
        opened = open_dataset(folder)
        assert (opened.split, opened.root, opened.models[1].diameter_m) == ("train", root, 6.0)
    with pytest.raises(BopError, match=r"no split 'part1'; it has test, train"):
        open_dataset(root, "part1")


def test_scenes_by_date_and_flight_are_read_with_the_models_and_axes_of_their_dataset(tmp_path: Path) -> None:
    root, scene = tmp_path / "kites", tmp_path / "kites" / "train" / "2026-05-01" / "morning" / "000003"
    write_scene(scene)
    write_models_info(root)
    (root / "model_frame.toml").write_text("R_body_model = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\n")
    for dataset in (open_dataset(root), open_dataset(root, "train"), open_dataset(scene)):
        assert (dataset.split, dataset.root, dataset.models[1].diameter_m) == ("train", root, 6.0)
        (target,) = next(dataset.frames()).targets
        assert target.R_cam_target.diagonal().tolist() == [1.0, -1.0, -1.0]


def test_a_camera_for_all_holds_for_scenes_by_date_and_flight(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "kites" / "train" / "2026-05-01" / "morning" / "000003")
    (scene / "scene_camera.json").unlink()
    write_json(tmp_path / "kites" / "camera.json", {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5]})
    frame = next(open_dataset(tmp_path / "kites", "train").frames())
    assert frame.K.ravel().tolist() == K


def test_an_imagewise_split_may_lie_deeper_too(root: Path) -> None:
    (root / "val" / "shard").mkdir(parents=True)
    for key in ("000005_000001", "000006_000001"):
        (root / "val" / "shard" / f"{key}.camera.json").write_text("{}")
    assert [(scene.scene_id, scene.split) for scene in open_dataset(root, "val").scenes] == [(5, "val"), (6, "val")]
    assert open_dataset(root / "val" / "shard").split == "val"


def test_two_datasets_are_not_taken_for_one(root: Path, tmp_path: Path) -> None:
    write_models_info(tmp_path / "kites")
    write_scene(tmp_path / "kites" / "test" / "000000")
    with pytest.raises(BopError, match=r"more than one dataset: .*hawks, .*kites; name one"):
        open_dataset(tmp_path)
    assert len(find_scenes(tmp_path)) == 4  # `stats` counts them all
    write_scene(tmp_path / "loose" / "000007")
    with pytest.raises(BopError, match=r"more than one dataset: .*that of .*loose/000007"):
        open_dataset(tmp_path)


def test_scenes_with_a_camera_each_and_no_models_are_one_dataset(tmp_path: Path) -> None:
    for name in ("pass_a", "pass_b"):
        scene = write_scene(tmp_path / "flown" / name)
        (scene / "camera.json").write_text(json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1}))
    assert numbers(open_dataset(tmp_path / "flown")) == {"pass_a": 0, "pass_b": 1}


def test_scenes_with_a_camera_each_and_no_models_have_the_splits_that_their_folders_say(tmp_path: Path) -> None:
    """As `uavpose-replay generate` writes them, where only the scenes were copied."""
    for name in ("train/000001", "val/000001", "val/000002"):
        scene = write_scene(tmp_path / "skies" / name)
        (scene / "camera.json").write_text(json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1}))
    assert numbers(open_dataset(tmp_path / "skies", "train")) == {"000001": 1}
    assert numbers(open_dataset(tmp_path / "skies", "val")) == {"000001": 1, "000002": 2}
    assert open_dataset(tmp_path / "skies" / "val" / "000002").split == "val"
