"""BOP files: what is written is what the format says, and comes back; what is broken is named."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs.geometry import so3_exp
from sim_replay.airframes import AIRFRAMES
from sim_replay.bop import (
    BopError,
    BopFrame,
    BopTarget,
    SceneWriter,
    read_models_info,
    read_ply_vertices_m,
    read_scene,
    write_models,
)  # fmt: skip

K = np.array([[1500.25, 0, 31.5], [0, 1501.75, 23.5], [0, 0, 1]])
numbers = st.floats(-500, 500, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def _frame(image_id: int = 3, turn: np.ndarray | None = None, t: np.ndarray | None = None) -> BopFrame:
    R = so3_exp(np.array([0.3, -0.2, 1.1]) if turn is None else turn)
    t = np.array([1.25, -2.5, 220.125]) if t is None else t
    target = BopTarget(5, R, t, np.array([9.5, 4.5, 29.5, 14.5]), np.array([7.5, 4.5, 29.5, 14.5]), 80, 100)
    return BopFrame(image_id, K, (target,), R.T, t / 3)


def _write(folder: Path, *frames: BopFrame) -> Path:
    mask = np.zeros((48, 64), bool)
    mask[5:15, 10:30] = True
    picture = np.full((48, 64, 3), (200, 120, 40), np.uint8)
    with SceneWriter(folder) as writer:
        for frame in frames:
            writer.add(frame, picture, [mask])
    return folder


def test_files_hold_what_the_format_says(tmp_path: Path) -> None:
    folder = _write(tmp_path / "000001", _frame())
    pose = json.loads((folder / "scene_gt.json").read_text())["3"][0]
    assert pose["obj_id"] == 5
    assert pose["cam_t_m2c"] == [1250.0, -2500.0, 220125.0]
    np.testing.assert_allclose(
        np.reshape(pose["cam_R_m2c"], (3, 3)), cv2.Rodrigues(np.array([0.3, -0.2, 1.1]))[0], atol=1e-8
    )
    info = json.loads((folder / "scene_gt_info.json").read_text())["3"][0]
    assert info["bbox_visib"] == [10, 5, 20, 10]
    assert info["bbox_obj"] == [8, 5, 22, 10]
    assert info["visib_fract"] == 0.8
    camera = json.loads((folder / "scene_camera.json").read_text())["3"]
    assert camera["cam_K"] == K.reshape(-1).tolist()
    assert set(camera) == {"cam_K", "depth_scale", "cam_R_w2c", "cam_t_w2c"}
    assert cv2.imread(str(folder / "mask_visib/000003_000000.png"), cv2.IMREAD_UNCHANGED).max() == 255


@given(turn=vectors.map(lambda v: v / 200), t=vectors)
@settings(max_examples=30, deadline=None)
def test_poses_come_back(tmp_path_factory: pytest.TempPathFactory, turn: np.ndarray, t: np.ndarray) -> None:
    written = _frame(turn=turn, t=t)
    scene = read_scene(_write(tmp_path_factory.mktemp("scene"), written))
    frame, target, expected = scene.frames[0], scene.frames[0].targets[0], written.targets[0]
    assert frame.R_cam_world is not None
    assert frame.t_cam_world_m is not None
    np.testing.assert_allclose(target.R_cam_target, expected.R_cam_target, atol=1e-8)
    np.testing.assert_allclose(target.t_cam_target_m, expected.t_cam_target_m, atol=1e-6)
    np.testing.assert_allclose(frame.R_cam_world, written.R_cam_world, atol=1e-8)
    np.testing.assert_allclose(frame.t_cam_world_m, written.t_cam_world_m, atol=1e-6)
    np.testing.assert_array_equal(target.box_visible_xyxy_px, expected.box_visible_xyxy_px)
    assert (target.visible_px, target.whole_px) == (80, 100)


def test_pictures_and_masks_come_back_in_order(tmp_path: Path) -> None:
    scene = read_scene(_write(tmp_path, _frame(12), _frame(2), _frame(101)))
    assert [frame.image_id for frame in scene.frames] == [2, 12, 101]
    mask = scene.mask(scene.frames[1], 0)
    assert mask is not None
    assert mask.sum() == 200
    assert np.abs(scene.image_bgr(scene.frames[1]).astype(int) - [200, 120, 40]).max() < 6


def test_a_test_split_without_truth_or_masks_can_be_read(tmp_path: Path) -> None:
    folder = _write(tmp_path, _frame())
    for name in ("scene_gt.json", "scene_gt_info.json", "mask_visib/000003_000000.png"):
        (folder / name).unlink()
    scene = read_scene(folder)
    assert scene.frames[0].targets == ()
    assert scene.mask(scene.frames[0], 0) is None


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("scene_camera.json", '"cam_K"', '"cam_k"', r"scene_camera\.json: '3' has no 'cam_K'"),
        ("scene_camera.json", "1500.25, ", "", r"scene_camera\.json: 'cam_K' of '3' is not 9 numbers"),
        ("scene_camera.json", "1500.25", "NaN", r"'cam_K' of '3' is not finite"),
        ("scene_camera.json", '"3"', '"three"', r"'three' is not the number"),
        ("scene_gt.json", '"obj_id": 5', '"obj_id": "a"', r"scene_gt\.json: '3' has no integer 'obj_id'"),
        ("scene_gt.json", "}]", "}", r"scene_gt\.json line 3 is not JSON"),
        ("scene_gt_info.json", '"bbox_visib"', '"bbox"', r"scene_gt_info\.json: '3' has no 'bbox_visib'"),
    ],
)
def test_broken_files_are_named_with_their_key(tmp_path: Path, name: str, old: str, new: str, said: str) -> None:
    folder = _write(tmp_path, _frame())
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    with pytest.raises(BopError, match=said):
        read_scene(folder)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(BopError, match=r"scene_camera\.json is missing"):
        read_scene(tmp_path)
    folder = _write(tmp_path / "s", _frame())
    (folder / "rgb" / "000003.jpg").unlink()
    scene = read_scene(folder)
    with pytest.raises(BopError, match="holds no picture 000003"):
        scene.image_bgr(scene.frames[0])


def test_models_come_back_in_metres(tmp_path: Path) -> None:
    mesh = AIRFRAMES[1].mesh()
    write_models(tmp_path, {2: mesh})
    np.testing.assert_allclose(read_ply_vertices_m(tmp_path / "obj_000002.ply"), mesh.vertices_m, atol=1e-5)
    info = read_models_info(tmp_path)[2]
    assert info.diameter_m == pytest.approx(AIRFRAMES[1].diameter_m(), abs=1e-6)
    np.testing.assert_allclose(info.size_m, np.ptp(mesh.vertices_m, axis=0), atol=1e-5)
    raw = json.loads((tmp_path / "models_info.json").read_text())["2"]
    assert raw["size_y"] == pytest.approx(12000.0)


def test_ascii_models_of_others_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "obj_000001.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 2\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
        "1000 2000 -3000 255\n0.5 0 0 1\n"
    )
    np.testing.assert_allclose(read_ply_vertices_m(path), [[1, 2, -3], [0.0005, 0, 0]])
    path.write_text("solid stl")
    with pytest.raises(BopError, match="not a PLY file"):
        read_ply_vertices_m(path)
