"""A scene and a model small enough for a loaded machine, for tests that are about processes and not about pictures."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from tests.edge.toy_model import write_toy_model
from tests.edge.toy_scene import FOCAL_PX, draw

SIZE_WH = (640, 384)
FRAMES = 40


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A BOP scene: a bright rectangle moves slowly across 640x384."""
    folder = tmp_path_factory.mktemp("scenes") / "000001"
    (folder / "rgb").mkdir(parents=True)
    for index in range(FRAMES):
        picture = draw((200.5 + 4 * index, 150.5 + 2 * index), SIZE_WH)
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), picture)
    K = [FOCAL_PX, 0.0, 319.5, 0.0, FOCAL_PX, 191.5, 0.0, 0.0, 1.0]
    cameras = {str(index): {"cam_K": K, "depth_scale": 1.0} for index in range(FRAMES)}
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


@pytest.fixture(scope="session")
def toy_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_model(tmp_path_factory.mktemp("model") / "toy.onnx")
