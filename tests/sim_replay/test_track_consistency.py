"""The shipped model and the daemon's tracker over the bundled sequences: better than single frames, and honest."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from edge.tracking.tracker import Tracker
from edge.types import Array, Estimate, OwnShip, Track
from sim_replay.datasets import open_dataset
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.evaluation import tracked
from sim_replay.offline import SHIPPED_MODEL, load_model
from sim_replay.score import TargetPose

GOLDEN = BUNDLED_SEQUENCE.parent / "golden"
SEQUENCES = [BUNDLED_SEQUENCE, GOLDEN / "two_targets", GOLDEN / "away_and_back"]
SAME_BEARING_RAD = 0.02


@dataclass
class Flown:
    """One target's errors in the frames of which both the track and the single frame are known."""

    frame_m: list[float] = field(default_factory=list)
    frame_rad: list[float] = field(default_factory=list)
    track_m: list[float] = field(default_factory=list)
    track_rad: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)  # of the track's position, 3 degrees of freedom
    told_rel: list[float] = field(default_factory=list)  # its told standard deviation by its range


class Listening(Tracker):
    """The tracker, which keeps what it was last given."""

    given: list[Estimate]

    def update(
        self,
        capture_ns: int,
        estimates: list[Estimate],
        own_ship: OwnShip | None,
        K: Array,
        image_size_wh: tuple[int, int],
        *more: Any,
        **named: Any,
    ) -> tuple[Track, ...]:
        Listening.given = estimates
        return super().update(capture_ns, estimates, own_ship, K, image_size_wh, *more, **named)


def nearest(poses: list[Estimate] | tuple[TargetPose, ...], t_cam_m: Array) -> Estimate | TargetPose | None:
    """The pose in the direction of t_cam_m [3], if there is one."""

    def away_rad(pose: Estimate | TargetPose) -> float:
        t = pose.t_cam_target_m
        return float(np.arctan2(np.linalg.norm(np.cross(t, t_cam_m)), t @ t_cam_m))

    best = min(poses, key=away_rad, default=None)
    return best if best is not None and away_rad(best) < SAME_BEARING_RAD else None


def angle_rad(R_a: Array, R_b: Array) -> float:
    return float(Rotation.from_matrix(R_a.T @ R_b).magnitude())


@pytest.fixture(scope="module")
def flown() -> list[Flown]:
    patch = pytest.MonkeyPatch()
    patch.setattr(tracked, "Tracker", Listening)
    targets: dict[tuple[str, int], Flown] = {}
    answer = tracked.tracker_answers(load_model(SHIPPED_MODEL, 2))
    for folder in SEQUENCES:
        for index, picture in enumerate(open_dataset(folder, None).frames()):
            told = answer(index, picture).poses
            for number, target in enumerate(picture.targets):
                frame, track = nearest(Listening.given, target.t_cam_target_m), nearest(told, target.t_cam_target_m)
                if frame is None or track is None or track.covariance is None:
                    continue
                one = targets.setdefault((folder.name, number), Flown())
                error_m = track.t_cam_target_m - target.t_cam_target_m
                one.track_m.append(float(np.linalg.norm(error_m)))
                one.track_rad.append(angle_rad(track.R_cam_target, target.R_cam_target))
                one.frame_m.append(float(np.linalg.norm(frame.t_cam_target_m - target.t_cam_target_m)))
                one.frame_rad.append(angle_rad(frame.R_cam_target, target.R_cam_target))
                one.nees.append(float(error_m @ np.linalg.solve(track.covariance[:3, :3], error_m)))
                one.told_rel.append(
                    float(np.sqrt(np.trace(track.covariance[:3, :3])) / np.linalg.norm(track.t_cam_target_m))
                )
    patch.undo()
    assert len(targets) == 4
    assert min(len(one.nees) for one in targets.values()) >= 15
    return list(targets.values())


def test_tracks_are_nearer_to_the_truth_than_the_frames_they_are_made_of(flown: list[Flown]) -> None:
    """By their root mean square over all frames, and over those of the one long flight."""
    longest = max(flown, key=lambda one: len(one.nees))
    for some in (flown, [longest]):
        for track, frame in (("track_m", "frame_m"), ("track_rad", "frame_rad")):
            of_tracks, of_frames = (np.concatenate([getattr(one, name) for one in some]) for name in (track, frame))
            assert np.mean(of_tracks**2) < np.mean(of_frames**2)


def test_position_errors_lie_inside_their_95_percent_bounds(flown: list[Flown]) -> None:
    """Frames of a flight share most of their error, so each flight counts as one draw of chi-square."""
    assert max(float(np.mean(one.nees)) for one in flown) < chi2.ppf(0.975, 3)
    assert np.mean(np.concatenate([one.nees for one in flown]) < chi2.ppf(0.95, 3)) >= 0.95


def test_a_position_is_not_told_wider_than_it_is_of_use(flown: list[Flown]) -> None:
    """One aircraft in five that the network learnt from was a stranger: it allows for one, whose size is not known."""
    assert np.median(np.concatenate([one.told_rel for one in flown])) < 0.25
