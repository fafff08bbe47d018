"""What is true of a BOP scene, and of a sequence that can be flown: frames, intrinsics, target poses, own ship."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from edge.config import MountSettings
from edge.errors import InputError
from edge.types import Mount
from msgs.geometry import Array
from sim_replay.bop import BopFrame, Distortion, Model, read_scene
from sim_replay.bop.scene import Image
from sim_replay.datasets import Dataset, read_undistorted_bgr
from sim_replay.gimbal import R_GIMBAL_CAM, GimbalTrack, track_of
from sim_replay.overlay import Extents
from sim_replay.score import Truth
from sim_replay.telemetry import TelemetryError, read_telemetry


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A BOP scene; frames are counted from 0 in the order of their picture numbers."""

    folder: Path
    images: list[Path]
    K: list[Array]  # [3, 3] for each frame
    truths: list[Truth]
    extents: dict[int, Extents]  # by object id
    distortions: list[Distortion | None]  # of each picture on disk; None: a pinhole camera
    cameras_world: list[tuple[Array, Array] | None]  # R_world_cam [3, 3], t_world_cam_m [3]; None: not known

    @property
    def name(self) -> str:
        return self.folder.name

    def undistorted_bgr(self, index: int) -> Image:
        """The frame's picture [H, W, 3] as the pinhole camera K sees it. Raises InputError."""
        return read_undistorted_bgr(self.images[index], self.K[index], self.distortions[index])


@dataclass(frozen=True, eq=False)
class PlayedSequence:
    """A scene with all it takes to fly it: rate, mount, telemetry of the own ship."""

    scene: SceneTruth
    fps: float
    mount: Mount
    telemetry_csv: Path
    frame0_ns: int  # exposure of the first frame on the telemetry's clock
    gimbal: GimbalTrack | None = None  # None: the camera is bolted on; else `mount` says how it sits on the gimbal

    @property
    def camera_mount(self) -> str:
        """What the daemon's [camera] mount must say."""
        return "fixed" if self.gimbal is None else "gimbal"


def read_scene_truth(folder: Path) -> SceneTruth:
    """Read a BOP scene folder and its dataset's models. Raises InputError, naming file and key."""
    scene = read_scene(folder)
    models = Dataset(folder.name, scene.root or folder, scene.split, (scene,)).models
    frames = scene.pictured
    truths = []
    for index, frame in enumerate(frames):
        seen: Counter[int] = Counter()
        for target in frame.targets:
            if target.object_id not in models:
                raise InputError(f"{folder / 'scene_gt.json'}: obj_id {target.object_id} is not among the models")
            model, R, t_m = models[target.object_id], target.R_cam_target, target.t_cam_target_m
            instance, visible = seen[target.object_id], target.visible_px != 0
            known = (target.object_id, model.diameter_m, model.name, model.points_m)
            truths.append(Truth(index, R, t_m, *known, instance=instance, visible=visible))
            seen[target.object_id] += 1
    return SceneTruth(
        folder,
        [scene.image_path(frame) for frame in frames],
        [frame.K for frame in frames],
        truths,
        {object_id: extents_of(model) for object_id, model in models.items()},
        [frame.distortion for frame in frames],
        [_camera_world(frame) for frame in frames],
    )


def _camera_world(frame: BopFrame) -> tuple[Array, Array] | None:
    if frame.R_cam_world is None or frame.t_cam_world_m is None:
        return None
    R_world_cam = frame.R_cam_world.T
    return R_world_cam, -R_world_cam @ frame.t_cam_world_m


def extents_of(model: Model) -> Extents:
    """The model's box; of one whose box nobody knows, a cube as long as its diameter."""
    if model.low_m is not None and model.size_m is not None:
        return Extents(model.low_m, model.size_m)
    half = 0.5 * model.diameter_m
    return Extents((-half, -half, -half), (2 * half, 2 * half, 2 * half))


def read_sequence(folder: Path) -> PlayedSequence:
    """Read a scene with its sequence.toml and telemetry.csv. Raises InputError, naming file and key."""
    scene = read_scene_truth(folder)
    with _blame(folder / "sequence.toml") as path:
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
        mount = MountSettings(R_body_cam=settings["R_body_cam"], t_body_cam_m=settings["t_body_cam_m"]).mount()
        fps = float(settings["fps"])
        frame0_ns = int(settings["t0_ns"])
        gimballed = settings.get("mount", "fixed") == "gimbal"
    try:
        read_telemetry(folder / "telemetry.csv")
    except TelemetryError as error:
        raise InputError(str(error)) from error
    telemetry_csv, gimbal = folder / "telemetry.csv", None
    if gimballed:
        gimbal, mount = _gimbal(folder, frame0_ns, fps), Mount(R_GIMBAL_CAM, mount.t_body_cam_m)
    return PlayedSequence(scene, fps, mount, telemetry_csv, frame0_ns, gimbal)


def _gimbal(folder: Path, frame0_ns: int, fps: float) -> GimbalTrack:
    """What scene_camera.json tells of a camera whose world is local NED. Raises InputError."""
    R_cam_ned = [frame.R_cam_world for frame in read_scene(folder).pictured]
    known = [R for R in R_cam_ned if R is not None]
    if len(known) < max(len(R_cam_ned), 2):
        path = folder / "scene_camera.json"
        raise InputError(f"{path}: 'cam_R_w2c' is missing: it says how the gimbal was turned at every frame")
    return track_of(known, frame0_ns, fps)


@contextmanager
def _blame(path: Path) -> Iterator[Path]:
    """Errors of reading `path` inside are told as InputError in a sentence that names it."""
    try:
        yield path
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]!r} is missing") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not as expected: {error}") from error
