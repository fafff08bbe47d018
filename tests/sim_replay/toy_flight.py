"""A sequence that the toy network can be flown on: an own ship in level flight past a target, or past an empty sky."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from sim_replay.telemetry import Telemetry, write_telemetry
from tests.edge.toy_scene import FOCAL_PX, draw

FPS = 10.0
SIZE_WH = (640, 384)


def write_toy_flight(
    folder: Path, frames: int = 30, *, target: bool = True, labelled: bool = False, from_s: float = -1.0
) -> Path:
    """A scene with sequence.toml, and telemetry of 50 Hz from `from_s` to a second after the last exposure.

    If labelled, its labels say that no picture shows a target, whatever is drawn.
    """
    (folder / "rgb").mkdir(parents=True)
    noise = np.random.default_rng(5)
    for index in range(frames):
        image = draw((200.5 + 4 * index, 150.5 + 2 * index), SIZE_WH) if target else np.zeros((384, 640, 3), np.uint8)
        image |= noise.integers(0, 40, image.shape, np.uint8)  # as a camera has it, and not frozen
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), image)
    K = [FOCAL_PX, 0.0, 319.5, 0.0, FOCAL_PX, 191.5, 0.0, 0.0, 1.0]
    cameras = {str(index): {"cam_K": K, "depth_scale": 1.0} for index in range(frames)}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    if labelled:
        (folder / "scene_gt.json").write_text(json.dumps({str(index): [] for index in range(frames)}))
    t_s = np.arange(from_s, frames / FPS + 1.0, 0.02)
    values = np.zeros((len(t_s), 16))
    values[:, 0] = 1.0
    values[:, 13:] = (47.0, 8.0, 500.0)
    write_telemetry(folder / "telemetry.csv", Telemetry(np.round(t_s * 1e9).astype(np.int64), values))
    (folder / "sequence.toml").write_text(
        f"fps = {FPS}\nt0_ns = 0\nR_body_cam = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]\nt_body_cam_m = [0, 0, 0]\n"
    )
    return folder
