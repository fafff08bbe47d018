"""A model on whole sequences: the daemon's estimator and tracker over the images in their order, without its clock.

A scene with sequence.toml was made by this project: its fps applies, and its world is local NED, so the tracker is
given the camera's attitude and position from cam_R_w2c, either exactly or with errors typical of autopilots.
Any other scene is taken at DEFAULT_FPS, with an unknown own ship; time then follows the image numbers.
"""

from __future__ import annotations

import logging
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Literal

import numpy as np

from edge.attention import Attention
from edge.cameras.sequence import frames_of
from edge.config import EstimatorSettings, MavlinkSettings
from edge.errors import InputError
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model
from edge.estimator.upright import up_in_cam
from edge.links.outgoing import rangeless, rotation_known, sendable
from edge.stages import StageClock
from edge.tracking.tracker import Tracker
from edge.types import Array, Estimate, Frame, FrameMeta, Mount, OwnShip, Report, Track
from msgs.geometry import so3_log
from sim_replay.bop import BopFrame, BopScene
from sim_replay.datasets import DatasetFrame, read_undistorted_bgr
from sim_replay.evaluation.given_sizes import SizeOf, no_size
from sim_replay.evaluation.judge import Answer, Answerer
from sim_replay.evaluation.own_ship import OwnShipErrors
from sim_replay.score import TargetPose

OwnShipTold = Literal["exact", "usual"]  # what the tracker is given: the true own-ship pose, or one with typical errors
_log = logging.getLogger(__name__)
DEFAULT_FPS = 30.0
FIRST_FRAME_NS = 1_000_000_000
# Of a camera that was slower the tracker would take its targets for faster ones, and be far from all of them.
_GUESSED = (
    "%s (and each other scene without sequence.toml): taken as %g frames a second, the usual step between its image "
    "numbers as one frame; if that is not so, write `fps = …` into its sequence.toml (whose cam_R_w2c, if it has them, "
    "must refer to north-east-down)"
)
_SETTINGS = EstimatorSettings()
_MAX_AGE_MS = MavlinkSettings().max_age_ms
_CAMERA_ITSELF = Mount(np.eye(3), np.zeros(3))  # cam_R_w2c is taken as the pose of the own ship


@dataclass
class _Sequence:
    """State of the flight through one scene."""

    scene: BopScene
    fps: float
    in_ned: bool
    places: dict[int, tuple[int, BopFrame]]  # by image id: its position among the scene's images
    frames: list[int]  # frame number in the sequence of each of them
    unflown: Iterator[BopFrame]  # the scene's frames that have an image, from the first that the tracker has not seen
    errors: OwnShipErrors | None
    tracker: Tracker = field(default_factory=lambda: Tracker(_SETTINGS.max_targets, _CAMERA_ITSELF))
    attention: Attention = field(default_factory=lambda: Attention(_SETTINGS))  # its searches end before the next frame

    @classmethod
    def of(cls, scene: BopScene, own_ship: OwnShipTold) -> _Sequence:
        """Raises InputError on a sequence.toml without a usable fps."""
        places = {frame.image_id: (k, frame) for k, frame in enumerate(scene.frames)}
        unflown = iter(scene.pictured)
        errors = OwnShipErrors.of_flight(scene.folder.name) if own_ship == "usual" else None
        path = scene.folder / "sequence.toml"
        if not path.is_file():
            return cls(scene, DEFAULT_FPS, False, places, _by_number(list(places)), unflown, errors)
        try:
            fps = float(tomllib.loads(path.read_text(encoding="utf-8"))["fps"])
        except (OSError, KeyError, ValueError, TypeError, OverflowError) as error:
            raise InputError(f"{path}: 'fps' is not a number that can be read") from error
        if not (np.isfinite(fps) and fps > 0):
            raise InputError(f"{path}: 'fps' is not above zero")
        return cls(scene, fps, True, places, frames_of(scene.folder, list(places)), unflown, errors)

    def until(self, image_id: int) -> Iterator[BopFrame]:
        """The unflown frames up to this image: the camera saw those that are not evaluated, too."""
        for frame in self.unflown:
            yield frame
            if frame.image_id == image_id:
                return

    def meta(self, image_id: int) -> FrameMeta:
        number = self.frames[self.places[image_id][0]]
        capture_ns = FIRST_FRAME_NS + round(number * 1e9 / self.fps)
        return FrameMeta(number, capture_ns, capture_ns)

    def own_ship(self, image_id: int) -> OwnShip | None:
        """The camera as a vehicle of its own: its body axes are the camera's, the mount is the identity."""
        k, frame = self.places[image_id]
        place = frame.camera_in_world
        if not self.in_ned or place is None:
            return None
        R_ned_cam, t_ned_cam_m = place
        if self.errors is not None:
            turning_radps, velocity_mps = self._rates(k)
            R_ned_cam = self.errors.attitude(R_ned_cam, turning_radps)
            t_ned_cam_m = self.errors.position(t_ned_cam_m, velocity_mps)
        return OwnShip(self.meta(image_id).capture_ns, R_ned_cam, t_ned_cam_m, None, None)

    def _rates(self, k: int) -> tuple[Array, Array]:
        """Angular rate [3], rad/s, and velocity [3], m/s, both in ned, between the frames before and after the k-th."""
        first, last = max(k - 1, 0), min(k + 1, len(self.places) - 1)
        before, after = (self.scene.frames[index].camera_in_world for index in (first, last))
        if before is None or after is None or first == last:
            return np.zeros(3), np.zeros(3)
        dt_s = (self.frames[last] - self.frames[first]) / self.fps
        return so3_log(after[0] @ before[0].T) / dt_s, (after[1] - before[1]) / dt_s


def _by_number(image_ids: Sequence[int]) -> list[int]:
    """Frame number of each image, from 0, by increasing image number: a gap is a frame that was not kept.

    The image number step of one frame is the lower quartile of the gaps: where few frames were kept, most gaps span
    several. Not the minimum: numbers may be times, which jitter.
    """
    apart = [after - before for before, after in pairwise(image_ids)]
    frame = sorted(apart)[len(apart) // 4] if apart else 1
    return list(accumulate((max(1, round(gap / frame)) for gap in apart), initial=0))


def tracker_answers(model: Model, size_of: SizeOf = no_size, own_ship: OwnShipTold = "usual") -> Answerer:
    """What the daemon would send for each image if it flew through its scene; images must come in their order.

    It also sees the scene's images in between, which the dataset may not ask to evaluate. `size_of`: what [target] says
    in each scene.

    Raises InputError if the model does not run, or a search for further targets fails: only in flight is that logged
    and passed over.
    """
    estimator = Estimator(model, _SETTINGS.max_targets)
    model.warm_up()
    current: list[_Sequence] = []
    guessed: list[BopScene] = []  # the first scene whose frame rate nobody tells

    def answer(index: int, picture: DatasetFrame) -> Answer:
        if not current or current[-1].scene is not picture.scene:
            current[:] = [_Sequence.of(picture.scene, own_ship)]
            if not current[-1].in_ned and not guessed:
                guessed.append(picture.scene)
                _log.warning(_GUESSED, picture.scene.folder, DEFAULT_FPS)
            estimator.target_size = size_of(picture.scene)
        for shown in current[-1].until(picture.image_id):
            report, estimates, time_ms = _flown(estimator, current[-1], shown)
        told = sendable(report, report.meta.capture_ns, _MAX_AGE_MS)
        seen = rangeless(report, report.meta.capture_ns, _MAX_AGE_MS)
        return Answer(
            _poses(index, told, [rotation_known(track) for track in told]),
            time_ms,
            _poses(index, estimates, [True] * len(estimates)),
            _poses(index, seen, [False] * len(seen)),
        )

    return answer


def _flown(estimator: Estimator, sequence: _Sequence, shown: BopFrame) -> tuple[Report, list[Estimate], float]:
    """The tracker's report on the sequence's next frame, the estimates that it was given, and how long it took, ms."""
    image_bgr = read_undistorted_bgr(sequence.scene.image_path(shown), shown.K, shown.distortion)
    own_ship = sequence.own_ship(shown.image_id)
    up_cam = None if own_ship is None else up_in_cam(own_ship, _CAMERA_ITSELF)
    frame = Frame(sequence.meta(shown.image_id), image_bgr, shown.K, up_cam=up_cam)
    size_wh, capture_ns = frame.size_wh, frame.meta.capture_ns
    started_ns = time.monotonic_ns()
    expected = sequence.tracker.predict(capture_ns, own_ship, shown.K, size_wh)
    estimates = sequence.attention.look(estimator, frame, expected, StageClock(frame.meta, started_ns)).estimates
    if sequence.attention.search.counters().get("search_failed"):
        raise InputError(f"{sequence.scene.folder}: the search for further targets in image {shown.image_id} failed")
    model = estimator.model
    tracks = sequence.tracker.update(
        capture_ns, estimates, own_ship, shown.K, size_wh, doubtful_below=model.doubtful_below
    )
    time_ms = (time.monotonic_ns() - started_ns) * 1e-6
    report = Report(frame.meta, shown.K, size_wh, tracks, own_ship, doubtful_below=model.doubtful_below)
    return report, estimates, time_ms


def _poses(index: int, told: Sequence[Track | Estimate], known: Sequence[bool]) -> tuple[TargetPose, ...]:
    """`known` says for each whether its rotation is known."""
    return tuple(
        TargetPose(
            index,
            one.R_cam_target,
            one.t_cam_target_m,
            score=one.score,
            covariance=one.covariance,
            rotation_known=turned,
        )
        for one, turned in zip(told, known, strict=True)
    )
