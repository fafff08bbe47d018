"""What a scene may say of a target that is thin, hidden or behind the camera; numbers that no file should hold."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sim_replay.bop import DISTORTION_KEY, BopError, find_scenes, read_scene
from sim_replay.bop.scene import picture_size_wh, read_picture_bgr
from sim_replay.cli import main
from sim_replay.datasets import open_dataset
from sim_replay.evaluation.judge import truths_of
from sim_replay.ground_truth import read_scene_truth
from tests.sim_replay.foreign import (
    BOX_EDGES,
    SIZE_WH,
    UNIT,
    K,
    silhouette,
    write_json,
    write_models_info,
    write_scene,
)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_models_info(tmp_path / "hawks")
    return write_scene(tmp_path / "hawks" / "test" / "000001", masks=False)


def seen(scene: Path, **info: Any) -> Any:
    write_json(scene / "scene_gt_info.json", {"0": [info]})
    return read_scene(scene).frames[0].targets[0]


def placed(scene: Path, *t_mm: float) -> None:
    write_json(scene / "scene_gt.json", {"0": [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": t_mm}]})


def test_pictures_come_by_their_number_however_the_index_lists_them(scene: Path) -> None:
    cameras = {
        key: {"cam_K": [float(f), 0, 79.5, 0, 1200.0, 59.5, 0, 0, 1]} for f, key in ((3, "10"), (1, "2"), (2, "9"))
    }
    write_json(scene / "scene_camera.json", cameras)
    assert [(frame.image_id, frame.K[0, 0]) for frame in read_scene(scene).frames] == [(2, 1.0), (9, 2.0), (10, 3.0)]


def test_a_scene_with_its_own_cameras_does_not_take_the_datasets(scene: Path) -> None:
    write_json(scene.parents[1] / "camera.json", {"fx": 9.0, "fy": 9.0, "cx": 9.0, "cy": 9.0})
    assert read_scene(scene).frames[0].K.ravel().tolist() == K


def test_of_two_pictures_of_one_number_the_coloured_is_used_and_the_first_suffix(scene: Path) -> None:
    for name, value in (("gray/000000.jpg", 10), ("rgb/000000.png", 50), ("rgb/000000.bmp", 90)):
        (scene / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(scene / name), np.full((120, 160, 3), value, np.uint8))
    opened = read_scene(scene)
    assert opened.image_path(opened.frames[0]) == scene / "rgb" / "000000.bmp"
    assert opened.image_bgr(opened.frames[0]).max() == 90
    assert (opened.pictures_without_camera, len(opened.pictured)) == (0, 1)


def test_other_files_in_an_imagewise_folder_are_passed_over_and_broken_masks_are_named(tmp_path: Path) -> None:
    key = "000004_000007"
    for name in (f"{key}.camera.json", "notes.camera.json", f"{key}.gt.json"):
        content = {"cam_K": K} if name.startswith(key) else {}
        write_json(tmp_path / name, [] if "gt" in name else content)
    for suffix, value in ((".rgb.png", 90), (".rgb.jpg", 50), (".rgb.txt", 0)):
        cv2.imwrite(str(tmp_path / f"{key}.png"), np.full((120, 160, 3), value, np.uint8))
        (tmp_path / f"{key}.png").rename(tmp_path / f"{key}{suffix}")
    (scene,) = find_scenes(tmp_path)
    (frame,) = scene.pictured
    assert (scene.scene_id, frame.image_id, scene.image_path(frame).suffix) == (4, 7, ".jpg")
    assert scene.mask(frame, 0) is None
    counts = ([5], [10**13], [10**30], [-(10**30), 10**30 + 19200], [19205, -5], [1.5, 19198.5], "0dV2", None)
    broken_masks: list[Any] = [{"size": [120, 160]}, {"size": 1, "counts": [1]}, [1]]
    for broken in [*broken_masks, *({"size": [120, 160], "counts": one} for one in counts)]:
        write_json(tmp_path / f"{key}.mask_visib.json", {"1": broken})
        assert scene.mask(frame, 0) is None
        with pytest.raises(BopError, match=r"mask_visib\.json: '1' does not hold 'size' and 'counts' of one mask"):
            scene.mask(frame, 1)


def test_a_side_of_nil_is_one_pixel_where_pixels_are_counted(scene: Path) -> None:
    thin = seen(scene, bbox_visib=[50, 40, 20, 0], bbox_obj=[50, 40, 0, 0], px_count_visib=21, px_count_all=1)
    np.testing.assert_array_equal(thin.box_visible_xyxy_px, [49.5, 39.5, 69.5, 40.5])
    np.testing.assert_array_equal(thin.box_whole_xyxy_px, [49.5, 39.5, 50.5, 40.5])
    assert thin.visible_px == 21
    dataset = open_dataset(scene)
    assert len(truths_of(0, dataset.labelled_frames()[0], dataset.models)) == 1


@pytest.mark.parametrize(
    "info",
    [
        {"bbox_visib": [-1, -1, -1, -1], "px_count_visib": 5},
        {"bbox_visib": [50, 40, 20, 0], "px_count_visib": 0},
        {"bbox_visib": [0, 0, 0, 0]},
    ],
)
def test_a_box_that_is_none_is_of_a_hidden_target(scene: Path, info: dict[str, Any]) -> None:
    hidden = seen(scene, **info)
    assert (hidden.box_visible_xyxy_px, hidden.visible_px) == (None, 0)


@pytest.mark.parametrize("value", [1, 65535])
def test_a_mask_of_16_bits_shows_what_it_marks(scene: Path, value: int) -> None:
    (scene / "mask_visib").mkdir()
    cv2.imwrite(str(scene / "mask_visib" / "000000_000000.png"), (silhouette() > 0).astype(np.uint16) * value)
    (target,) = open_dataset(scene).labelled_frames()[0].targets
    np.testing.assert_array_equal(target.box_visible_xyxy_px, BOX_EDGES)


def test_what_is_seen_lies_before_the_camera(scene: Path) -> None:
    write_json(scene / "scene_gt_info.json", {"0": [{"bbox_visib": [9, 9, 5, 5]}]})
    for z_mm in (0.0, -2e5):
        placed(scene, 5e3, 0, z_mm)
        with pytest.raises(BopError, match=r"scene_gt\.json: 'cam_t_m2c' of '0' puts obj_id 1 behind the camera"):
            read_scene(scene)
    (scene / "scene_gt_info.json").unlink()
    mask = np.zeros((120, 160), np.uint8)
    mask[40:50, 40:60] = 255
    (scene / "mask_visib").mkdir()
    cv2.imwrite(str(scene / "mask_visib" / "000000_000000.png"), mask)
    with pytest.raises(BopError, match="a mask shows obj_id 1 in picture 0, but its cam_t_m2c lies behind the camera"):
        open_dataset(scene).labelled_frames()


def test_what_is_not_seen_may_lie_behind_the_camera_and_is_not_missed(scene: Path) -> None:
    placed(scene, 5e3, 0, -2e5)
    for info in ({"bbox_visib": [-1, -1, -1, -1]}, {"bbox_visib": [9, 9, 5, 5], "px_count_visib": 0}, None):
        if info is None:
            (scene / "scene_gt_info.json").unlink()
        else:
            seen(scene, **info)
        dataset = open_dataset(scene)
        assert truths_of(0, dataset.labelled_frames()[0], dataset.models) == []
        assert not read_scene_truth(scene).shows_target


def test_a_target_in_the_camera_itself_is_refused(scene: Path) -> None:
    placed(scene, 0, 0, 0)
    with pytest.raises(BopError, match="puts obj_id 1 into the camera itself"):
        read_scene(scene)
    assert seen(scene, bbox_visib=[-1, -1, -1, -1], px_count_visib=0).visible_px == 0, "one that nobody sees may be"


def test_a_picture_lies_as_its_pixels_do_whatever_its_exif_says(scene: Path) -> None:
    path = scene / "rgb" / "000000.jpg"
    data = path.read_bytes()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # turned by a quarter
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert cv2.imread(str(path)).shape == (160, 120, 3)
    assert read_scene(scene).image_bgr(read_scene(scene).frames[0]).shape == (120, 160, 3)


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_tiff_lies_as_its_pixels_do_whatever_its_orientation_tag_says(
    tmp_path: Path, orientation: int, order: str
) -> None:
    pixels = np.arange(12 * 20, dtype=np.uint8).reshape(12, 20)
    tags = {256: 20, 257: 12, 258: 8, 259: 1, 262: 1, 273: 200, 274: orientation, 277: 1, 278: 12, 279: pixels.size}
    head = struct.pack(f"{order}HIH", 42, 8, len(tags))
    for tag, value in tags.items():
        head += struct.pack(f"{order}HHI", tag, 3, 1) + struct.pack(f"{order}HH", value, 0)
    path = tmp_path / "000000.tif"
    path.write_bytes(((b"II" if order == "<" else b"MM") + head).ljust(200, b"\0") + pixels.tobytes())
    np.testing.assert_array_equal(read_picture_bgr(path)[..., 0], pixels)
    assert picture_size_wh(path) == (20, 12)


def test_each_picture_of_a_scene_cuts_its_targets_at_its_own_edge(scene: Path) -> None:
    """Sizes change in the middle of a scene; nothing but the model tells where the target is seen."""
    half_mm = {f"{kind}_{axis}": value for axis in "xyz" for kind, value in (("min", -2e3), ("size", 4e3))}
    write_models_info(scene.parents[1], **half_mm)
    sizes_wh = {0: (160, 120), 1: (320, 240), 2: (320, 240), 3: (105, 83), 4: (320, 240), 5: (105, 240)}
    (scene / "rgb" / "000000.jpg").unlink()
    for image_id, (width, height) in sizes_wh.items():
        suffix, options = {0: ".png", 2: ".bmp", 4: ".tif"}.get(image_id, ".jpg"), []
        if suffix == ".jpg":
            options = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(image_id == 5)]
        pixels = np.full((height, width, 3), 90, np.uint8)
        cv2.imwrite(str(scene / "rgb" / f"{image_id:06d}{suffix}"), pixels, options)
    cameras = {str(i): {"cam_K": [2000.0, 0, 100.0, 0, 2000.0, 80.0, 0, 0, 1]} for i in sizes_wh}
    write_json(scene / "scene_camera.json", cameras)
    middle_mm = {i: [0.0, 0.0, 2e5] if i in (3, 5) else [12e3, 8e3, 2e5] for i in sizes_wh}  # at 100, 80 or 220, 160 px
    poses = {str(i): [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": t_mm}] for i, t_mm in middle_mm.items()}
    write_json(scene / "scene_gt.json", poses)
    dataset = open_dataset(scene)
    frames = dataset.labelled_frames()
    boxes = [frame.targets[0].box_visible_xyxy_px for frame in frames]
    assert [len(truths_of(0, frame, dataset.models)) for frame in frames] == [0, 1, 1, 1, 1, 1]
    assert boxes[0] is None
    for k in (1, 2, 4):
        np.testing.assert_allclose(boxes[k], [198.8, 139.2, 241.4, 181.2], atol=1.5)
    np.testing.assert_allclose(boxes[3], [79.8, 59.8, 104.5, 82.5], atol=0.3)
    np.testing.assert_allclose(boxes[5], [79.8, 59.8, 104.5, 100.2], atol=0.3)


def test_a_target_beyond_what_a_lens_describes_is_not_seen_where_its_formula_folds_back(scene: Path) -> None:
    wide_K, lens = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]]), np.array([-0.25, 0.0, 0.0, 0.0, 0.0])
    write_json(scene / "scene_camera.json", {"0": {"cam_K": wide_K.ravel().tolist(), DISTORTION_KEY: lens.tolist()}})
    rays = np.array([[0.3, 0.1, 1.0], [1.9, 0.0, 1.0]])  # the second 62 degrees off the axis
    folded, _ = cv2.projectPoints(rays[1:], np.zeros(3), np.zeros(3), wide_K, lens)
    assert (folded > 0).all()
    assert (folded < SIZE_WH).all()
    poses = [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": (1e5 * ray).tolist()} for ray in rays]
    write_json(scene / "scene_gt.json", {"0": poses})
    half_mm = {f"{kind}_{axis}": value for axis in "xyz" for kind, value in (("min", -2e3), ("size", 4e3))}
    write_models_info(scene.parents[1], **half_mm)
    seen, beyond = open_dataset(scene).labelled_frames()[0].targets
    assert seen.box_visible_xyxy_px is not None
    assert (beyond.box_visible_xyxy_px, beyond.visible_px) == (None, 0)
    assert [truth.visible for truth in read_scene_truth(scene).truths] == [True, False]


def test_a_picture_with_much_written_in_its_head_has_a_size(tmp_path: Path) -> None:
    """As a camera's colour profile; Pillow refuses more than a megabyte of it, OpenCV passes over it."""
    coded = cv2.imencode(".png", np.zeros((20, 30, 3), np.uint8))[1].tobytes()
    note = b"zTXt" + b"note\0\0" + zlib.compress(bytes(2_000_000))
    chunk = (len(note) - 4).to_bytes(4, "big") + note + zlib.crc32(note).to_bytes(4, "big")
    head = 33  # signature and IHDR
    (tmp_path / "a.png").write_bytes(coded[:head] + chunk + coded[head:])
    assert picture_size_wh(tmp_path / "a.png") == (30, 20)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nests lists or objects too deep"),
        ('{"0": [{"obj_id": ' + "9" * 5000 + "}]}", "cannot be read"),
        ('{"' + "1" * 5000 + '": []}', "is not the number of a picture"),
    ],
)
def test_a_file_that_json_chokes_on_is_a_sentence(
    scene: Path, text: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (scene / "scene_gt.json").write_text(text)
    assert main(["stats", "--dataset", str(scene)]) == 2
    told = capsys.readouterr().err
    assert f"{scene / 'scene_gt.json'}" in told
    assert words in told
    assert len(told) < 500
