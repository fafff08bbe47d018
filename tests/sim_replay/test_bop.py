"""BOP files: what is written is what the format says, and comes back; what is broken is named."""

from __future__ import annotations

import dataclasses
import json
import struct
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from msgs.geometry import so3_exp
from sim_replay.airframes.mesh import Mesh
from sim_replay.bop import (
    BopError,
    BopFrame,
    BopTarget,
    ModelFrames,
    SceneWriter,
    read_models,
    read_ply_vertices_m,
    read_scene,
    write_models,
)  # fmt: skip
from sim_replay.bop.models import largest_distance

K = np.array([[1500.25, 0, 31.5], [0, 1501.75, 23.5], [0, 0, 1]])
numbers = st.floats(-500, 500, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
before_camera = st.tuples(numbers, numbers, st.floats(1e-3, 500)).map(np.array)


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


@given(turn=vectors.map(lambda v: v / 200), t=before_camera)
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
        ("scene_camera.json", "1500.25", "-1500.25", r"'cam_K' of '3' has no positive focal lengths"),
        ("scene_camera.json", "1501.75", "0.0", r"'cam_K' of '3' has no positive focal lengths"),
        ("scene_camera.json", "0.0, 0.0, 1.0]", "0.0, 5.0, 1.0]", r"'cam_K' of '3' is not, row by row"),
        ("scene_camera.json", "0.0, 0.0, 1.0]", "0.0, -5.0, 1.0]", r"'cam_K' of '3' is not, row by row"),
        ("scene_camera.json", "0.0, 0.0, 1.0]", "0.0, 0.0, 2.0]", r"'cam_K' of '3' is not, row by row"),
        ("scene_camera.json", '"3"', '"three"', r"'three' is not the number"),
        ("scene_gt.json", '"obj_id": 5', '"obj_id": "a"', r"scene_gt\.json: '3' has no integer 'obj_id'"),
        ("scene_gt.json", "}]", "}", r"scene_gt\.json line 3 is not JSON"),
        ("scene_gt.json", "[{", '7, "4": [{', r"scene_gt\.json: '3' is not a list of objects"),
        ("scene_gt_info.json", '"bbox_visib"', '"bbox"', r"scene_gt_info\.json: '3' has no 'bbox_visib'"),
        ("scene_gt_info.json", "[{", '7, "4": [{', r"scene_gt_info\.json: '3' does not list the 1 objects of scene_gt"),
        ("scene_gt_info.json", "[{", "[{}, {", r"scene_gt_info\.json: '3' does not list the 1 objects of scene_gt"),
    ],
)
def test_broken_files_are_named_with_their_key(tmp_path: Path, name: str, old: str, new: str, said: str) -> None:
    folder = _write(tmp_path, _frame())
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    with pytest.raises(BopError, match=said):
        read_scene(folder)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[]", "does not hold an object of pictures or models"),
        (b"\xff\xfe{", "cannot be read: not UTF-8 text"),
        (None, "cannot be read: Is a directory"),
    ],
)
def test_files_of_something_else_are_named(tmp_path: Path, content: bytes | None, said: str) -> None:
    path = _write(tmp_path, _frame()) / "scene_camera.json"
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(BopError, match=rf"scene_camera\.json {said}"):
        read_scene(tmp_path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(BopError, match=r"scene_camera\.json is missing"):
        read_scene(tmp_path)
    folder = _write(tmp_path / "s", _frame())
    (folder / "rgb" / "000003.jpg").unlink()
    scene = read_scene(folder)
    with pytest.raises(BopError, match="holds no picture 000003"):
        scene.image_bgr(scene.frames[0])


def test_models_come_back_in_metres(tmp_path: Path) -> None:
    points = np.random.default_rng(3).normal(size=(300, 3)) * [4.0, 6.0, 1.0]
    single = points.astype(np.float32)
    mesh = Mesh(single, single, np.zeros(300, np.uint8), np.array([[0, 1, 2]], np.int32))
    write_models(tmp_path / "models", {2: mesh})
    np.testing.assert_allclose(read_ply_vertices_m(tmp_path / "models" / "obj_000002.ply"), points, atol=1e-5)
    model = read_models(tmp_path, ModelFrames())[2]
    assert model.diameter_m == pytest.approx(pdist(mesh.vertices_m.astype(float)).max(), abs=1e-6)
    np.testing.assert_allclose(model.size_m, np.ptp(points, axis=0), atol=1e-5)
    np.testing.assert_allclose(model.points_m, points, atol=1e-5)
    raw = json.loads((tmp_path / "models" / "models_info.json").read_text())["2"]
    assert raw["size_y"] == pytest.approx(1000.0 * np.ptp(points[:, 1]), abs=1e-2)
    (tmp_path / "models" / "obj_000002.ply").unlink()
    bounds = read_models(tmp_path, ModelFrames())[2].points_m
    assert bounds is not None
    corners = sorted(product(*zip(points.min(axis=0), points.max(axis=0), strict=True)))
    np.testing.assert_allclose(sorted(map(tuple, bounds)), corners, atol=1e-5)


@given(st.integers(2, 200), st.sampled_from([(1, 1, 1), (10, 0.1, 0.1), (5, 8, 0), (0, 0, 0)]), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_the_diameter_is_exact_for_any_cloud_of_points(count: int, size: tuple[float, ...], seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3)) * size + [100.0, -3.0, 0.5]
    assert largest_distance(points) == pytest.approx(pdist(points).max(), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 17, 22])
def test_the_diameter_is_exact_for_more_points_than_are_compared_at_once(seed: int) -> None:
    """Of a sphere none can be left out; its farthest two lie in both blocks of 2048, in the last or in the first."""
    points = np.random.default_rng(seed).normal(size=(2600, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert largest_distance(points) == pytest.approx(pdist(points).max(), rel=1e-12)


def test_ascii_models_of_others_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "obj_000001.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 2\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
        "1000 2000 -3000 255\n0.5 0 0 1\n"
    )
    np.testing.assert_allclose(read_ply_vertices_m(path), [[1, 2, -3], [0.0005, 0, 0]])
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_allclose(read_ply_vertices_m(path), [[1, 2, -3], [0.0005, 0, 0]])
    path.write_text("solid stl")
    with pytest.raises(BopError, match="not a PLY file"):
        read_ply_vertices_m(path)


def test_binary_models_of_either_byte_order_and_any_number_type_can_be_read(tmp_path: Path) -> None:
    for name, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        rows = np.array([(7, 1000.0, -2000.0, 3000.0), (9, 0.0, 0.5, 0.0)], f"{order}u2,{order}f8,{order}f8,{order}f8")
        head = f"ply\nformat {name} 1.0\nelement vertex 2\nproperty ushort tag\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path = tmp_path / "obj_000001.ply"
        path.write_bytes(head.encode() + rows.tobytes())
        np.testing.assert_allclose(read_ply_vertices_m(path), [[1, -2, 3], [0, 0.0005, 0]])
        path.write_bytes(head.encode() + rows.tobytes()[:-4])
        with pytest.raises(BopError, match="vertices cannot be read"):
            read_ply_vertices_m(path)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(
    ("names", "code"),
    [
        (("char", "int8"), "b"),
        (("uchar", "uint8"), "B"),
        (("short", "int16"), "h"),
        (("ushort", "uint16"), "H"),
        (("int", "int32"), "i"),
        (("uint", "uint32"), "I"),
        (("float", "float32"), "f"),
        (("double", "float64"), "d"),
    ],
)
def test_either_name_of_a_number_type_in_a_binary_model_is_known(
    tmp_path: Path, names: tuple[str, str], code: str, order: str
) -> None:
    kind = {"<": "little", ">": "big"}[order]
    for name in names:
        head = f"ply\nformat binary_{kind}_endian 1.0\nelement vertex 2\nproperty {name} x\n"
        head += f"property float y\nproperty {name} z\nelement face 0\nend_header\n"
        rows = struct.pack(f"{order}{code}f{code}", 100, -2.5, 3) + struct.pack(f"{order}{code}f{code}", 4, 0.5, 60)
        (tmp_path / "obj_000001.ply").write_bytes(head.encode() + rows)
        points = read_ply_vertices_m(tmp_path / "obj_000001.ply")
        np.testing.assert_allclose(points, [[0.1, -0.0025, 0.003], [0.004, 0.0005, 0.06]], rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("element vertex 2", "element camera 1\nelement vertex 2", "its first element is not 'vertex'"),
        ("element vertex 2", "comment nothing", "its first element is not 'vertex'"),
        ("element vertex 2", "element vertex", "its vertices cannot be read"),
        ("element vertex 2", "element vertex 3", "its vertices cannot be read"),
        ("element vertex 2", "element vertex 0", "it holds no vertices, or some that are not finite"),
        ("4 5 6", "4 5 inf", "it holds no vertices, or some that are not finite"),
        ("4 5 6", "4 5", "its vertices cannot be read"),
        ("property float z", "property float w", "its vertices cannot be read"),
        ("format ascii", "format morse", "its vertices cannot be read"),
        ("end_header", "the end", "is not a PLY file"),
        ("format ascii 1.0", "comment ascii", "is not a PLY file"),
    ],
)
def test_a_broken_model_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    path = tmp_path / "obj_000001.ply"
    path.write_text((head + "1 2 3\n4 5 6\n").replace(old, new))
    with pytest.raises(BopError, match=rf"obj_000001\.ply:? {said}"):
        read_ply_vertices_m(path)


def test_a_model_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(BopError, match=r"obj_000001\.ply cannot be read: No such file"):
        read_ply_vertices_m(tmp_path / "obj_000001.ply")


def test_a_lens_comes_back_and_a_pinhole_camera_has_none(tmp_path: Path) -> None:
    lens = (-0.21, 0.043, 0.0012, -0.0007, 0.0)
    plain = _frame(1)
    bent = dataclasses.replace(_frame(2), distortion=lens)
    assert [frame.distortion for frame in read_scene(_write(tmp_path, plain, bent)).frames] == [None, lens]


def test_a_silhouette_of_which_more_exists_is_not_made_up_from_what_is_visible(tmp_path: Path) -> None:
    half_hidden = _frame(3)  # 80 of 100 pixels
    free = BopFrame(4, K, (dataclasses.replace(half_hidden.targets[0], visible_px=200, whole_px=200),))
    scene = read_scene(_write(tmp_path, half_hidden, free))
    assert scene.whole_mask(scene.frames[0], 0) is None
    whole, visible = scene.whole_mask(scene.frames[1], 0), scene.mask(scene.frames[1], 0)
    assert whole is not None
    assert visible is not None
    np.testing.assert_array_equal(whole, visible)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("cam_R_m2c", [-1, 0, 0, 0, 1, 0, 0, 0, 1], r"scene_gt\.json: 'cam_R_m2c' of '3' is not a rotation"),
        ("cam_R_m2c", [2, 0, 0, 0, 2, 0, 0, 0, 2], "is not a rotation"),
        ("cam_t_m2c", ["far"], "'cam_t_m2c' of '3' is not 3 numbers"),
    ],
)
def test_a_mirrored_or_scaled_pose_is_refused(tmp_path: Path, name: str, value: list[object], said: str) -> None:
    folder = _write(tmp_path, _frame())
    poses = json.loads((folder / "scene_gt.json").read_text())
    poses["3"][0][name] = value
    (folder / "scene_gt.json").write_text(json.dumps(poses))
    with pytest.raises(BopError, match=said):
        read_scene(folder)
