"""What SceneWriter writes, read by a minimal reader made from the BOP format document alone, and by OpenCV.

The reader here shares no code with `sim_replay.bop`: JSON, NumPy and OpenCV, names and units as
thodan/bop_toolkit docs/bop_datasets_format.md gives them.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_replay.airframes.mesh import Mesh
from sim_replay.bop import DISTORTION_KEY, BopFrame, BopTarget, SceneWriter, write_camera, write_models

SIZE_WH = (320, 240)
K = np.array([[2100.0, 0, 158.0], [0, 2090.0, 121.5], [0, 0, 1]])
LENS = (-0.2, 0.05, 0.001, -0.002, 0.01)
OBJECT_ID = 4
# A dart: nose ahead, a wing to each side, a fin up (z down), metres in body.
VERTICES_M = np.array([[6, 0, 0], [-4, 7, 0.5], [-4, -7, 0.5], [-4, 0, -3]], dtype=np.float32)
FACES = np.array([[0, 1, 3], [0, 3, 2], [0, 2, 1], [1, 2, 3]], dtype=np.int32)


def dart() -> Mesh:
    normals = (VERTICES_M / np.linalg.norm(VERTICES_M, axis=1, keepdims=True)).astype(np.float32)
    return Mesh(VERTICES_M, normals, np.zeros(4, np.uint8), FACES)


def outline(R: np.ndarray, t_m: np.ndarray, lens: tuple[float, ...] | None, size_wh: tuple[int, int]) -> np.ndarray:
    """Silhouette [H, W]: the hull of the projected corners, on a canvas as large as asked for."""
    pixels, _ = cv2.projectPoints(
        VERTICES_M.astype(float), cv2.Rodrigues(R)[0], t_m, K, np.zeros(5) if lens is None else np.array(lens)
    )
    canvas = np.zeros(size_wh[::-1], np.uint8)
    cv2.fillConvexPoly(canvas, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    return canvas.astype(bool)


def box(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5])


def poses() -> list[tuple[np.ndarray, np.ndarray]]:
    """Three views; in the last the dart leaves the picture to the right."""
    turns = Rotation.from_euler("ZYX", [[40, 10, -70], [-120, 30, 15], [-100, -20, 60]], degrees=True).as_matrix()
    return list(zip(turns, np.array([[2.0, -1.0, 210.0], [-6.0, 3.5, 260.0], [15.0, 0.0, 200.0]]), strict=True))


@pytest.fixture(scope="module", params=[None, LENS], ids=["pinhole", "distorted"])
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one scene; a cloud hides the right half of picture 5's dart."""
    root, lens = tmp_path_factory.mktemp("dataset"), request.param
    write_models(root / "models", {OBJECT_ID: dart()})
    write_camera(root / "camera.json", K, *SIZE_WH, distortion=lens)
    with SceneWriter(root / "test" / "000003", jpeg_quality=95) as writer:
        for image_id, (R, t_m) in zip((5, 9, 40), poses(), strict=True):
            canvas = outline(R, t_m, lens, (2 * SIZE_WH[0], SIZE_WH[1]))
            whole = canvas[:, : SIZE_WH[0]]
            seen = whole & (np.arange(SIZE_WH[0]) < (158 if image_id == 5 else SIZE_WH[0]))
            target = BopTarget(OBJECT_ID, R, t_m, box(seen), box(canvas), int(seen.sum()), int(canvas.sum()))
            picture = np.where(seen[..., None], 30, 220).astype(np.uint8) * np.ones(3, np.uint8)
            writer.add(BopFrame(image_id, K, (target,), distortion=lens), picture, [seen], [whole])
    return root


def by_the_document(root: Path) -> list[dict[str, Any]]:
    """Every annotated object: entries as the files give them, picture and masks as arrays."""
    scene = root / "test" / "000003"
    camera, gt, info = (
        json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
    )  # fmt: skip
    assert camera.keys() == gt.keys() == info.keys() == {"5", "9", "40"}
    objects = []
    for image_id in map(int, gt):
        for gt_id, (pose, seen) in enumerate(zip(gt[str(image_id)], info[str(image_id)], strict=True)):
            masks = (
                cv2.imread(str(scene / kind / f"{image_id:06d}_{gt_id:06d}.png"), cv2.IMREAD_UNCHANGED)
                for kind in ("mask", "mask_visib")
            )
            whole, visible = (mask > 127 for mask in masks)
            picture = cv2.imread(str(scene / "rgb" / f"{image_id:06d}.jpg"))
            objects.append(
                {"camera": camera[str(image_id)], "whole": whole, "visible": visible, "picture": picture} | pose | seen
            )
    return objects


def ply(root: Path) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Vertices [V, 6] (x, y, z and normal) and faces of a binary PLY, laid out as its header says."""
    head, body = (root / "models" / f"obj_{OBJECT_ID:06d}.ply").read_bytes().split(b"end_header\n", 1)
    assert head.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "element vertex 4",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        "element face 4", "property list uchar int vertex_indices",
    ]  # fmt: skip
    vertices, at, faces = np.frombuffer(body, "<f4", 4 * 6).reshape(4, 6), 4 * 6 * 4, []
    while at < len(body):
        faces.append(struct.unpack_from(f"<{body[at]}i", body, at + 1))
        at += 1 + 4 * body[at]
    return vertices.astype(float), faces


def vertices_mm(root: Path) -> np.ndarray:
    return ply(root)[0][:, :3].copy()


def test_the_model_file_holds_the_mesh(written: Path) -> None:
    vertices, faces = ply(written)
    np.testing.assert_allclose(vertices, np.hstack([1000.0 * VERTICES_M, dart().normals]), rtol=1e-6)
    assert faces == [tuple(face) for face in FACES.tolist()]


def test_the_model_projected_by_opencv_lies_on_its_masks_and_boxes(written: Path) -> None:
    for entry in by_the_document(written):
        R, t_mm = np.reshape(entry["cam_R_m2c"], (3, 3)), np.array(entry["cam_t_m2c"])
        lens = np.array(entry["camera"].get(DISTORTION_KEY, np.zeros(5)))
        cam_K = np.reshape(entry["camera"]["cam_K"], (3, 3))
        pixels, _ = cv2.projectPoints(vertices_mm(written), cv2.Rodrigues(R)[0], t_mm, cam_K, lens)
        low, high = pixels.reshape(-1, 2).min(0), pixels.reshape(-1, 2).max(0)
        x, y, width, height = entry["bbox_obj"]
        np.testing.assert_allclose([x, y], low, atol=0.6)
        np.testing.assert_allclose([x + width - 1, y + height - 1], high, atol=0.6)
        assert entry["visible"].any()
        np.testing.assert_array_equal(entry["picture"][..., 0] < 125, entry["visible"])


def test_counts_and_boxes_are_those_of_the_masks(written: Path) -> None:
    for entry in by_the_document(written):
        left, top, right, bottom = box(entry["visible"])
        assert entry["bbox_visib"] == [left + 0.5, top + 0.5, right - left, bottom - top]
        assert entry["px_count_visib"] == entry["visible"].sum()
        assert not (entry["visible"] & ~entry["whole"]).any()
        assert entry["px_count_valid"] == 0  # there is no depth image
        assert entry["visib_fract"] == pytest.approx(entry["px_count_visib"] / entry["px_count_all"])


def test_the_whole_silhouette_counts_beyond_what_hides_it_and_beyond_the_picture(written: Path) -> None:
    hidden, free, leaving = by_the_document(written)
    assert hidden["px_count_all"] == hidden["whole"].sum() > hidden["px_count_visib"] > 0
    assert free["visib_fract"] == 1.0
    assert leaving["px_count_all"] > leaving["whole"].sum() == leaving["px_count_visib"] > 0
    assert leaving["bbox_obj"][0] + leaving["bbox_obj"][2] > SIZE_WH[0]


def test_the_diameter_is_the_largest_distance_of_two_vertices(written: Path) -> None:
    info = json.loads((written / "models" / "models_info.json").read_text())[str(OBJECT_ID)]
    corners = vertices_mm(written)
    assert info["diameter"] == pytest.approx(max(np.linalg.norm(a - b) for a in corners for b in corners))
    np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], corners.min(0))
    np.testing.assert_allclose([info[f"size_{axis}"] for axis in "xyz"], np.ptp(corners, axis=0))


def test_camera_json_has_the_same_lens(written: Path) -> None:
    shared = json.loads((written / "camera.json").read_text())
    one = by_the_document(written)[0]["camera"]
    assert [shared["fx"], 0, shared["cx"], 0, shared["fy"], shared["cy"], 0, 0, 1] == one["cam_K"]
    assert (shared["width"], shared["height"]) == SIZE_WH
    assert shared.get(DISTORTION_KEY) == one.get(DISTORTION_KEY)
