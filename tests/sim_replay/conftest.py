"""A world simple enough to know the answer: a dark spot before a bright sky, and a network that finds dark spots."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from torch import Tensor, nn

from msgs.contract import INPUT_NAMES, METADATA_KEY, OUTPUT_NAMES, ModelContract

SPOT_Z_M = 200.0  # the network says so of every spot
SPOT_SIZE_M = 12.0
FOCAL_PX = 2400.0
CX_PX, CY_PX = 959.5, 539.5
SPOTS_X_M = (-40.0, -15.0, 5.0, 30.0)  # one a frame


class DarkSpot(nn.Module):
    """The darkest pixel is the target; depth, rotation and sigma are constant."""

    def forward(self, image: Tensor, K: Tensor) -> tuple[Tensor, ...]:
        darkness = 255.0 - image.float().mean(dim=3)
        count, width = image.shape[0], image.shape[2]
        index = darkness.flatten(1).argmax(dim=1, keepdim=True)
        score = (darkness.flatten(1).max(dim=1, keepdim=True).values / 255.0).clamp(0.0, 1.0)
        u, v = (index % width).float(), (index // width).float()
        center = torch.stack([u, v], dim=2)
        fx, fy, cx, cy = K[:, 0, 0:1], K[:, 1, 1:2], K[:, 0, 2:3], K[:, 1, 2:3]
        size = torch.stack([fx, fy], dim=2) * (SPOT_SIZE_M / SPOT_Z_M)
        t = SPOT_Z_M * torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], dim=2)
        R = torch.eye(3).expand(count, 1, 3, 3)
        return score, center, size, center + 0.0, t, R, torch.full((1, 1, 6), 0.1).expand(count, 1, 6)


@pytest.fixture(scope="session")
def dark_spot_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ONNX file with the contract of the real one."""
    path = tmp_path_factory.mktemp("model") / "dark-spot.onnx"
    example = (torch.zeros(1, 64, 96, 3, dtype=torch.uint8), torch.eye(3)[None])
    axes = {name: {0: "N"} for name in (*INPUT_NAMES, *OUTPUT_NAMES)} | {"image": {0: "N", 1: "H", 2: "W"}}
    torch.onnx.export(
        DarkSpot(), example, str(path), input_names=list(INPUT_NAMES), output_names=list(OUTPUT_NAMES),
        dynamic_axes=axes, opset_version=17, dynamo=False,
    )  # fmt: skip
    contract = ModelContract(
        name="dark-spot", configuration="edge", backbone="none", precision="fp32", max_peaks=1,
        acquire_size_wh=(640, 384), acquire_fit="squash", track_size_wh=(256, 256), track_window_scale=1.8,
        acquire_score_min=0.5, track_score_min=0.5, trained_range_m=(50.0, 600.0), trained_focal_px=(500.0, 9000.0),
        trained_box_px=(8.0, 256.0), airframes=["spot"], training={}, metrics={}, weights_sha256="0" * 64,
    )  # fmt: skip
    model = onnx.load(path)
    model.metadata_props.add(key=METADATA_KEY, value=contract.model_dump_json())
    onnx.save(model, path)
    return path


@pytest.fixture
def dark_spot_scene(tmp_path: Path) -> Path:
    """A BOP scene of one dark spot a frame at 200 m, nose to the right of the picture; the last frame is empty."""
    scene = tmp_path / "dataset" / "test" / "000000"
    (scene / "rgb").mkdir(parents=True)
    cameras, poses = {}, {}
    for frame, x_m in enumerate((*SPOTS_X_M, None)):
        image = np.full((1080, 1920, 3), 240, np.uint8)
        if x_m is not None:
            u, v = round(CX_PX + FOCAL_PX * x_m / SPOT_Z_M), round(CY_PX)
            cv2.ellipse(image, (u, v), (70, 14), 0, 0, 360, (90, 90, 90), -1, cv2.LINE_AA)
            cv2.circle(image, (u, v), 6, (5, 5, 5), -1, cv2.LINE_AA)
            poses[str(frame)] = [
                {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [x_m * 1e3, 0.0, SPOT_Z_M * 1e3]}
            ]
        cv2.imwrite(str(scene / "rgb" / f"{frame:06d}.jpg"), image)
        cameras[str(frame)] = {"cam_K": [FOCAL_PX, 0, CX_PX, 0, FOCAL_PX, CY_PX, 0, 0, 1], "depth_scale": 1.0}
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    models = scene.parents[1] / "models"
    models.mkdir()
    box = {"min_x": -6e3, "min_y": -2e3, "min_z": -1e3, "size_x": 12e3, "size_y": 4e3, "size_z": 2e3}
    (models / "models_info.json").write_text(json.dumps({"1": {"diameter": 12.8e3, **box}}))
    return scene
