"""Labels that do not belong together are told, before a night of training on them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_replay.benchmark.stats import dataset_statistics
from sim_replay.bop import BopError
from sim_replay.datasets import open_dataset
from tests.sim_replay.foreign import BOX, K, write_json, write_models_info, write_scene

PICTURES = (0, 7, 8, 40)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two scenes of four pictures, each with one target 5 m wide at 200 m."""
    write_models_info(tmp_path)
    for number in (3, 8):
        scene = write_scene(tmp_path / "train" / f"{number:06d}", PICTURES)
        write_json(scene / "scene_gt_info.json", {str(i): [{"bbox_visib": BOX}] for i in PICTURES})
    return tmp_path


def write_cameras(scene: Path, K_of_pictures: list[float]) -> None:
    write_json(scene / "scene_camera.json", {str(i): {"cam_K": K_of_pictures} for i in PICTURES})


def enlarged(factor: float) -> list[float]:
    """The K of pictures so many times as large."""
    fx, _, cx, _, fy, cy, *_ = K
    edge = 0.5 * (factor - 1)
    return [fx * factor, 0, cx * factor + edge, 0, fy * factor, cy * factor + edge, 0, 0, 1]


def test_labels_that_belong_together_are_not_told_of(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert len(open_dataset(root).boxed_frames()) == 8
    assert caplog.text == ""
    assert dataset_statistics(root)["beside_box_share"] == 0.0


@pytest.mark.parametrize("factor", [0.25, 2.0, 4.0])
def test_a_camera_matrix_of_another_picture_size_is_told_and_not_trained_on(
    root: Path, factor: float, caplog: pytest.LogCaptureFixture
) -> None:
    write_cameras(root / "train" / "000008", enlarged(factor))
    assert len(open_dataset(root).boxed_frames()) == 8  # the other scene can be learnt from
    assert "in scene train/000008, most poses project beside their boxes: is cam_K in pixels" in caplog.text
    caplog.clear()
    write_cameras(root / "train" / "000003", enlarged(factor))
    assert len(open_dataset(root).labelled_frames()) == 8  # poses in space can be compared all the same
    assert "in scene train/000003 and 1 more, most poses project beside their boxes" in caplog.text
    with pytest.raises(BopError, match="most poses project beside their boxes"):
        open_dataset(root).boxed_frames()
    assert dataset_statistics(root)["beside_box_share"] == 1.0


def test_the_whole_box_of_a_target_cut_by_the_edge_says_where_it_is(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Only its tail is seen: its origin is far from what is seen of it."""
    for scene in (root / "train").iterdir():
        poses = json.loads((scene / "scene_gt.json").read_text())
        for (pose,) in poses.values():
            pose["cam_t_m2c"][0] = -16000.0  # its origin projects 16 px beside the picture
        write_json(scene / "scene_gt.json", poses)
        seen = {"bbox_visib": [0, 40, 4, 12], "bbox_obj": [-26, 40, 30, 12], "px_count_visib": 30, "px_count_all": 90}
        write_json(scene / "scene_gt_info.json", {key: [seen] for key in poses})
    assert len(open_dataset(root).boxed_frames()) == 8
    assert caplog.text == ""


@pytest.mark.parametrize("diameter_mm", [6.0, 6e6])
def test_a_model_in_another_unit_than_the_poses_is_told(
    root: Path, diameter_mm: float, caplog: pytest.LogCaptureFixture
) -> None:
    write_models_info(root, diameter=diameter_mm)
    open_dataset(root).labelled_frames()
    assert "targets look as many times as large as their model: obj_id 1 " in caplog.text
    assert "millimetres" in caplog.text


def test_rough_boxes_of_small_targets_are_not_told_of(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """0.8 m at 200 m are 5 px here; a box drawn by hand is soon twice as large."""
    write_models_info(root, diameter=800.0)
    for scene in (root / "train").iterdir():
        write_json(scene / "scene_gt_info.json", {str(i): [{"bbox_visib": [60, 41, 10, 8]}] for i in PICTURES})
    open_dataset(root).boxed_frames()
    assert caplog.text == ""
