"""Datasets of others, written here by hand as they come: what is missing, what is odd, what only they have."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edge.errors import InputError
from sim_replay.bop import DISTORTION_KEY, BopError
from sim_replay.datasets import Dataset, box_of_mask, open_dataset
from sim_replay.ground_truth import read_scene_truth
from tests.sim_replay.foreign import (
    BOX,
    BOX_EDGES,
    SIZE_WH,
    T_MM,
    UNIT,
    picture,
    silhouette,
    write_json,
    write_models_info,
    write_ply,
    write_scene,
)


def ids(dataset: Dataset) -> list[tuple[int, int]]:
    return [(frame.scene_id, frame.image_id) for frame in dataset.frames()]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two splits: scene and image numbers with gaps and not from zero, gray TIFF pictures in one scene."""
    write_models_info(tmp_path / "hawks")
    root = tmp_path / "hawks"
    write_scene(root / "train_pbr" / "000007", (3, 10, 1041))
    write_scene(root / "test" / "000048", (5,), folder_name="gray", suffix=".tif")
    write_scene(root / "test" / "000002", (1, 12), suffix=".png")
    return root


def test_splits_scenes_and_pictures_are_found_from_any_folder_of_the_dataset(root: Path) -> None:
    whole = open_dataset(root)
    assert (whole.name, whole.root, whole.split) == ("hawks", root, None)
    assert ids(whole) == [(2, 1), (2, 12), (48, 5), (7, 3), (7, 10), (7, 1041)]
    for dataset in (open_dataset(root, "train"), open_dataset(root, "train_pbr"), open_dataset(root / "train_pbr")):
        assert (dataset.name, dataset.split, ids(dataset)) == ("hawks", "train_pbr", [(7, 3), (7, 10), (7, 1041)])
    scene = open_dataset(root / "test" / "000048")
    assert (scene.name, scene.split, ids(scene)) == ("hawks", "test", [(48, 5)])
    assert scene.models[1].diameter_m == 6.0


def test_pictures_of_every_kind_come_with_three_channels(root: Path) -> None:
    for frame in open_dataset(root).frames():
        image = frame.undistorted_bgr()
        assert image.shape == (120, 160, 3)
        assert abs(float(image[60, 10, 0]) - 200) < 4
        assert image[45, 65].max() < 30


def test_a_missing_split_is_told_with_those_that_there_are(root: Path, tmp_path: Path) -> None:
    with pytest.raises(BopError, match=r"hawks: no split 'val'; it has test, train_pbr"):
        open_dataset(root, "val")
    with pytest.raises(BopError, match="no BOP scene"):
        open_dataset(root / "models")
    with pytest.raises(BopError, match="nowhere is not a folder"):
        open_dataset(tmp_path / "nowhere")


def test_boxes_come_from_masks_where_the_scene_does_not_tell_them(root: Path) -> None:
    frame = next(open_dataset(root, "test").frames())
    np.testing.assert_array_equal(frame.targets[0].box_visible_xyxy_px, BOX_EDGES)
    assert frame.targets[0].visible_px == 360
    mask = frame.mask(0)
    assert mask is not None
    np.testing.assert_array_equal(mask, silhouette() > 0)


def test_boxes_come_from_the_model_where_there_are_no_masks_either(tmp_path: Path) -> None:
    write_scene(tmp_path / "test" / "000001", masks=False)
    # Half a metre is 3 px here, at 1,200 px and 200 m; the origin lies at (61.5, 44.5).
    write_ply(tmp_path / "models" / "obj_000001.ply", [[-500, 0, 0], [500, 0, 0], [0, 1000, 0], [0, -500, 0]])
    target = next(open_dataset(tmp_path).frames()).targets[0]
    np.testing.assert_allclose(target.box_whole_xyxy_px, [58.5, 41.5, 64.5, 50.5], atol=1e-6)
    np.testing.assert_allclose(target.box_visible_xyxy_px, [58.5, 41.5, 64.5, 50.5], atol=1e-6)
    assert open_dataset(tmp_path).models[1].diameter_m == pytest.approx(1.5)


def test_a_projected_box_ends_at_the_picture(tmp_path: Path) -> None:
    write_scene(tmp_path / "test" / "000001", masks=False)
    write_models_info(
        tmp_path, min_x=-20e3, min_y=-1e3, min_z=0, size_x=40e3, size_y=2e3, size_z=0
    )  # 120 px to each side of column 61.5, 6 px to each side of row 44.5
    target = next(open_dataset(tmp_path).frames()).targets[0]
    np.testing.assert_allclose(target.box_whole_xyxy_px, [-58.5, 38.5, 181.5, 50.5], atol=1e-6)
    np.testing.assert_allclose(target.box_visible_xyxy_px, [-0.5, 38.5, 159.5, 50.5], atol=1e-6)


def test_what_the_scene_says_of_a_box_is_believed(root: Path) -> None:
    info = {"bbox_visib": [1, 2, 3, 4], "bbox_obj": [0, 0, 9, 9], "px_count_visib": 5}
    write_json(root / "test" / "000002" / "scene_gt_info.json", {"1": [info], "12": [{"bbox_visib": [-1, -1, -1, -1]}]})
    told, hidden, _ = (frame.targets[0] for frame in open_dataset(root, "test").frames())
    np.testing.assert_array_equal(told.box_visible_xyxy_px, [0.5, 1.5, 3.5, 5.5])
    assert hidden.box_visible_xyxy_px is None
    assert hidden.visible_px == 0


def test_without_any_model_the_diameter_comes_from_how_large_targets_look(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "train" / "000000", (0, 1))
    dataset = open_dataset(tmp_path, "train")
    assert dataset.split == "train"
    assert dataset.models[1].diameter_m == pytest.approx(30 * 200.0 / 1200.0)  # 30 px at 200 m
    assert read_scene_truth(scene).truths[0].diameter_m == pytest.approx(5.0)
    for text in ("diameter_m = 6.5\n", "[objects.1]\ndiameter_m = 6.5\n"):
        (tmp_path / "model_frame.toml").write_text(text)
        assert open_dataset(tmp_path, "train").models[1].diameter_m == 6.5
    (tmp_path / "model_frame.toml").write_text("diameter_m = 6.5\n[objects.2]\ndiameter_m = 9.0\n")
    models = open_dataset(tmp_path, "train").models
    assert {number: model.diameter_m for number, model in models.items()} == {1: 6.5, 2: 9.0}


def test_a_scene_without_its_own_cameras_takes_the_datasets(root: Path) -> None:
    (root / "test" / "000048" / "scene_camera.json").unlink()
    shared = {"fx": 900.0, "fy": 901.0, "cx": 80.0, "cy": 60.0, DISTORTION_KEY: [-0.1, 0, 0, 0, 0]}
    write_json(root / "camera.json", shared)
    frame = next(open_dataset(root / "test" / "000048").frames())
    np.testing.assert_array_equal(frame.K, [[900, 0, 80], [0, 901, 60], [0, 0, 1]])
    assert frame.distortion == (-0.1, 0, 0, 0, 0)
    del shared["fx"]
    write_json(root / "camera.json", shared)
    with pytest.raises(BopError, match=r"camera\.json: 'camera' has no 'fx'"):
        list(open_dataset(root / "test" / "000048").frames())


def test_listed_pictures_that_are_missing_are_left_out_and_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    (root / "train_pbr" / "000007" / "rgb" / "000010.jpg").unlink()
    assert ids(open_dataset(root, "train")) == [(7, 3), (7, 1041)]
    assert "000007: 1 listed pictures are missing" in caplog.text
    for path in (root / "train_pbr" / "000007" / "rgb").iterdir():
        path.unlink()
    with pytest.raises(BopError, match="000007 holds no picture of those that it lists"):
        list(open_dataset(root, "train").frames())


@pytest.mark.parametrize("kind", ["rgb", "mask_visib"])
def test_a_folder_that_cannot_be_listed_is_not_taken_for_an_empty_one(root: Path, kind: str) -> None:
    folder = root / "train_pbr" / "000007" / kind
    shutil.rmtree(folder, ignore_errors=True)
    folder.symlink_to(folder)  # as little to be listed as one without permission, by root too
    with pytest.raises(BopError, match=f"{kind}: cannot be listed: Too many levels of symbolic links"):
        [frame.scene.mask(frame.scene.frames[0], 0) for frame in open_dataset(root, "train").frames()]


def test_pictures_of_an_unknown_camera_are_left_out_and_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = root / "train_pbr" / "000007" / "scene_camera.json"
    cameras = json.loads(path.read_text())
    write_json(path, {key: cameras[key] for key in ("3", "1041")})
    assert ids(open_dataset(root, "train")) == [(7, 3), (7, 1041)]
    assert "000007: 1 pictures are left out: no file gives their camera matrix" in caplog.text
    caplog.clear()
    assert ids(open_dataset(root, "test")) == [(2, 1), (2, 12), (48, 5)]
    assert caplog.text == ""


def test_pictures_whose_truth_is_kept_back_are_not_taken_for_empty_ones(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    every = ids(open_dataset(root, "test"))
    (root / "test" / "000002" / "scene_gt.json").unlink()
    write_json(root / "test" / "000002" / "scene_gt_info.json", {"1": [{"bbox_visib": BOX}]})  # tells no pose
    write_json(root / "test" / "000048" / "scene_gt.json", {})  # a file that leaves a picture out
    labelled = open_dataset(root, "test").labelled_frames()
    assert [(frame.scene_id, frame.image_id) for frame in labelled] == [one for one in every if one[0] != 2]
    assert "test/000002: 2 pictures count nowhere: no scene_gt.json" in caplog.text
    (root / "test" / "000048" / "scene_gt.json").unlink()
    with pytest.raises(BopError, match=r"no scene_gt\.json .* tells what its pictures show"):
        open_dataset(root, "test").labelled_frames()


def test_the_list_of_test_targets_chooses_pictures_and_instances(root: Path) -> None:
    folder = root / "test" / "000002"
    poses = [{"obj_id": obj_id, "cam_R_m2c": UNIT, "cam_t_m2c": [x, 0, 2e5]} for x, obj_id in enumerate((1, 1, 8, 1))]
    write_json(folder / "scene_gt.json", {"1": poses, "12": poses})
    seen = [{"bbox_visib": BOX, "px_count_visib": count, "px_count_all": 99} for count in (10, 40, 99, 50)]
    write_json(folder / "scene_gt_info.json", {"1": seen, "12": seen})
    listed = [{"scene_id": 2, "im_id": 12, "obj_id": 1, "inst_count": 2}]
    write_json(root / "test_targets_bop19.json", listed)
    dataset = open_dataset(root)
    assert ids(dataset) == [(2, 12), (7, 3), (7, 10), (7, 1041)]  # the training split stays whole
    frame = next(dataset.frames())
    assert frame.target_indices == (1, 3)  # the two of object 1 of which most is visible
    assert [target.t_cam_target_m[0] for target in frame.targets] == [0.001, 0.003]
    del listed[0]["inst_count"]
    write_json(root / "test_targets_bop19.json", listed)
    assert next(open_dataset(root).frames()).target_indices == (3,)
    write_json(root / "test_targets_bop19.json", [{"scene_id": 2, "obj_id": 1}])
    with pytest.raises(BopError, match=r"test_targets_bop19\.json: 'entry 0' has no integer 'im_id'"):
        list(open_dataset(root).frames())


def test_listed_test_pictures_that_there_are_not_are_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    listed = [{"scene_id": scene, "im_id": 1, "obj_id": 1, "inst_count": 1} for scene in (2, 3, 4)]
    write_json(root / "test_targets_bop19.json", [*listed, {"scene_id": 2, "im_id": 99, "obj_id": 1, "inst_count": 1}])
    assert ids(open_dataset(root, "test")) == [(2, 1)]
    assert "3 of the pictures that it lists are missing, and count nowhere, such as 99 of scene 2" in caplog.text
    caplog.clear()
    assert ids(open_dataset(root / "test" / "000002")) == [(2, 1)]
    assert "1 of the pictures that it lists are missing" in caplog.text  # those of other scenes were not asked for


def test_labels_of_another_picture_size_are_refused(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "masks" / "train" / "000000")
    cv2.imwrite(str(scene / "mask_visib" / "000000_000000.png"), np.kron(silhouette(), np.ones((2, 2), np.uint8)))
    with pytest.raises(BopError, match="picture 0 has 160 x 120 pixels, but its mask has 320 x 240"):
        list(open_dataset(tmp_path / "masks").frames())
    scene = write_scene(tmp_path / "boxes" / "train" / "000000", masks=False)
    write_json(scene / "scene_gt_info.json", {"0": [{"bbox_visib": [640, 480, 80, 80]}]})
    with pytest.raises(BopError, match="160 x 120 pixels, but the visible box of its obj_id 1 lies outside"):
        list(open_dataset(tmp_path / "boxes").frames())


def test_a_folder_that_may_not_be_searched_is_passed_over(
    root: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As lost+found is on a disk of its own."""
    (root / "lost+found").mkdir()
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "lost+found" and allowed(path, mode))
    assert len(ids(open_dataset(root, "test"))) > 2
    assert "lost+found: cannot be searched" in caplog.text


def test_indices_may_write_the_same_number_in_different_ways(root: Path) -> None:
    pose = {"obj_id": 1.0, "cam_R_m2c": UNIT, "cam_t_m2c": T_MM}
    write_json(root / "test" / "000048" / "scene_gt.json", {"000005": [pose]})
    (frame,) = open_dataset(root / "test" / "000048").frames()
    assert [target.object_id for target in frame.targets] == [1]


def test_scenes_named_by_words_are_counted(tmp_path: Path) -> None:
    for name in ("pass_b", "pass_a"):
        write_scene(tmp_path / "val" / name)
    dataset = open_dataset(tmp_path, "val")
    assert [(scene.scene_id, scene.folder.name) for scene in dataset.scenes] == [(0, "pass_a"), (1, "pass_b")]


def runs(mask: np.ndarray) -> dict[str, Any]:
    """COCO's uncompressed run lengths, down the columns, beginning with zeros."""
    groups = [(value, len(list(group))) for value, group in groupby((mask.T.ravel() > 0).tolist())]
    return {"size": list(mask.shape), "counts": ([0] if groups[0][0] else []) + [count for _, count in groups]}


def test_an_imagewise_dataset_reads_as_the_same_scenewise(root: Path, tmp_path: Path) -> None:
    write_json(root / "test" / "000002" / "scene_gt_info.json", {"1": [{"bbox_visib": BOX}]})
    flat = tmp_path / "flat"
    write_models_info(flat)
    for scene in (root / "test").iterdir():
        for path in (p for name in ("rgb", "gray") for p in (scene / name).glob("*")):
            image_id = int(path.stem)
            key = flat / "test" / f"{int(scene.name):06d}_{image_id:06d}"
            for kind in ("camera", "gt", "gt_info"):
                source = scene / f"scene_{kind}.json"
                entry = json.loads(source.read_text()).get(str(image_id)) if source.exists() else None
                if entry is not None:
                    write_json(Path(f"{key}.{kind}.json"), entry)
            Path(f"{key}.{path.parent.name}{path.suffix}").write_bytes(path.read_bytes())
            write_json(Path(f"{key}.mask_visib.json"), {"0": runs(silhouette())})
    one, other = open_dataset(root, "test"), open_dataset(flat, "test")
    assert ids(one) == ids(other) == [(2, 1), (2, 12), (48, 5)]
    for a, b in zip(one.frames(), other.frames(), strict=True):
        np.testing.assert_array_equal(a.image_bgr(), b.image_bgr())
        np.testing.assert_array_equal(a.targets[0].box_visible_xyxy_px, b.targets[0].box_visible_xyxy_px)
        np.testing.assert_array_equal(a.targets[0].t_cam_target_m, b.targets[0].t_cam_target_m)
        mask = b.mask(0)
        assert mask is not None
        np.testing.assert_array_equal(mask, silhouette() > 0)


def test_a_lens_is_taken_out_and_projected_boxes_lie_in_the_picture_on_disk(tmp_path: Path) -> None:
    folder, lens = write_scene(tmp_path / "test" / "000001", masks=False), (-0.9, 0.3, 0.0, 0.0, 0.0)
    wide_K = [150.0, 0, 79.5, 0, 150.0, 59.5, 0, 0, 1]
    write_json(folder / "scene_camera.json", {"0": {"cam_K": wide_K, DISTORTION_KEY: lens}})
    pose = {"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": [70e3, 40e3, 200e3]}
    write_json(folder / "scene_gt.json", {"0": [pose]})
    write_ply(tmp_path / "models" / "obj_000001.ply", [[0, 0, 0], [4000, 0, 0], [0, 4000, 0]])
    # Where the lens puts each vertex, by its formula, from x / z and y / z; a white dot marks the first, the origin.
    rays = np.array([[0.35, 0.2], [0.37, 0.2], [0.35, 0.22]])
    r2 = (rays**2).sum(axis=1, keepdims=True)
    vertices_px = 150 * rays * (1 + lens[0] * r2 + lens[1] * r2**2) + (79.5, 59.5)
    on_disk = vertices_px[0]
    image = np.zeros((120, 160, 3), np.uint8)
    cv2.circle(image, [round(v) for v in on_disk], 2, (255, 255, 255), -1)
    cv2.imwrite(str(folder / "rgb" / "000000.jpg"), image)
    frame = next(open_dataset(tmp_path).frames())
    row, column = np.unravel_index(frame.undistorted_bgr()[..., 0].argmax(), (120, 160))
    assert abs(column - (79.5 + 150 * 0.35)) <= 3
    assert abs(row - (59.5 + 150 * 0.2)) <= 3
    assert np.linalg.norm(on_disk - (79.5 + 150 * 0.35, 59.5 + 150 * 0.2)) > 6
    np.testing.assert_array_equal(read_scene_truth(folder).undistorted_bgr(0), frame.undistorted_bgr())
    expected = [*vertices_px.min(axis=0), *vertices_px.max(axis=0)]
    np.testing.assert_allclose(frame.targets[0].box_visible_xyxy_px, expected, atol=1e-6)


def test_boxes_behind_a_lens_lie_where_the_undistorted_picture_shows_the_target(tmp_path: Path) -> None:
    folder, lens = write_scene(tmp_path / "test" / "000001", (0, 1, 2), masks=False), (-0.3, 0.02, 0.004, -0.003, 0.0)
    wide_K = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])
    write_json(
        folder / "scene_camera.json",
        {str(i): {"cam_K": wide_K.ravel().tolist()} | ({DISTORTION_KEY: lens} if i < 2 else {}) for i in range(3)},
    )
    # The first is seen whole, of the second the picture of a pinhole camera has room for a part, of the third for none.
    rays = np.array([[-0.5, 0.2, 1.0], [0.1, 0.58, 1.0], [0.0, 0.68, 1.0]])
    (folder / "mask_visib").mkdir()
    shown = []
    for k, ray in enumerate(rays):
        around = np.linspace(0, 2 * np.pi, 60)
        ring = ray + 0.05 * np.column_stack([np.cos(around), np.sin(around), np.zeros(60)])
        outline, _ = cv2.projectPoints(ring, np.zeros(3), np.zeros(3), wide_K, np.array(lens))
        mask = np.zeros(SIZE_WH[::-1], np.uint8)
        cv2.fillPoly(mask, [np.round(outline * 16).astype(np.int32)], 255, shift=4)
        assert mask.any()
        shown.append(box_of_mask(cv2.undistort(mask, wide_K, np.array(lens)) > 127))
        for image_id in range(3):
            cv2.imwrite(str(folder / "mask_visib" / f"{image_id:06d}_{k:06d}.png"), mask)
    poses = [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": (2e5 * ray).tolist()} for ray in rays]
    write_json(folder / "scene_gt.json", {"0": poses, "1": [], "2": poses})
    bent, empty, plain = open_dataset(tmp_path).frames()
    whole, part, none = bent.undistorted_boxes_xyxy_px(SIZE_WH)
    assert none is None
    assert shown[2] is None
    np.testing.assert_allclose(np.stack([whole, part]), np.stack(shown[:2]), atol=1.1)
    assert part[3] == SIZE_WH[1] - 0.5
    assert np.abs(whole - bent.targets[0].box_visible_xyxy_px).max() > 4.0
    assert empty.undistorted_boxes_xyxy_px(SIZE_WH) == []
    assert plain.undistorted_boxes_xyxy_px(SIZE_WH)[0] is plain.targets[0].box_visible_xyxy_px


def test_pictures_of_16_bits_are_read_by_their_upper_eight_and_told_of_where_those_are_empty(
    root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = root / "test" / "000048" / "gray" / "000005.tif"
    eight = picture(gray=True)
    for suffix in (".tif", ".png"):
        path.unlink()
        path = path.with_suffix(suffix)
        cv2.imwrite(str(path), eight.astype(np.uint16) * 256 + 255)
        (frame,) = open_dataset(root / "test" / "000048").frames()
        np.testing.assert_array_equal(frame.image_bgr(), np.repeat(eight[..., None], 3, axis=2))
        cv2.imwrite(str(path), eight.astype(np.uint16) * 16)  # of a camera of 12 bits, as it came
        assert frame.undistorted_bgr().max() < 16
    assert [record.message for record in caplog.records if "16 bits" in record.message] == [
        f"{path.parent}: holds pictures of 16 bits that do not use the upper two: unless it is dark there, scale them, "
        "to 16 or to 8"
    ]
    path.unlink()
    cv2.imwrite(str(path.with_suffix(".tiff")), picture().astype(np.float32) / 255)
    (frame,) = open_dataset(root / "test" / "000048").frames()
    with pytest.raises(BopError, match=r"000005\.tiff has pixels of float32, not of 8 or 16 bits"):
        frame.image_bgr()


def _broken(name: str, value: Any) -> Callable[[Path], None]:
    return lambda root: write_json(root / name, value)


@pytest.mark.parametrize(
    ("breaks", "said"),
    [
        (_broken("test/000002/scene_camera.json", {"1": {}}), r"scene_camera\.json: '1' has no 'cam_K'"),
        (_broken("models/models_info.json", {"1": {"diameter": "long"}}), r"models_info\.json: 'diameter' of '1'"),
        (_broken("models/models_info.json", {"1": {"size_x": 5}}), r"models_info\.json: '1' has no 'diameter'"),
        (_broken("models/models_info.json", {"9": {"diameter": 5}}), r"scene_gt\.json: obj_id 1 is not among"),
        (_broken("test/000002/scene_gt.json", {"1": [{"obj_id": 1}]}), r"scene_gt\.json: '1' has no 'cam_R_m2c'"),
        (lambda root: (root / "models" / "models_info.json").write_text("{"), r"models_info\.json line 1 is not JSON"),
    ],
)
def test_what_is_broken_is_told_with_file_and_key(root: Path, breaks: Callable[[Path], object], said: str) -> None:
    breaks(root)
    with pytest.raises(InputError, match=said):
        read_scene_truth(root / "test" / "000002")


def test_the_command_ends_with_exit_code_2_and_a_sentence(root: Path) -> None:
    (root / "model_frame.toml").write_text("R_body = 1\n")
    command = [Path(sys.executable).parent / "uavpose-replay", "score", "--dataset", root, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2, done.stderr
    assert f"{root / 'model_frame.toml'}: unknown key 'R_body'" in done.stderr
    assert "Traceback" not in done.stderr
