"""Models whose axes are others than the dataset says: an evaluation tells, in words and in its pictures."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_replay.datasets import DatasetFrame, open_dataset
from sim_replay.evaluation.axes import told_of_axes
from sim_replay.evaluation.judge import Answer, judge_frames
from sim_replay.evaluation.worst import close_up
from sim_replay.overlay import TRUTH_BGR, Extents
from sim_replay.score import Match, TargetPose, Truth
from tests.sim_replay.foreign import T_MM, write_json, write_models_info, write_scene

NOSE_X_LEFT_Y_UP_Z = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
RIGHT_X_NOSE_Y_UP_Z = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
TAIL_X_LEFT_Y = [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]
FRD = np.eye(3)
FLOWN = Rotation.random(12, rng=np.random.default_rng(3)).as_matrix()  # R_cam_body
T_M = np.array(T_MM) / 1e3


def told(root: Path, R_est: np.ndarray) -> list[str]:
    """Of rotations of the body R_est [12, 3, 3] in the pictures of the dataset."""
    dataset = open_dataset(root)

    def answer(index: int, picture: DatasetFrame) -> Answer:
        return Answer((TargetPose(index, R_est[index], T_M),), None)

    return told_of_axes(judge_frames(dataset.labelled_frames(), dataset.models, answer))


def write_dataset(root: Path, R_body_model: object) -> Path:
    """Twelve pictures, with poses of a model drawn in other axes."""
    write_models_info(root)
    scene = write_scene(root / "test" / "000002", tuple(range(12)))
    poses = {str(k): (R @ np.array(R_body_model)).ravel().tolist() for k, R in enumerate(FLOWN)}
    gt = {key: [{"obj_id": 1, "cam_R_m2c": R, "cam_t_m2c": T_MM}] for key, R in poses.items()}
    write_json(scene / "scene_gt.json", gt)
    return root


@pytest.mark.parametrize("R_body_model", [NOSE_X_LEFT_Y_UP_Z, RIGHT_X_NOSE_Y_UP_Z])
def test_the_matrix_that_is_told_makes_the_rotations_agree(tmp_path: Path, R_body_model: list[list[int]]) -> None:
    root = write_dataset(tmp_path / "hawks", R_body_model)
    noise = Rotation.from_rotvec(np.random.default_rng(4).normal(0.0, 0.2, (12, 3))).as_matrix()
    (sentence,) = told(root, noise @ FLOWN)
    assert sentence.startswith("obj_id 1: ")
    line = sentence[sentence.index("R_body_model") :]
    assert tomllib.loads(line) == {"R_body_model": R_body_model}
    (root / "model_frame.toml").write_text(line)
    assert told(root, noise @ FLOWN) == []


def test_mistakes_of_a_network_are_not_taken_for_other_axes(tmp_path: Path) -> None:
    """Right, at random, or nose for tail all the time."""
    root = write_dataset(tmp_path / "hawks", FRD)
    anyhow = Rotation.random(12, rng=np.random.default_rng(5)).as_matrix()
    for R_est in (FLOWN, anyhow, FLOWN @ np.array(TAIL_X_LEFT_Y)):
        assert told(root, R_est) == []


@pytest.mark.parametrize(("R_body_model", "is_above"), [(FRD, True), (NOSE_X_LEFT_Y_UP_Z, False)])
def test_the_picture_of_a_level_aircraft_has_its_line_above_the_box(R_body_model: object, is_above: bool) -> None:
    """It flies away from a level camera; if its axes are turned about the nose, the nose's arrow does not show it."""
    R_cam_frd = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    flat = Extents((-4.0, -6.0, -0.5), (8.0, 12.0, 1.0))
    truth = Truth(0, R_cam_frd @ np.array(R_body_model), np.array([0.0, 0, 200]), 1, 15.0)
    K = np.array([[2000.0, 0, 319.5], [0, 2000, 239.5], [0, 0, 1]])
    view = close_up(np.zeros((480, 640, 3), np.uint8), K, Match(truth, None), flat, 400)
    rows = np.flatnonzero((view[:, 200] == TRUTH_BGR).all(axis=1)) - 199.5
    assert (-rows.min() > rows.max()) == is_above
