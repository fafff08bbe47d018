"""Which targets of others' datasets an image shows, where little or nothing tells: those alone can be missed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sim_replay.bop import BopError, read_scene
from sim_replay.datasets import open_dataset
from sim_replay.evaluation.judge import Answer, judge_frames, score_of, truths_of
from sim_replay.score import TargetPose
from tests.sim_replay.foreign import BOX, SIZE_WH, T_MM, UNIT, silhouette, write_json, write_scene

ASIDE_MM = [60000.0, 0.0, 200000.0]  # 360 px from the middle of an image 160 px wide


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "hawks" / "test" / "000001", masks=False)


def put(scene: Path, *places_mm: list[float], object_id: int = 1) -> None:
    poses = [{"obj_id": object_id, "cam_R_m2c": UNIT, "cam_t_m2c": place} for place in places_mm]
    write_json(scene / "scene_gt.json", {"0": poses})


def listed(scene: Path, **line: int) -> None:
    write_json(scene.parents[1] / "test_targets_bop19.json", [{"scene_id": 1, "im_id": 0, "obj_id": 1} | line])


def sizes(scene: Path, **models: float) -> None:
    write_json(scene.parents[1] / "models" / "models_info.json", {"1": {"diameter": 6000.0} | models})


@pytest.mark.parametrize(("aside_mm", "seen"), [(60000.0, False), (14000.0, True)])
def test_of_a_target_that_only_its_diameter_tells_of_it_is_known_whether_the_image_can_show_it(
    scene: Path, aside_mm: float, seen: bool
) -> None:
    """14 m are 84 px, 4 px beyond the edge: a wing may still reach in."""
    sizes(scene)
    put(scene, T_MM, [aside_mm, 0.0, 200000.0])
    dataset = open_dataset(scene)
    (frame,) = dataset.labelled_frames()
    assert [truth.t_cam_target_m[0] for truth in truths_of(0, frame, dataset.models)] == [-3.0, *[14.0] * seen]
    assert frame.targets[0].box_visible_xyxy_px is None, "a diameter tells of no box"


@pytest.mark.parametrize("told_by", ["masks", "model"])
def test_of_too_many_instances_the_most_visible_count_whatever_tells_of_them(scene: Path, told_by: str) -> None:
    """The first is cut by the edge, or beside it; the second is whole."""
    half_mm = {f"{kind}_{axis}": value for axis in "xyz" for kind, value in (("min", -2e3), ("size", 4e3))}
    sizes(scene, **(half_mm if told_by == "model" else {}))
    put(scene, ASIDE_MM, T_MM)
    if told_by == "masks":
        for index, width in enumerate((3, 30)):
            mask = np.zeros(SIZE_WH[::-1], np.uint8)
            mask[40:52, :width] = 255
            (scene / "mask_visib").mkdir(exist_ok=True)
            cv2.imwrite(str(scene / "mask_visib" / f"000000_{index:06d}.png"), mask)
    listed(scene, inst_count=1)
    (frame,) = open_dataset(scene).labelled_frames()
    assert frame.target_indices == (1,)
    assert [target.t_cam_target_m[0] for target in (*frame.targets, *frame.unlisted)] == [-3.0, 60.0]


@pytest.mark.parametrize("line", [{"obj_id": 5}, {"inst_count": 2}])
def test_listed_targets_that_the_ground_truth_does_not_have_are_told(
    scene: Path, caplog: pytest.LogCaptureFixture, line: dict[str, int]
) -> None:
    sizes(scene)
    listed(scene)
    assert len(list(open_dataset(scene).frames())) == 1
    assert not caplog.records
    listed(scene, **line)
    assert len(list(open_dataset(scene).frames())) == 1
    assert "test_targets_bop19.json: 1 of the targets that it lists are not in the ground truth" in caplog.text
    caplog.clear()
    (scene / "scene_gt.json").unlink()
    assert len(list(open_dataset(scene).frames())) == 1
    assert not caplog.records, "a ground truth that nobody published lacks nothing"


def test_a_target_with_a_box_whose_pixels_nobody_counted_is_seen(scene: Path) -> None:
    """As tools without masks write it: all counts are 0."""
    sizes(scene)
    write_json(scene / "scene_gt_info.json", {"0": [{"bbox_visib": BOX, "px_count_visib": 0, "px_count_all": 0}]})
    dataset = open_dataset(scene)
    assert len(truths_of(0, dataset.boxed_frames()[0], dataset.models)) == 1


@pytest.mark.parametrize("counted", [{"px_count_all": 99}, {}])
def test_a_visible_box_of_a_target_that_is_counted_as_hidden_is_refused(scene: Path, counted: dict[str, int]) -> None:
    write_json(scene / "scene_gt_info.json", {"0": [{"bbox_visib": BOX, "px_count_visib": 0} | counted]})
    with pytest.raises(
        BopError, match=r"scene_gt_info\.json: '0' has a 'bbox_visib' of obj_id 1, but 'px_count_visib'"
    ):
        read_scene(scene)


@pytest.mark.parametrize(
    ("left_px", "tracked", "aside_m", "false_alarms", "per_1000"),
    [
        (SIZE_WH[0] - 5, False, 59.0, 0, None),  # hidden in the picture
        (SIZE_WH[0] + 5, False, 59.0, 1, 1000.0),
        (SIZE_WH[0] + 5, True, 59.0, 0, 0.0),
        (SIZE_WH[0] + 5, True, -40.0, 1, 1000.0),
    ],
)
def test_what_has_left_the_picture_is_not_hidden_in_it_and_a_tracker_may_still_tell_of_it(
    scene: Path, left_px: int, tracked: bool, aside_m: float, false_alarms: int, per_1000: float | None
) -> None:
    """bop_toolkit counts an outline's pixels, and draws its box, wherever they lie."""
    sizes(scene)
    put(scene, ASIDE_MM, [0.0, 0.0, 0.0])  # the other one is nowhere: some list it at the origin
    info = {"bbox_visib": [-1] * 4, "bbox_obj": [left_px, 40, 30, 12], "px_count_visib": 0, "px_count_all": 250}
    write_json(scene / "scene_gt_info.json", {"0": [info, {"bbox_visib": [-1] * 4, "px_count_visib": 0}]})
    dataset = open_dataset(scene)
    told = Answer((TargetPose(0, np.eye(3), np.array([aside_m, 0.0, 190.0])),), None, () if tracked else None)
    frames = judge_frames(dataset.labelled_frames(), dataset.models, lambda *_: told)
    overall = score_of(dataset, {}, frames)["overall"]
    assert (overall["targets"], overall["false_poses"], overall["false_positives_per_1000"]) == (
        0,
        false_alarms,
        per_1000,
    )


@pytest.mark.parametrize("hidden", [True, False])
def test_masks_alone_tell_what_is_entirely_hidden_from_what_is_not_there(scene: Path, hidden: bool) -> None:
    sizes(scene)
    for kind, shown in (("mask", hidden), ("mask_visib", False)):
        (scene / kind).mkdir()
        cv2.imwrite(str(scene / kind / "000000_000000.png"), silhouette() * shown)
    dataset = open_dataset(scene)
    told = Answer((TargetPose(0, np.eye(3), np.array(T_MM) / 1e3),), None)
    score = score_of(dataset, {}, judge_frames(dataset.labelled_frames(), dataset.models, lambda *_: told))
    assert score["overall"]["false_positives_per_1000"] == (None if hidden else 1000.0)
