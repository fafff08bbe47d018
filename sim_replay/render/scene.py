"""What is to be drawn: camera, targets and surroundings, as plain values in local NED metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_replay.render.environment import WEATHERS, Environment, Weather, environment_from_seed
from sim_replay.render.projection import Distortion, undistorted

__all__ = ["WEATHERS", "Camera", "Environment", "Scene", "Target", "Weather", "environment_from_seed", "rays_ned"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """OpenCV's camera; pixel centres lie at integer coordinates. Its K has no skew."""

    K: Array  # [3, 3], pixels
    width_px: int
    height_px: int
    R_ned_cam: Array  # [3, 3]
    t_ned_cam_m: Array  # [3]; height above the ground is -z
    distortion: Distortion | None = None  # k1, k2, p1, p2, k3; None: a pinhole


def rays_ned(pixels: Array, camera: Camera) -> Array:
    """Unit vectors [N, 3], NED, along the rays of pixels [N, 2]."""
    plane = (pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2]
    if camera.distortion is not None:
        plane = undistorted(plane, camera.distortion)
    rays = np.hstack([plane, np.ones((len(plane), 1))]) @ camera.R_ned_cam.T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@dataclass(frozen=True)
class Target:
    """An aircraft in the scene."""

    airframe_id: int  # as sim_replay.airframes.airframe_of takes it
    livery_seed: int
    R_ned_body: Array  # [3, 3]
    t_ned_body_m: Array  # [3]

    def pose_in(self, camera: Camera) -> tuple[Array, Array]:
        """(R_cam_target [3, 3], t_cam_target_m [3]) in that camera."""
        R_cam_ned = camera.R_ned_cam.T
        return R_cam_ned @ self.R_ned_body, R_cam_ned @ (self.t_ned_body_m - camera.t_ned_cam_m)


@dataclass(frozen=True)
class Scene:
    """One exposure. `camera` and `targets` are at its middle, which the labels describe."""

    camera: Camera
    targets: tuple[Target, ...]
    environment: Environment
    sensor_seed: int = 0  # blur, exposure and colour of the camera; the distractors' paths
    frame_index: int = 0  # continues noise, exposure drift and distractors from frame to frame
    shutter_close: tuple[Camera, tuple[Target, ...]] | None = None  # the same when the shutter closes; None: no motion
    distractors: int = 0  # birds and specks that cross the image, in front of or behind the targets
    backdrop: Path | None = None  # a photograph, or a panorama twice as wide as high, in place of sky and ground
