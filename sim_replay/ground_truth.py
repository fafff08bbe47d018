"""Ground truth of a BOP scene, and a sequence that can be flown: frames, intrinsics, target poses, own ship."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from edge.cameras.sequence import frames_of
from edge.config import MountSettings
from edge.errors import InputError
from edge.types import Mount
from msgs.geometry import R_FORWARD_CAM, Array
from sim_replay.bop import Distortion, Model, read_scene
from sim_replay.bop.scene import Image
from sim_replay.datasets import Dataset, read_undistorted_bgr
from sim_replay.evaluation.judge import is_hidden, is_seen
from sim_replay.gimbal import GimbalTrack, track_of
from sim_replay.overlay import Extents
from sim_replay.score import Truth
from sim_replay.telemetry import Telemetry, TelemetryError, read_telemetry

# How far the first and the last exposure may lie outside the telemetry: one row at the lowest accepted rate.
UNCOVERED_NS_MAX = 110_000_000
_FPS_LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """A BOP scene; frames are counted from 0 in the order of their image numbers.

    A frame that was not recorded has the image and camera of the one before.
    """

    folder: Path
    images: list[Path]
    K: list[Array]  # [3, 3] for each frame
    truths: list[Truth]
    extents: dict[int, Extents]  # by object id
    distortions: list[Distortion | None]  # of each stored image; None: a pinhole camera
    cameras_world: list[tuple[Array, Array] | None]  # R_world_cam [3, 3], t_world_cam_m [3]; None: unknown
    truth_known: bool  # False: no file states what an image shows, so frames without truths may still show targets
    unrecorded: frozenset[int] = frozenset()  # frames without an image of their own

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def shows_target(self) -> bool:
        """Whether a target is known to be visible in any frame."""
        return any(truth.visible for truth in self.truths)

    @property
    def target_free(self) -> bool:
        """Whether all frames are known to show no target."""
        return self.truth_known and not self.shows_target

    @property
    def can_be_scored(self) -> bool:
        """Whether poses can be compared with it: it has targets, or is known to show none."""
        return bool(self.truths) or self.truth_known

    def undistorted_bgr(self, index: int) -> Image:
        """The frame's image [H, W, 3] as the pinhole camera K sees it. Raises InputError."""
        return read_undistorted_bgr(self.images[index], self.K[index], self.distortions[index])


@dataclass(frozen=True, eq=False)
class PlayedSequence:
    """A scene with everything needed to fly it: rate, mount, telemetry of the own ship."""

    scene: SceneTruth
    fps: float
    mount: Mount
    telemetry_csv: Path
    frame0_ns: int  # exposure of the first frame on the telemetry's clock
    gimbal: GimbalTrack | None = None  # None: the camera is fixed; otherwise `mount` is its mount on the gimbal
    readout_ms: float = 0.0  # the daemon's [camera] readout_ms
    own_ship_mask: Path | None = None  # and own_ship_mask

    @property
    def camera_mount(self) -> str:
        """Value of the daemon's [camera] mount."""
        return "fixed" if self.gimbal is None else "gimbal"


def read_scene_truth(folder: Path) -> SceneTruth:
    """Read a BOP scene folder and its dataset's models. Raises InputError, naming file and key."""
    scene = read_scene(folder)
    dataset = Dataset(folder.name, scene.root or folder, scene.split, (scene,))
    models, frames = dataset.models, scene.pictured
    truths = []
    for index, picture in enumerate(dataset.pictured_frames()):
        for target in picture.targets:
            if target.object_id not in models:
                raise InputError(
                    f"{folder / 'scene_gt.json'}: obj_id {target.object_id} is not among the models; "
                    f"if it has none, give its diameter_m under [objects.{target.object_id}] in model_frame.toml"
                )
            model, R, t_m = models[target.object_id], target.R_cam_target, target.t_cam_target_m
            known = (target.object_id, model.diameter_m, model.name, model.points_m)
            truths.append(Truth(index, R, t_m, *known, visible=is_seen(target), occluded=is_hidden(target)))
    return SceneTruth(
        folder,
        [scene.image_path(frame) for frame in frames],
        [frame.K for frame in frames],
        truths,
        {object_id: extents_of(model) for object_id, model in models.items()},
        [frame.distortion for frame in frames],
        [frame.camera_in_world for frame in frames],
        all(frame.truth_known for frame in frames),
    )


def extents_of(model: Model) -> Extents:
    """The model's box; if it is unknown, a cube as long as the diameter."""
    if model.low_m is not None and model.size_m is not None:
        return Extents(model.low_m, model.size_m)
    half = 0.5 * model.diameter_m
    return Extents((-half, -half, -half), (2 * half, 2 * half, 2 * half))


def read_sequence(folder: Path) -> PlayedSequence:
    """Read a scene with its sequence.toml and telemetry.csv. Raises InputError, naming file and key.

    Its image numbers must be evenly spaced, unless it was made from a recording; the telemetry must span all exposures.
    """
    scene = read_scene_truth(folder)
    frames = frames_of(folder, [int(path.stem) for path in scene.images])
    if frames == list(range(len(frames))):
        _check_spacing(scene)
    else:
        scene = _with_unrecorded(scene, frames)
    with _blame(folder / "sequence.toml") as path:
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
        mount = MountSettings(R_body_cam=settings["R_body_cam"], t_body_cam_m=settings["t_body_cam_m"]).mount()
        fps = float(settings["fps"])
        frame0_ns = int(settings["t0_ns"])
        gimballed = settings.get("mount", "fixed") == "gimbal"
        readout_ms = float(settings.get("readout_ms", 0.0))
        own_ship_mask = folder / settings["own_ship_mask"] if "own_ship_mask" in settings else None
    if not (math.isfinite(fps) and fps >= _FPS_LEAST):
        raise InputError(
            f"{folder / 'sequence.toml'}: fps is {fps:g}; it must be a number above 0, at least {_FPS_LEAST:g}"
        )
    telemetry_csv, gimbal = folder / "telemetry.csv", None
    try:
        telemetry = read_telemetry(telemetry_csv)
    except TelemetryError as error:
        raise InputError(str(error)) from error
    check_spans(telemetry, telemetry_csv, frame0_ns, len(scene.images), fps)
    if gimballed:
        gimbal, mount = _gimbal(folder, frames, frame0_ns, fps), Mount(R_FORWARD_CAM, mount.t_body_cam_m)
    return PlayedSequence(scene, fps, mount, telemetry_csv, frame0_ns, gimbal, readout_ms, own_ship_mask)


def _with_unrecorded(scene: SceneTruth, frames: list[int]) -> SceneTruth:
    """The scene over all frames of the sequence; `frames` has the frame number of each image, increasing."""
    of_frame = _newest(frames)
    return replace(
        scene,
        images=[scene.images[k] for k in of_frame],
        K=[scene.K[k] for k in of_frame],
        truths=[replace(truth, frame=frames[truth.frame]) for truth in scene.truths],
        distortions=[scene.distortions[k] for k in of_frame],
        cameras_world=[scene.cameras_world[k] for k in of_frame],
        unrecorded=frozenset(range(len(of_frame))) - set(frames),
    )


def _newest(frames: list[int]) -> list[int]:
    """For each frame of the sequence, the index of its image, or of the last image before it."""
    return [int(k) for k in np.searchsorted(frames, np.arange(frames[-1] + 1), side="right") - 1]


def check_spans(telemetry: Telemetry, path: Path, frame0_ns: int, frames: int, fps: float) -> None:
    """Raise InputError, naming `path`, unless the telemetry spans all exposures: outside it there is no attitude."""
    last_ns = frame0_ns + round((frames - 1) * 1e9 / fps)
    from_ns, to_ns = int(telemetry.t_ns[0]), int(telemetry.t_ns[-1])
    if frame0_ns < from_ns - UNCOVERED_NS_MAX or last_ns > to_ns + UNCOVERED_NS_MAX:
        exposed = f"the first picture was exposed at {frame0_ns * 1e-9:.3f} s"
        if frames > 1:  # of a video that is not unpacked yet, the first one is asked for alone
            exposed = f"the pictures were exposed from {frame0_ns * 1e-9:.3f} s to {last_ns * 1e-9:.3f} s"
        raise InputError(
            f"{path}: tells of {from_ns * 1e-9:.3f} s to {to_ns * 1e-9:.3f} s, but {exposed} on its clock (t0_ns, fps)"
        )


def _check_spacing(scene: SceneTruth) -> None:
    """Raise InputError if image numbers are not evenly spaced: exposure times are counted by order."""
    numbers = [int(path.stem) for path in scene.images]
    for before, after in pairwise(numbers):
        if after - before != numbers[1] - numbers[0]:
            raise InputError(
                f"{scene.folder}: picture {after} follows picture {before}, but {numbers[1]} follows {numbers[0]}: "
                "a sequence with telemetry needs evenly spaced numbers, or its pictures would be exposed at wrong times"
            )


def _gimbal(folder: Path, frames: list[int], frame0_ns: int, fps: float) -> GimbalTrack:
    """The gimbal's attitude from scene_camera.json, whose world is local NED. Raises InputError.

    `frames` has the frame number of each image.
    """
    R_cam_ned = [frame.R_cam_world for frame in read_scene(folder).pictured]
    known = [R for R in R_cam_ned if R is not None]
    path = folder / "scene_camera.json"
    if len(known) < len(R_cam_ned):
        raise InputError(f"{path}: 'cam_R_w2c' is missing: it says how the gimbal was turned at every frame")
    if len(known) < 2:
        raise InputError(f"{path}: has a single picture; how a gimbal turns is known from two on")
    return track_of(known, frame0_ns, fps, frames)


@contextmanager
def _blame(path: Path) -> Iterator[Path]:
    """Convert errors while reading `path` to InputError with a sentence that names it."""
    try:
        yield path
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]!r} is missing") from error
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as expected: {error}") from error
