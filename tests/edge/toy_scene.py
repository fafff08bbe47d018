"""Scenes the toy model can see: a bright rectangle on dark ground, where truth is known exactly."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .toy_model import SIZE_M

FOCAL_PX = 2000.0
SIZE_WH = (1920, 1080)
K = np.array([[FOCAL_PX, 0.0, 959.5], [0.0, FOCAL_PX, 539.5], [0.0, 0.0, 1.0]])
TARGET_WH = (120, 60)


def draw(center_px: tuple[float, float], size_wh: tuple[int, int] = SIZE_WH) -> NDArray[np.uint8]:
    """A picture of one target whose outermost pixel centres lie around `center_px`, half-integers."""
    image = np.zeros((size_wh[1], size_wh[0], 3), np.uint8)
    left, top = round(center_px[0] - (TARGET_WH[0] - 1) / 2), round(center_px[1] - (TARGET_WH[1] - 1) / 2)
    image[top : top + TARGET_WH[1], left : left + TARGET_WH[0]] = 255
    return image


# Stripes of two rows of pixels, six apart: the whole frame, reduced three times, mixes each with the dark between them.
FAINT_XYXY = (1600, 900, 1720, 960)
FAINT_GREY = 185


def draw_faint() -> NDArray[np.uint8]:
    """A picture of a target that only a tile of it shows, the last one."""
    image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    x0, y0, x1, y1 = FAINT_XYXY
    for row in range(y0, y1, 6):
        image[row : row + 2, x0:x1] = FAINT_GREY
    return image


def center_of(index: int) -> tuple[float, float]:
    return 500.5 + 8 * index, 420.5 + 2 * index


def write_scene(folder: Path, frames: int) -> Path:
    (folder / "rgb").mkdir(parents=True)
    for index in range(frames):
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), draw(center_of(index)), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    cameras = {str(index): {"cam_K": K.ravel().tolist(), "depth_scale": 1.0} for index in range(frames)}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def true_t_cam_target_m(center_px: tuple[float, float]) -> NDArray[np.float64]:
    """What the toy model should say of a target drawn there."""
    z_m = FOCAL_PX * SIZE_M / np.sqrt(TARGET_WH[0] * TARGET_WH[1])
    return z_m * np.linalg.inv(K) @ np.array([*center_px, 1.0])
