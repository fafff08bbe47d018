"""Which poses of a results file count, and what counts where a list of targets leaves aircraft out."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from sim_replay.benchmark.stats import dataset_statistics, statistics_table
from sim_replay.bop import BopError
from sim_replay.datasets import DatasetFrame, open_dataset
from sim_replay.evaluation.bop_results import file_answers, read_results, write_results
from sim_replay.evaluation.consistency import bounds_95
from sim_replay.evaluation.directions import directions
from sim_replay.evaluation.judge import Answer, JudgedFrame, judge_frames, labels_sha256, score_of
from sim_replay.evaluation.spread import intervals_95
from sim_replay.evaluation.table import consistency_line, score_table
from sim_replay.score import TargetPose
from tests.sim_replay.foreign import UNIT, write_json, write_models_info, write_scene

TURNED = Rotation.from_euler("z", 180, degrees=True).as_matrix()
Row = tuple[int, float, float, bool]  # obj_id, score, x in metres, whether it is turned the right way
LEFT, RIGHT = -5.0, 5.0  # metres: where two aircraft are, well apart for their size of 6 m at 200 m


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Object 1 left and right in picture 0, nothing in picture 1."""
    root = tmp_path / "hawks"
    write_models_info(root)
    scene = write_scene(root / "test" / "000000", (0, 1), masks=False)
    poses = [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": [1e3 * x, 0, 2e5]} for x in (LEFT, RIGHT)]
    write_json(scene / "scene_gt.json", {"0": poses, "1": []})
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60}
    write_json(scene / "scene_gt_info.json", {"0": [seen, seen], "1": []})
    return root


def results(folder: Path, rows: Sequence[Row], picture: int = 0) -> Path:
    path = folder / "m_hawks-test.csv"
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for obj_id, score, x_m, right in rows:
        R = " ".join(str(v) for v in (np.eye(3) if right else TURNED).ravel())
        lines.append(f"0,{picture},{obj_id},{score},{R},{1e3 * x_m} 0 200000,-1")
    path.write_text("\n".join(lines) + "\n")
    return path


def judged(root: Path, rows: Sequence[Row], picture: int = 0) -> list[JudgedFrame]:
    dataset = open_dataset(root)
    answers = file_answers(results(root.parent, rows, picture), dataset)
    return judge_frames(dataset.labelled_frames(), dataset.models, answers)


def turns_deg(frames: Sequence[JudgedFrame]) -> list[float | None]:
    return [m.rotation_error_deg and round(m.rotation_error_deg) for m in frames[0].matches]


def test_poses_of_images_that_are_numbered_by_their_time_in_nanoseconds_are_those_images(tmp_path: Path) -> None:
    """Two in a row, which are one number in floating point."""
    first = 1_764_414_000_123_456_789
    write_models_info(tmp_path / "hawks")
    write_scene(tmp_path / "hawks" / "test" / "000000", (first, first + 1), masks=False)
    frames = judged(tmp_path / "hawks", [(1, 1.0, LEFT, True)], picture=first + 1)
    assert [frame.picture.image_id for frame in frames] == [first, first + 1]
    assert [frame.matches[0].estimate is not None for frame in frames] == [False, True]


def test_the_score_chooses_among_several_poses_of_one_aircraft_and_not_the_truth(root: Path) -> None:
    aside = [(1, 0.9, LEFT + 1.0, False), (1, 0.1, LEFT, True), (1, 0.8, RIGHT, True)]
    for rows in (aside, aside[::-1]):
        frames = judged(root, rows)
        assert turns_deg(frames) == [180, 0]
        assert [pose.score for pose in frames[0].false_poses] == [0.1]
        assert frames[0].time_ms is None  # -1 in the file: not known


def test_a_file_without_a_header_tells_the_same_as_with_one(root: Path) -> None:
    path = results(root.parent, [(1, 0.9, LEFT, True), (1, 0.8, RIGHT, False)])
    told = [(row.score, row.t_cam_model_m[0]) for row in read_results(path)]
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    assert [(row.score, row.t_cam_model_m[0]) for row in read_results(path)] == told == [(0.9, LEFT), (0.8, RIGHT)]


def test_of_equal_scores_the_first_count(root: Path) -> None:
    frames = judged(root, [(1, 1.0, LEFT, True), (1, 1.0, RIGHT, True), (1, 1.0, RIGHT, False)])
    assert turns_deg(frames) == [0, 0]
    assert len(frames[0].false_poses) == 1


def test_who_names_no_object_or_another_one_fills_what_is_left_by_score(root: Path) -> None:
    assert turns_deg(judged(root, [(0, 0.5, LEFT, True), (0, 0.9, RIGHT, False)])) == [0, 180]
    frames = judged(root, [(1, 0.2, LEFT, False), (7, 0.3, LEFT, True), (7, 0.9, RIGHT, True)])
    assert turns_deg(frames) == [180, 0]
    assert len(frames[0].false_poses) == 1


def test_a_second_pose_of_one_aircraft_does_not_take_the_place_of_another(root: Path) -> None:
    write_json(root / "models" / "models_info.json", {name: {"diameter": 6000.0} for name in ("1", "2")})
    scene_gt = root / "test" / "000000" / "scene_gt.json"
    truth = json.loads(scene_gt.read_text())
    truth["0"][1]["obj_id"] = 2
    write_json(scene_gt, truth)
    frames = judged(root, [(1, 0.9, LEFT, True), (1, 0.8, RIGHT, True)])
    assert turns_deg(frames) == [0, None]
    assert len(frames[0].false_poses) == 1


def test_poses_of_pictures_that_their_scene_does_not_have_are_told(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = results(root.parent, [(1, 0.9, LEFT, True), (1, 0.8, RIGHT, True)])
    of_another_scene = path.read_text().splitlines()[-1].replace("0,0,1,", "7,0,1,", 1)
    path.write_text(f"{path.read_text()}{of_another_scene}\n")
    file_answers(path, open_dataset(root))
    assert caplog.text == "", "a file may tell of more scenes than are evaluated"
    path.write_text(path.read_text().replace("0,0,1,0.8", "0,2,1,0.8"))
    file_answers(path, open_dataset(root))
    assert (
        "1 poses are of pictures that their scenes do not have, and count nowhere, such as 2 of scene 0" in caplog.text
    )


def test_poses_in_metres_are_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = results(root.parent, [(1, 0.9, LEFT, True), (1, 0.8, RIGHT, True)])
    file_answers(path, open_dataset(root))
    assert caplog.text == ""
    path.write_text(
        path.read_text().replace(f"{1e3 * LEFT} 0 200000", f"{LEFT} 0 200").replace("5000.0 0 200000", "5 0 200")
    )
    file_answers(path, open_dataset(root))
    assert (
        f"{path}: its poses lie 0.2 m from the camera, the targets 200 m (medians): t is in millimetres" in caplog.text
    )


def test_a_false_pose_is_not_written_as_one_of_an_object_that_a_dataset_numbers_0(root: Path) -> None:
    """Read again, the surest pose would have taken the place of a right one."""
    for path in (root / "test" / "000000" / "scene_gt.json", root / "models" / "models_info.json"):
        path.write_text(path.read_text().replace('"obj_id": 1', '"obj_id": 0').replace('{"1":', '{"0":'))
    dataset = open_dataset(root)
    scores = {LEFT: 0.5, RIGHT: 0.5, 40.0: 0.9}

    def answer(index: int, picture: DatasetFrame) -> Answer:
        told = said(*scores if picture.image_id == 0 else ())(index, picture)
        return Answer(tuple(replace(pose, score=scores[pose.t_cam_target_m[0]]) for pose in told.poses), None)

    pictures = dataset.labelled_frames()
    path = root.parent / "m_hawks-test.csv"
    write_results(path, judge_frames(pictures, dataset.models, answer))
    again = judge_frames(pictures, dataset.models, file_answers(path, dataset))
    assert turns_deg(again) == [0, 0]
    assert [pose.score for pose in again[0].false_poses] == [0.9]


def test_poses_of_unknown_rotation_are_not_written_and_their_number_is_told(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Their placeholder happens to be right here; from the file it would be taken for an answer."""
    dataset = open_dataset(root)

    def answer(index: int, picture: DatasetFrame) -> Answer:
        sure, unsure, false = said(LEFT, RIGHT, 40.0)(index, picture).poses
        return Answer((sure, *(replace(pose, rotation_known=False) for pose in (unsure, false))), None)

    pictures = dataset.labelled_frames()[:1]
    first = judge_frames(pictures, dataset.models, answer)
    path = root.parent / "m_hawks-test.csv"
    write_results(path, first)
    assert f"{path}: 2 poses are left out" in caplog.text
    again = judge_frames(pictures, dataset.models, file_answers(path, dataset))
    of_both = [score_of(dataset, {}, frames)["overall"] for frames in (first, again)]
    assert [overall["rot_10deg"] for overall in of_both] == [0.5, 0.5]
    assert [overall["recall"] for overall in of_both] == [1.0, 0.5]


def test_poses_in_an_empty_picture_stay_false_alarms(root: Path) -> None:
    dataset = open_dataset(root)
    score = score_of(dataset, {}, judged(root, [(1, 0.9, LEFT, True)], picture=1))
    assert score["overall"]["false_positives_per_1000"] == 1000.0


def listed(root: Path, *targets: dict[str, int]) -> None:
    write_json(root / "test_targets_bop19.json", targets)


def said(*x_m: float) -> Any:
    poses = [np.array([x, 0.0, 200.0]) for x in x_m]
    return lambda index, _: Answer(tuple(TargetPose(index, np.eye(3), t_m) for t_m in poses), None)


def test_a_line_of_a_list_asks_for_one_aircraft_unless_it_says_more_and_the_most_visible_ones_count(root: Path) -> None:
    sides = [{"bbox_visib": [9, 9, 9, 9], "px_count_visib": px} for px in (60, 70)]
    write_json(root / "test" / "000000" / "scene_gt_info.json", {"0": sides, "1": []})
    one = {"scene_id": 0, "im_id": 0, "obj_id": 1}
    for lines, asked in (((one,), [RIGHT]), ((one, one), [LEFT, RIGHT]), ((one | {"inst_count": 2},), [LEFT, RIGHT])):
        listed(root, *lines)
        (picture,) = open_dataset(root).labelled_frames()
        assert [target.t_cam_target_m[0] for target in picture.targets] == asked  # in the order of scene_gt.json


def test_a_pose_of_an_aircraft_that_is_not_asked_for_is_neither_right_nor_wrong(root: Path) -> None:
    listed(root, {"scene_id": 0, "im_id": 0, "obj_id": 1, "inst_count": 1})
    dataset = open_dataset(root)
    pictures = dataset.labelled_frames()
    assert [len(pictures[0].targets), len(pictures[0].unlisted)] == [1, 1]
    score = score_of(dataset, {}, judge_frames(pictures, dataset.models, said(LEFT, RIGHT)))
    overall = score["overall"]
    assert (overall["targets"], overall["recall"], overall["false_poses"]) == (1, 1.0, 0)
    only_other = judge_frames(pictures, dataset.models, said(RIGHT))
    assert [match.estimate for match in only_other[0].matches] == [None]
    assert only_other[0].false_poses == ()
    both = judged(root, [(1, 0.9, RIGHT, True), (1, 0.8, LEFT, True)])
    assert turns_deg(both) == [0]
    assert both[0].false_poses == ()


def test_a_picture_that_shows_but_what_is_not_asked_for_is_not_empty(root: Path) -> None:
    listed(root, {"scene_id": 0, "im_id": 0, "obj_id": 9}, {"scene_id": 0, "im_id": 1, "obj_id": 9})
    dataset = open_dataset(root)
    for told_in, false_alarms in ((0, 0.0), (1, 1000.0)):  # of the one that shows none

        def answer(index: int, picture: DatasetFrame, told_in: int = told_in) -> Answer:
            return said(40.0)(index, picture) if index == told_in else Answer((), None)

        frames = judge_frames(dataset.labelled_frames(), dataset.models, answer)
        overall = score_of(dataset, {}, frames)["overall"]
        assert overall["false_poses"] == 1
        assert overall["false_positives_per_1000"] == false_alarms


def test_a_pose_of_a_listed_aircraft_that_is_entirely_occluded_is_neither_right_nor_wrong(root: Path) -> None:
    """Behind a cloud, right of the one that is seen; in picture 1 alone."""
    scene = root / "test" / "000000"
    truth = json.loads((scene / "scene_gt.json").read_text())
    write_json(scene / "scene_gt.json", truth | {"1": truth["0"][1:]})
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60, "px_count_all": 60}
    places = ((LEFT, RIGHT), (RIGHT,))
    for px_count_all, false_poses, false_alarms in ((60, 0, None), (0, 2, 1000.0)):  # the latter: outside the image
        hidden = {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": 0, "px_count_all": px_count_all}
        write_json(scene / "scene_gt_info.json", {"0": [seen, hidden], "1": [hidden]})
        dataset = open_dataset(root)
        rows = [(1, 0.9, LEFT, True), (1, 0.8, RIGHT, True)]
        from_file = [*judged(root, rows)[:1], *judged(root, rows[1:], picture=1)[1:]]
        pictures = dataset.labelled_frames()
        from_model = judge_frames(pictures, dataset.models, lambda index, picture: said(*places[index])(index, picture))
        for frames in (from_file, from_model):
            overall = score_of(dataset, {}, frames)["overall"]
            assert (overall["targets"], overall["recall"], overall["false_poses"]) == (1, 1.0, false_poses)
            assert overall["false_positives_per_1000"] == false_alarms


def test_directions_without_a_target_are_false_wherever_they_are_told(root: Path) -> None:
    """One to each target's side, one where there is a target, and one in a picture without any."""

    def answer(index: int, picture: DatasetFrame) -> Answer:
        nearer = [LEFT / 2, 0.0, 100.0]
        seen_m = [[-20.0, 0.0, 200.0], [20.0, 0.0, 200.0], nearer] if index == 0 else [[0.0, 0.0, 50.0]]
        return Answer((), None, directions=tuple(TargetPose(index, np.eye(3), np.array(t_m)) for t_m in seen_m))

    dataset = open_dataset(root)
    frames = judge_frames(dataset.labelled_frames(), dataset.models, answer)
    found = directions(frames)
    assert found == {"targets": 1, "bearing_error_deg": {"mean": 0.0, "median": 0.0}, "false": 3}
    unseen = directions(frames[1:])
    assert unseen == {"targets": 0, "bearing_error_deg": {"mean": None, "median": None}, "false": 1}
    console = Console(file=io.StringIO(), width=130)
    for told in (found, unseen):
        console.print(score_table(score_of(dataset, {"file": "m.onnx"}, frames) | {"directions": told}))
    shown = " ".join(console.file.getvalue().split())
    assert "1 targets, bearing error mean 0.000°, median 0.000°; directions without a target: 3" in shown
    assert "0 targets, bearing error mean –, median –; directions without a target: 1" in shown


def test_names_with_brackets_are_shown_as_they_are(root: Path) -> None:
    """Rich takes brackets for markup: it had left them out, and refused a closing one with a traceback."""
    root = root.rename(root.with_name("hawks [v2]"))
    write_json(root / "models" / "models_info.json", {"1": {"diameter": 6000.0, "name": "cub [/red]"}})
    dataset = open_dataset(root)
    console = Console(file=io.StringIO(), width=130)
    frames = judged(root, [])
    score = score_of(dataset, {"file": "m [a].csv"}, frames)
    console.print(score_table(score | {"intervals_95": intervals_95(frames)}))
    console.print(statistics_table(dataset_statistics(root)))
    shown = console.file.getvalue()
    assert "m [a].csv on hawks [v2], 2 frames" in shown
    assert "95 % confidence intervals not available: fewer than 6 flights show a target" in " ".join(shown.split())
    assert shown.count("cub [/red]") == 2


def test_the_labels_hash_tells_another_seed_s_images_and_fewer_of_them_from_a_copy(root: Path) -> None:
    copy = Path(shutil.copytree(root, root.parent / "elsewhere"))
    pictures = open_dataset(root).labelled_frames()
    assert labels_sha256(open_dataset(copy).labelled_frames()) == labels_sha256(pictures)
    assert labels_sha256(pictures[:1]) != labels_sha256(pictures)
    truth = copy / "test" / "000000" / "scene_gt.json"
    truth.write_text(truth.read_text().replace("200000", "200001"))
    assert labels_sha256(open_dataset(copy).labelled_frames()) != labels_sha256(pictures)


def test_a_list_that_no_picture_is_on_is_told(root: Path) -> None:
    for targets in ([], [{"scene_id": 3, "im_id": 0, "obj_id": 1}]):
        listed(root, *targets)
        with pytest.raises(BopError, match=r"test_targets_bop19\.json: lists none of the 2 pictures"):
            open_dataset(root).labelled_frames()
    assert json.loads((root / "test_targets_bop19.json").read_text())


def test_a_distractor_without_a_model_is_neither_right_nor_wrong_where_it_is_not_asked_for(root: Path) -> None:
    truth = json.loads((root / "test" / "000000" / "scene_gt.json").read_text())
    truth["0"][1]["obj_id"] = 77
    write_json(root / "test" / "000000" / "scene_gt.json", truth)
    listed(root, {"scene_id": 0, "im_id": 0, "obj_id": 1, "inst_count": 1})
    for rows in ([(1, 0.9, LEFT, True)], [(1, 0.9, LEFT, True), (0, 0.8, RIGHT, True)]):
        frames = judged(root, rows)
        assert (turns_deg(frames), frames[0].false_poses) == ([0], ())
        assert [truth.object_id for truth in frames[0].not_asked] == [77]


def test_an_aircraft_without_a_model_is_as_large_as_its_box_tells_and_without_one_not_there(root: Path) -> None:
    """Hidden at 200 m: a pose beside it is false from its length on."""
    scene = root / "test" / "000000"
    truth = json.loads((scene / "scene_gt.json").read_text())
    truth["0"][1]["obj_id"] = 77
    write_json(scene / "scene_gt.json", truth)
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60, "px_count_all": 60}
    hidden = {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": 0, "px_count_all": 60}
    K = open_dataset(root).labelled_frames()[0].K
    length_m = 30 / K[0, 0] * 200.0
    for whole, off, false_poses in (
        ({"bbox_obj": [70, 9, 30, 9]}, 0.95, 0),
        ({"bbox_obj": [70, 9, 30, 9]}, 1.05, 1),
        ({}, 0.0, 1),
    ):
        write_json(scene / "scene_gt_info.json", {"0": [seen, hidden | whole], "1": []})
        frames = judged(root, [(1, 0.9, LEFT, True), (0, 0.8, RIGHT + off * length_m, True)])
        assert turns_deg(frames) == [0]
        assert len(frames[0].false_poses) == false_poses


def test_a_hidden_aircraft_takes_no_pose_from_one_that_is_seen(root: Path) -> None:
    """The pose is nearer to the hidden one, on the left."""
    hidden = {"bbox_visib": [-1, -1, -1, -1], "bbox_obj": [9, 9, 9, 9], "px_count_visib": 0, "px_count_all": 60}
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60, "px_count_all": 60}
    write_json(root / "test" / "000000" / "scene_gt_info.json", {"0": [hidden, seen], "1": []})
    dataset = open_dataset(root)
    frames = judge_frames(dataset.labelled_frames(), dataset.models, said(-0.5))
    assert turns_deg(frames) == [0]


def test_covariances_that_cannot_be_inverted_are_told_in_the_table() -> None:
    console = Console(record=True, width=200)
    rotation = {"nees_mean": 3.1, "bounds_95": [0.2, 9.3]}
    for found in ({"position": None, "rotation": rotation}, {"position": None, "rotation": None}):
        console.print(consistency_line({"flights": 1, "singular": 4, **found}))
    said = console.export_text()
    assert (
        "NEES, mean over 1 flights (95 % bounds): rotation 3.10 (0.2 to 9.3); "
        "4 poses with a singular covariance excluded" in said
    )
    assert "the covariances of all 4 poses are singular" in said


def test_rotations_that_few_flights_know_are_held_against_bounds_of_so_many() -> None:
    """14 flights, of which 3 tell a rotation: 5.9 is within theirs and far above those of 14."""
    position, rotation = ({"nees_mean": mean, "bounds_95": bounds_95(n)} for mean, n in ((2.0, 14), (5.9, 3)))
    said = consistency_line({"flights": 14, "singular": 0, "position": position, "rotation": rotation})
    assert said == "NEES, mean over 14 flights (95 % bounds): position 2.00 (1.9 to 4.4), rotation 5.90 (0.9 to 6.3)"
