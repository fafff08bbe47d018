"""BOP results files against poses, and what the figures of an evaluation are made of."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.errors import InputError
from msgs.geometry import R_FORWARD_CAM
from sim_replay.bop import BopScene, Model, ModelFrame, ModelFrames
from sim_replay.datasets import Dataset, DatasetFrame, open_dataset
from sim_replay.evaluation.bop_results import file_answers, read_results, results_name, write_results
from sim_replay.evaluation.figures import cumulative_error, sequence
from sim_replay.evaluation.files import frame_record
from sim_replay.evaluation.judge import Answer, JudgedFrame, judge_frames
from sim_replay.evaluation.worst import badness, worst_matches, write_worst
from sim_replay.report.peer import coordinates
from sim_replay.score import Match, TargetPose, Truth

HEADER = "scene_id,im_id,obj_id,score,R,t,time\n"
EYE = "1 0 0 0 1 0 0 0 1"


def picture(scene: BopScene, image_id: int) -> DatasetFrame:
    return DatasetFrame(scene.scene_id, image_id, np.eye(3), None, Path("none.jpg"), (), scene, ())


def judged(scene: BopScene, image_id: int, truth: Truth, estimate: TargetPose | None) -> JudgedFrame:
    return JudgedFrame(picture(scene, image_id), (Match(truth, estimate),), (), 12.5)


def truth(R: np.ndarray, t_m: np.ndarray, frame: int = 0, object_id: int = 3) -> Truth:
    return Truth(frame, R, t_m, object_id, 12.0, "delta")


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_written_results_mean_the_same_poses_when_read_whatever_the_model_axes(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    frame = ModelFrame(Rotation.random(rng=rng).as_matrix(), rng.uniform(-2, 2, 3))
    scene = BopScene(Path("scene"), 7, models=ModelFrames(by_object={3: frame}))
    R_body, t_body_m = Rotation.random(rng=rng).as_matrix(), rng.uniform(-400, 400, 3)
    pose = TargetPose(0, R_body, t_body_m, score=0.75)
    path = tmp_path_factory.mktemp("results") / "m_d-test.csv"
    write_results(path, [judged(scene, 41, truth(R_body, t_body_m), pose)])
    (row,) = read_results(path)
    assert (row.scene_id, row.image_id, row.object_id, row.score, row.time_s) == (7, 41, 3, 0.75, 0.0125)
    # A point of the model, in the file's own axes and in body axes, lies at one place.
    x_model = rng.uniform(-5, 5, 3)
    x_body = frame.R_body_model @ x_model + frame.t_body_model_m
    np.testing.assert_allclose(
        row.R_cam_model @ x_model + row.t_cam_model_m, R_body @ x_body + t_body_m, rtol=0, atol=1e-5
    )
    R, t_m = frame.pose_of_body(row.R_cam_model, row.t_cam_model_m)
    np.testing.assert_allclose(R, R_body, atol=1e-8)
    np.testing.assert_allclose(t_m, t_body_m, atol=1e-5)


def test_a_hand_written_file_answers_for_its_pictures(dark_spot_scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "m_dataset-test.csv"
    path.write_text(
        HEADER
        + f"0,1,1,0.9,{EYE},-15000 0 200000,0.25\n"
        + f"0,1,1,0.1,{EYE},90000.5 0 200000,0.25\n"
        + f"5,1,1,0.9,{EYE},0 0 200000,-1\n"
    )
    dataset = open_dataset(dark_spot_scene.parents[1])
    pictures = list(dataset.frames())
    results = judge_frames(pictures, dataset.models, file_answers(path, dataset))
    found = [[match.estimate is not None for match in frame.matches] for frame in results]
    assert found == [[False], [True], [False], [False], []]
    assert [len(frame.false_poses) for frame in results] == [0, 1, 0, 0, 0]
    assert results[1].time_ms == 250.0
    assert results[0].time_ms is None
    match = results[1].matches[0]
    assert match.translation_error_m == pytest.approx(0.0, abs=1e-9)
    assert results[1].false_poses[0].t_cam_target_m[0] == pytest.approx(90.0005)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "line 1: its columns are not scene_id,im_id"),
        ("scene,image\n", "line 1: its columns are not scene_id,im_id"),
        (HEADER + "0,1,1,0.9\n", "line 2: 4 columns, not 7"),
        (HEADER + f"0,1,1,high,{EYE},0 0 1,-1\n", "line 2: score is not a number: 'high'"),
        (HEADER + f"0,1,1,1,{EYE},0 0,-1\n", "line 2: t is not 3 finite numbers"),
        (HEADER + f"0,1,1,1,{EYE},0 0 nan,-1\n", "line 2: t is not 3 finite numbers"),
        (HEADER + f"0,1,1,1,{EYE},0 0 1e300,-1\n", "line 2: t is not 3 finite numbers"),
        (HEADER + f"0,1,1,1,{EYE},0 -1e300 1,-1\n", "line 2: t is not 3 finite numbers"),
        (HEADER + f"0,1,1,1,{EYE},0 0 1,1e300\n", "line 2: time is not 1 finite number"),
        (HEADER + f"0.5,1,1,1,{EYE},0 0 1,-1\n", "line 2: scene_id is not a whole number: '0.5'"),
        (HEADER + f"0,1.5,1,1,{EYE},0 0 1,-1\n", "line 2: im_id is not a whole number: '1.5'"),
        (HEADER + "0,1,1,1,1 0 0 0 1 0 0 0 -1,0 0 1,-1\n", "line 2: R is not a rotation"),
        (HEADER + "0,1,1,1,2 0 0 0 2 0 0 0 2,0 0 1,-1\n", "line 2: R is not a rotation"),
        (HEADER + "0,1,1,1,.5 0 0 0 .5 0 0 0 .5,0 0 1,-1\n", "line 2: R is not a rotation"),
    ],
)
def test_a_bad_row_is_named(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "results.csv"
    path.write_text(content)
    with pytest.raises(InputError) as error:
        read_results(path)
    assert str(path) in str(error.value)
    assert words in str(error.value)


def test_a_spreadsheets_mark_before_the_header_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text(HEADER + f"0,1,1,1,{EYE},0 0 1000,-1\n", encoding="utf-8-sig")
    assert [row.image_id for row in read_results(path)] == [1]


def test_results_of_another_dataset_are_refused(dark_spot_scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "m_other-test.csv"
    path.write_text(HEADER + f"4,1,1,0.9,{EYE},0 0 1000,-1\n")
    with pytest.raises(InputError, match="is a picture of dataset"):
        file_answers(path, open_dataset(dark_spot_scene.parents[1]))


def test_two_splits_with_one_scene_number_need_a_choice(dark_spot_scene: Path, tmp_path: Path) -> None:
    shutil.copytree(dark_spot_scene, dark_spot_scene.parents[1] / "val" / "000000")
    path = tmp_path / "m_dataset-test.csv"
    path.write_text(HEADER + f"0,1,1,0.9,{EYE},-15000 0 200000,-1\n")
    with pytest.raises(InputError, match="give --split"):
        file_answers(path, open_dataset(dark_spot_scene.parents[1]))
    dataset = open_dataset(dark_spot_scene.parents[1], "val")
    results = judge_frames(list(dataset.frames()), dataset.models, file_answers(path, dataset))
    assert sum(match.estimate is not None for frame in results for match in frame.matches) == 1


def test_the_results_name_parts_at_one_underscore() -> None:
    scene = BopScene(Path("scene"), 0)
    assert results_name("my_net", Dataset("fw_uav", Path(), "test", (scene,))) == "my-net_fw-uav-test.csv"


def test_an_object_without_a_model_is_named(dark_spot_scene: Path) -> None:
    dataset = open_dataset(dark_spot_scene.parents[1])
    with pytest.raises(InputError, match="obj_id 1"):
        judge_frames(list(dataset.frames()), {2: Model(1.0)}, lambda *_: Answer((), None))


def test_a_target_that_is_wholly_hidden_is_not_missed(dark_spot_scene: Path) -> None:
    seen = {"bbox_visib": [1, 1, 5, 5], "bbox_obj": [1, 1, 5, 5], "px_count_visib": 25, "px_count_all": 25}
    hidden = seen | {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": 0}
    info = {str(k): [hidden if k == 2 else seen] for k in range(4)}
    (dark_spot_scene / "scene_gt_info.json").write_text(json.dumps(info | {"4": []}))
    dataset = open_dataset(dark_spot_scene.parents[1])
    results = judge_frames(list(dataset.frames()), dataset.models, lambda *_: Answer((), None))
    assert [len(frame.matches) for frame in results] == [1, 1, 0, 1, 0]


def test_angles_over_a_sequence_are_those_of_scipy_against_the_camera() -> None:
    rng = np.random.default_rng(3)
    poses = [TargetPose(k, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)) for k in range(20)]
    got = coordinates(poses)
    for row, pose in zip(got, poses, strict=True):
        yaw, pitch, roll = Rotation.from_matrix(R_FORWARD_CAM @ pose.R_cam_target).as_euler("ZYX", degrees=True)
        np.testing.assert_allclose(row, [*pose.t_cam_target_m, roll, pitch, yaw], atol=1e-6)
    level = TargetPose(0, np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    np.testing.assert_allclose(coordinates([level])[0, 3:], 0.0, atol=1e-12)


def test_a_sequence_tells_its_rmse_and_takes_angles_the_short_way() -> None:
    """Headings of 179 against -179 degrees, and 3 and 4 m beside the truth: RMSE 2 degrees and 3.54 m."""
    scene = BopScene(Path("scene"), 0)

    def heading(yaw_deg: float) -> np.ndarray:
        return R_FORWARD_CAM.T @ Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()

    frames = []
    for k, aside_m in enumerate((3.0, 4.0)):
        t_m = np.array([0.0, 0.0, 200.0])
        estimate = TargetPose(k, heading(-179.0), t_m + np.array([aside_m, 0.0, 0.0]))
        frames.append(judged(scene, k, truth(heading(179.0), t_m, k), estimate))
    titles = [axes.get_title() for axes in sequence("title", frames).axes]
    assert titles[0] == "X: RMSE 3.54 m"
    assert titles[5] == "yaw: RMSE 2.00°"


def test_a_rotation_that_is_not_known_leaves_a_gap_in_figures_and_files() -> None:
    """One of two poses tells its heading, 2 degrees off; the other's is right by chance. Both are 3 m aside."""
    scene = BopScene(Path("scene"), 0)
    t_m = np.array([0.0, 0.0, 200.0])
    level = R_FORWARD_CAM.T
    turned = level @ Rotation.from_euler("z", 2.0, degrees=True).as_matrix()
    known = TargetPose(0, turned, t_m + np.array([3.0, 0.0, 0.0]), covariance=np.eye(6))
    unknown = replace(known, frame=1, R_cam_target=level, rotation_known=False)
    frames = [judged(scene, k, truth(level, t_m, k), pose) for k, pose in enumerate((known, unknown))]
    titles = [axes.get_title() for axes in sequence("title", frames).axes]
    assert (titles[0], titles[5]) == ("X: RMSE 3.00 m", "yaw: RMSE 2.00°")
    (rotation, place, *_) = cumulative_error([frame.matches[0] for frame in frames]).axes
    assert rotation.lines[0].get_ydata()[-1] == 50.0
    assert place.lines[0].get_ydata()[-1] == 100.0
    told = [frame_record(frame, Path())["targets"][0] for frame in frames]
    assert told[0]["rotation_error_deg"] == pytest.approx(2.0, abs=1e-3)
    assert (told[0]["pose_10deg_5pct"], told[1]["pose_10deg_5pct"]) == (True, False)
    assert (told[1]["rotation_error_deg"], told[1]["estimate"]["R_cam_target"]) == (None, None)
    assert told[1]["estimate"]["sigma"] == [1.0, 1.0, 1.0, None, None, None]
    assert told[1]["translation_error_m"] == 3.0
    # The limit is 5 % of 200 m.
    assert badness(frames[1].matches[0]) == pytest.approx(0.3)


def test_the_worst_come_first_and_misses_do_not_crowd_them_out() -> None:
    scene = BopScene(Path("scene"), 0)
    t_m = np.array([0.0, 0.0, 200.0])
    frames = [judged(scene, k, truth(np.eye(3), t_m, k), None) for k in range(30)]
    for k, angle_deg in enumerate((5.0, 90.0, 20.0)):
        R = Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
        frames.append(judged(scene, 100 + k, truth(np.eye(3), t_m, 30 + k), TargetPose(30 + k, R, t_m)))
    # 30 m of 200 are three times the limit, 20 degrees but two times.
    frames.append(judged(scene, 103, truth(np.eye(3), t_m, 33), TargetPose(33, np.eye(3), t_m * 1.15)))
    shown = [frame.picture.image_id for frame, _ in worst_matches(frames, shown=7)]
    assert len([image_id for image_id in shown if image_id < 100]) == 4
    assert shown[4:] == [101, 103, 102]


def test_the_sheet_shows_true_and_estimated_boxes(dark_spot_scene: Path, tmp_path: Path) -> None:
    dataset = open_dataset(dark_spot_scene.parents[1])
    pictures = list(dataset.frames())

    def answer(index: int, seen: DatasetFrame) -> Answer:
        if not seen.targets or index == 0:
            return Answer((), None)
        R = Rotation.from_euler("z", 40, degrees=True).as_matrix()
        return Answer((TargetPose(index, R, seen.targets[0].t_cam_target_m),), None)

    results = judge_frames(pictures, dataset.models, answer)
    path = write_worst(tmp_path / "worst.jpg", results, dataset.models)
    assert path is not None
    sheet = cv2.imread(str(path)).astype(int)
    blue, green, red = sheet[..., 0], sheet[..., 1], sheet[..., 2]
    cyan = (blue > 170) & (green > 170) & (red < 90)
    magenta = (blue > 170) & (red > 170) & (green < 110)
    tiles = np.array_split(np.arange(sheet.shape[1]), 4)
    assert [bool(cyan[:, tile].sum() > 200) for tile in tiles] == [True] * 4
    assert [bool(magenta[:, tile].sum() > 50) for tile in tiles] == [False, True, True, True]
    empty = [frame for frame in results if not frame.matches]
    assert write_worst(tmp_path / "none.jpg", empty, dataset.models) is None
