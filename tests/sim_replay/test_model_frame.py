"""model_frame.toml: a dataset's own model axes, turned into body (FRD) wherever it is read."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sim_replay.bop import BopError, ModelFrame, read_scene
from sim_replay.datasets import open_dataset
from sim_replay.ground_truth import read_scene_truth

# Models as many a drawing program has them: x to the right wing, y to the nose, z up.
RIGHT_NOSE_UP = """
R_body_model = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
t_body_model_m = [0.5, 0.0, -0.2]
"""
# Seen from straight behind, level: model x to the right of the picture, y away from the camera, z up in it.
R_CAM_MODEL = [1.0, 0, 0, 0, 0, -1, 0, 1, 0]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    scene = tmp_path / "test" / "000001"
    (scene / "rgb").mkdir(parents=True)
    cv2.imwrite(str(scene / "rgb" / "000000.png"), np.zeros((90, 160, 3), np.uint8))
    pose = {"cam_R_m2c": R_CAM_MODEL, "cam_t_m2c": [3000, -2000, 200000]}
    (scene / "scene_camera.json").write_text(json.dumps({"0": {"cam_K": [900, 0, 80, 0, 900, 45, 0, 0, 1]}}))
    (scene / "scene_gt.json").write_text(json.dumps({"0": [pose | {"obj_id": 1}, pose | {"obj_id": 2}]}))
    models = tmp_path / "models"
    models.mkdir()
    size = {"min_x": -6e3, "min_y": -3e3, "min_z": 0, "size_x": 12e3, "size_y": 7e3, "size_z": 1500}
    (models / "models_info.json").write_text(json.dumps({str(k): size | {"diameter": 12e3} for k in (1, 2)}))
    vertices = "0 4000 0\n6000 0 0\n0 -3000 1500\n"  # nose, right wing tip, top of the fin
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (models / "obj_000001.ply").write_text(head + vertices)
    return tmp_path


@pytest.mark.parametrize("place", [".", "models"])
def test_poses_and_models_are_told_in_body_axes(root: Path, place: str) -> None:
    (root / place / "model_frame.toml").write_text(RIGHT_NOSE_UP)
    target = read_scene(root / "test" / "000001").frames[0].targets[0]
    # Body x (nose) goes away from the camera, y (right) to the right, z (down) down.
    np.testing.assert_allclose(target.R_cam_target, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    # The model's origin is 0.5 m ahead of body's and 0.2 m above: body's is nearer and lower (y is down) in cam.
    np.testing.assert_allclose(target.t_cam_target_m, [3.0, -1.8, 199.5], atol=1e-12)
    model = open_dataset(root).models[1]
    np.testing.assert_allclose(model.vertices_m, [[4.5, 0, -0.2], [0.5, 6, -0.2], [-2.5, 0, -1.7]], atol=1e-6)
    assert model.low_m is not None
    assert model.size_m is not None
    np.testing.assert_allclose(model.low_m, [-2.5, -6, -1.7], atol=1e-9)
    np.testing.assert_allclose(model.size_m, [7, 12, 1.5], atol=1e-9)
    assert model.diameter_m == 12.0


def test_scores_and_projected_boxes_use_it_too(root: Path) -> None:
    before = next(open_dataset(root).frames()).targets[0]
    (root / "model_frame.toml").write_text(RIGHT_NOSE_UP)
    truth = read_scene_truth(root / "test" / "000001").truths[0]
    np.testing.assert_allclose(truth.R_cam_target, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    after = next(open_dataset(root).frames()).targets[0]
    # Axes are names: what is seen in the picture stays where it is.
    np.testing.assert_allclose(after.box_whole_xyxy_px, before.box_whole_xyxy_px, atol=1e-5)


def test_an_object_may_have_axes_of_its_own(root: Path) -> None:
    of_object_2 = "[objects.2]\nR_body_model = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\n"
    (root / "model_frame.toml").write_text(RIGHT_NOSE_UP + of_object_2)
    first, second = read_scene(root / "test" / "000001").frames[0].targets
    np.testing.assert_allclose(first.R_cam_target, [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(second.R_cam_target, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


triples = st.tuples(*[st.floats(-20, 20)] * 3).map(np.array)


@given(triples, triples, triples, triples, triples)
@settings(max_examples=60, deadline=None)
def test_every_point_stays_where_it_is_in_cam(
    turn: np.ndarray, t_body_model: np.ndarray, pose_turn: np.ndarray, t_cam: np.ndarray, point: np.ndarray
) -> None:
    frame = ModelFrame(Rotation.from_rotvec(turn).as_matrix(), t_body_model)
    R_cam_model = Rotation.from_rotvec(pose_turn).as_matrix()
    R_cam_body, t_cam_body = frame.pose_of_body(R_cam_model, t_cam)
    (in_body,) = frame.points_in_body(point[None])
    np.testing.assert_allclose(R_cam_body @ in_body + t_cam_body, R_cam_model @ point + t_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("R_body_model = [[1, 0, 0], [0, 1, 0]]", "'R_body_model' is not 3 by 3 finite numbers"),
        ("R_body_model = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "'R_body_model' is not a rotation"),
        ("R_body_model = [[2, 0, 0], [0, 2, 0], [0, 0, 2]]", "'R_body_model' is not a rotation"),
        ("t_body_model_m = ['a', 0, 0]", "'t_body_model_m' is not 3 finite numbers"),
        ("t_body_model_m = [nan, 0, 0]", "'t_body_model_m' is not 3 finite numbers"),
        ("[objects.1]\ndiameter_m = -1", "'objects.1.diameter_m' is not above zero"),
        ("diameter_m = 0", "'diameter_m' is not above zero"),
        ("objects = 1", "'objects' does not hold a table for each object"),
        ("objects = { 1 = 6.0 }", "'objects.1' is not a table named by an object's number"),
        ("[objects.1]\nlength_m = 1", "unknown key 'objects.1.length_m'"),
        ("[objects.hawk]\ndiameter_m = 1", "'objects.hawk' is not a table named by an object's number"),
        ("R_body_model = [", "not valid TOML"),
    ],
)
def test_a_wrong_sidecar_is_told_with_file_and_key(root: Path, text: str, said: str) -> None:
    (root / "model_frame.toml").write_text(text)
    with pytest.raises(BopError, match=rf"model_frame\.toml:? {said}"):
        read_scene(root / "test" / "000001")
