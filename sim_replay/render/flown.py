"""Scenes with the poses and cameras of flown datasets, all else drawn anew: livery, light, weather and ground.

`uavpose-replay generate --labels-only` flies such datasets a hundred times faster than it can render them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import AIRFRAMES
from sim_replay.bop import BopError, BopFrame, BopScene, find_scenes, names_split
from sim_replay.bop.fields import load_object
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed

Array = NDArray[np.float64]
FRAME_WIDTH_PX, FRAME_HEIGHT_PX = 1920, 1080


@dataclass(frozen=True)
class FlownFrames:
    """The first target of each of N frames and the pinhole camera that saw it; the world is local NED."""

    K: Array  # [N, 3, 3]
    R_ned_cam: Array  # [N, 3, 3]
    t_ned_cam_m: Array  # [N, 3]
    R_ned_body: Array  # [N, 3, 3]
    t_ned_body_m: Array  # [N, 3]
    airframe_id: NDArray[np.int64]  # [N], of the fleet

    def scene(self, rng: np.random.Generator, stranger: int | None = None) -> Scene:
        """One of the frames, with one target: the aircraft that flew, or this one in its place."""
        k = int(rng.integers(len(self.airframe_id)))
        camera = Camera(self.K[k], FRAME_WIDTH_PX, FRAME_HEIGHT_PX, self.R_ned_cam[k], self.t_ned_cam_m[k])
        livery_seed, environment_seed = (int(seed) for seed in rng.integers(2**31, size=2))
        airframe_id = int(self.airframe_id[k]) if stranger is None else stranger
        target = Target(airframe_id, livery_seed, self.R_ned_body[k], self.t_ned_body_m[k])
        sight = self.t_ned_body_m[k] - self.t_ned_cam_m[k]
        environment = environment_from_seed(environment_seed, sight_ned=sight / np.linalg.norm(sight))
        return Scene(camera, (target,), environment)


class FlownShare(NamedTuple):
    """How many windows show a flown scene."""

    share: float = 0.0  # 0..1
    frames: FlownFrames | None = None


NONE_FLOWN = FlownShare()


def read_flown(folders: Sequence[Path], airframe_ids: Sequence[int]) -> FlownFrames:
    """The frames of generated datasets, or splits of them, that show one of those airframes; of an airframe that is
    given several times, each frame is drawn so many times as often. Of a whole dataset, only its training splits count.

    Raises BopError if a folder is no dataset of the fleet in frames of 1920 x 1080 pixels, has no training split, was
    filmed through a lens that distorts, or shows none of them.
    """
    found = []
    for folder in folders:
        of_folder = [frame for scene in _to_train_on(folder) for frame in _shown(folder, scene, airframe_ids)]
        if not of_folder:
            raise BopError(f"{folder}: none of its frames shows one of the airframes to train on")
        for frame in of_folder:
            found += [frame] * list(airframe_ids).count(frame.targets[0].object_id - 1)
    return _stacked(found)


def _to_train_on(folder: Path) -> list[BopScene]:
    """The scenes of a folder, except those of validation and test splits, unless the folder is one or lies in it."""
    found = find_scenes(folder)
    kept = [s for s in found if s.split is None or s.split.startswith("train") or names_split(folder, s)]
    if not kept:
        splits = sorted({scene.split for scene in found if scene.split})
        raise BopError(f"{folder}: has no training split, but {', '.join(splits)}; to train on one, give its folder")
    return kept


def _shown(folder: Path, scene: BopScene, airframe_ids: Sequence[int]) -> Iterator[BopFrame]:
    """The scene's frames whose first target is visible and one of those."""
    camera = load_object(scene.folder / "camera.json", optional=True)
    if not camera:
        raise BopError(f"{scene.folder}: has no camera.json, so `uavpose-replay generate` did not make it")
    size_wh = (camera.get("width"), camera.get("height"))
    if size_wh != (FRAME_WIDTH_PX, FRAME_HEIGHT_PX):
        told = f"{scene.folder / 'camera.json'}: its frames have {size_wh[0]} x {size_wh[1]} pixels"
        raise BopError(f"{told}; windows are drawn of frames of {FRAME_WIDTH_PX} x {FRAME_HEIGHT_PX}")
    for frame in scene.frames:
        if not frame.targets or frame.targets[0].box_visible_xyxy_px is None:
            continue
        number = frame.targets[0].object_id
        if not 0 < number <= len(AIRFRAMES):
            raise BopError(f"{folder}: picture {frame.image_id} shows obj_id {number}, which is no member of the fleet")
        if number - 1 not in airframe_ids:
            continue
        if frame.R_cam_world is None or frame.t_cam_world_m is None:
            raise BopError(f"{folder}: picture {frame.image_id} has no cam_R_w2c: `uavpose-replay generate` made it?")
        if frame.distortion is not None:
            raise BopError(f"{folder}: its lenses distort; generate it with --undistorted")
        yield frame


def _stacked(frames: Sequence[BopFrame]) -> FlownFrames:
    R_ned_cam = np.stack([frame.R_cam_world.T for frame in frames if frame.R_cam_world is not None])
    t_cam_ned = np.stack([frame.t_cam_world_m for frame in frames if frame.t_cam_world_m is not None])
    targets = [frame.targets[0] for frame in frames]
    t_cam_target = np.stack([target.t_cam_target_m for target in targets])
    return FlownFrames(
        np.stack([frame.K for frame in frames]),
        R_ned_cam,
        np.einsum("nij,nj->ni", R_ned_cam, -t_cam_ned),
        R_ned_cam @ np.stack([target.R_cam_target for target in targets]),
        np.einsum("nij,nj->ni", R_ned_cam, t_cam_target - t_cam_ned),
        np.array([target.object_id - 1 for target in targets]),
    )
