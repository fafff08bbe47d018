"""A rendered frame as BOP's record of it; the scene's world is local NED, and an airframe's number counts from 1."""

from __future__ import annotations

import numpy as np

from sim_replay.bop import BopFrame, BopTarget
from sim_replay.render.frame import SeenTarget
from sim_replay.render.scene import Camera, Scene, Target


def bop_frame(scene: Scene, targets: tuple[BopTarget, ...]) -> BopFrame:
    """The record of a frame that shows these targets."""
    camera = scene.camera
    R_cam_ned = camera.R_ned_cam.T
    return BopFrame(
        scene.frame_index,
        camera.K,
        targets,
        R_cam_ned,
        -R_cam_ned @ camera.t_ned_cam_m,
        distortion=camera.distortion,
    )


def bop_target(target: Target, camera: Camera, seen: SeenTarget) -> BopTarget:
    """The record of a target that was rendered."""
    boxes = (seen.box_visible_xyxy_px, seen.box_whole_xyxy_px)
    visible, whole = (None if box is None else np.asarray(box, dtype=np.float64) for box in boxes)
    return BopTarget(target.airframe_id + 1, *target.pose_in(camera), visible, whole, seen.visible_px, seen.whole_px)
