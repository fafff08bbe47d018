"""Datasets of others, written by hand as they come."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SIZE_WH = (160, 120)
K = [1200.0, 0, 79.5, 0, 1200.0, 59.5, 0, 0, 1]
UNIT = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
BOX = [50, 40, 30, 12]  # x, y, width, height of the target's pixels
BOX_EDGES = [49.5, 39.5, 79.5, 51.5]
T_MM = [-3000.0, -2500.0, 200000.0]


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def picture(gray: bool = False) -> np.ndarray:
    image = np.full((*SIZE_WH[::-1], 3), (200, 160, 120), np.uint8)
    image[40:52, 50:80] = 20
    return image[..., 0] if gray else image


def silhouette() -> np.ndarray:
    mask = np.zeros(SIZE_WH[::-1], np.uint8)
    mask[40:52, 50:80] = 255
    return mask


def write_scene(
    folder: Path, image_ids: tuple[int, ...] = (0,), folder_name: str = "rgb", suffix: str = ".jpg", masks: bool = True
) -> Path:
    """A scene with one target of object 1 a picture, its index as small as the format allows."""
    (folder / folder_name).mkdir(parents=True)
    for image_id in image_ids:
        cv2.imwrite(str(folder / folder_name / f"{image_id:06d}{suffix}"), picture(gray=folder_name == "gray"))
        if masks:
            (folder / "mask_visib").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / "mask_visib" / f"{image_id:06d}_000000.png"), silhouette())
    write_json(folder / "scene_camera.json", {str(i): {"cam_K": K, "depth_scale": 0.1} for i in image_ids})
    pose = {"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": T_MM}
    write_json(folder / "scene_gt.json", {str(i): [pose] for i in image_ids})
    return folder


def write_models_info(root: Path, **more: float) -> None:
    write_json(root / "models" / "models_info.json", {"1": {"diameter": 6000.0} | more})


def write_ply(path: Path, vertices_mm: list[list[float]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices_mm)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(head + "".join(" ".join(map(str, row)) + "\n" for row in vertices_mm))
