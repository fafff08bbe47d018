"""Result of a replay: the peers' records compared with ground truth, and score.json. Pure functions."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msgs.geometry import Array, R_from_q_wxyz
from sim_replay.evaluation.instances import instances
from sim_replay.ground_truth import PlayedSequence, SceneTruth
from sim_replay.overlay import Extents, FrameView
from sim_replay.play import Record, Recording
from sim_replay.report.peer import peer_figures, percentiles
from sim_replay.score import (
    Match,
    TargetPose,
    Truth,
    direction_statistics,
    frame_of,
    latency_statistics,
    match_poses,
    statistics,
)

PEERS = ("subscriber", "autopilot")
Seen = tuple[TargetPose, float | None]  # a direction, and its error in degrees; None: it belongs to no target
FAR_M = 1e4  # range that stands for an unknown one: further than any target is large, so that it is matched by bearing


@dataclass(frozen=True, eq=False)
class PeerResult:
    """Evaluation of what one peer received. Frames are indices into the sequence."""

    matches: tuple[Match, ...]  # for every visible target of every frame
    false_poses: tuple[TargetPose, ...]  # poses of a frame that belong to no target
    strays: int  # poses that belong to no frame of the sequence
    ages: tuple[tuple[int, float], ...]  # of each pose of a frame, as they arrived: frame, ms from exposure to arrival


@dataclass(frozen=True, eq=False)
class Result:
    """Evaluation of one replay, by what each of its peers received."""

    subscriber: PeerResult
    autopilot: PeerResult
    directions: PeerResult  # what the subscriber was told of targets whose range is not known; see `direction_of`
    recording: Recording

    @property
    def latencies_ms(self) -> dict[int, float]:
        """By frame: capture to the first TARGET_RELATIVE of that frame; empty in lock-step."""
        first: dict[int, float] = {}
        for frame, age_ms in told_ages(self.autopilot, self.recording):
            first.setdefault(frame, age_ms)
        return first

    @property
    def directions_seen(self) -> defaultdict[int, list[Seen]]:
        """By frame: every direction but those of hidden targets."""
        seen: defaultdict[int, list[Seen]] = defaultdict(list)
        for match in self.directions.matches:
            if match.estimate is not None:
                seen[match.truth.frame].append((match.estimate, match.bearing_error_deg))
        for direction in self.directions.false_poses:
            seen[direction.frame].append((direction, None))
        return seen


def told_ages(peer: PeerResult, recording: Recording) -> tuple[tuple[int, float], ...]:
    """The meaningful ages: none in lock-step, where all are zero."""
    return () if recording.in_lockstep else peer.ages


def pose_of(record: Record, frame: int) -> TargetPose:
    """The pose in a peer's record."""
    R_cam_target = R_from_q_wxyz(record["q_cam_target_wxyz"])
    covariance = np.array(record["covariance"], dtype=np.float64) if "covariance" in record else None
    t_m = np.array(record["t_cam_target_m"], dtype=np.float64)
    known = bool(record["rotation_known"])
    return TargetPose(
        frame, R_cam_target, t_m, covariance=covariance, track=str(record["target"]), rotation_known=known
    )


def direction_of(record: Record, frame: int) -> TargetPose:
    """The direction in the subscriber's record, as a pose of which nothing but the direction means anything."""
    t_m = FAR_M * np.array(record["ray_cam"], dtype=np.float64)
    return TargetPose(frame, np.eye(3), t_m, track=str(record["target"]), rotation_known=False)


def frame_of_record(record: Record, recording: Recording, sequence: PlayedSequence) -> int | None:
    """Index of the frame that a peer's record was measured in."""
    return frame_of(recording.capture_ns(record), recording.start_at_ns, sequence.fps, len(sequence.scene.images))


def latency_ms(record: Record, recording: Recording) -> float:
    """From capture to the arrival of a `target_relative` at the autopilot."""
    return float(record["received_ns"] - recording.capture_ns(record)) * 1e-6


def judge(sequence: PlayedSequence, recording: Recording) -> Result:
    """Compare what arrived over zenoh and over MAVLink with the ground truth and the exposure times."""
    subscriber = ((record, float(record["age_ms"])) for record in recording.poses)
    autopilot = ((record, latency_ms(record, recording)) for record in recording.targets)
    directions = ((record, float(record["age_ms"])) for record in recording.directions)
    truths = _told_apart(sequence.scene)
    return Result(
        _judge_peer(sequence, truths, recording, subscriber, pose_of),
        _judge_peer(sequence, truths, recording, autopilot, pose_of),
        _judge_peer(sequence, truths, recording, directions, direction_of),
        recording,
    )


def _told_apart(scene: SceneTruth) -> list[Truth]:
    """The scene's truths, each with a number that identifies its target over all frames."""
    in_world = all(camera is not None for camera in scene.cameras_world)
    places_m = [_place(truth, scene.cameras_world[truth.frame] if in_world else None) for truth in scene.truths]
    numbers = instances(scene.truths, places_m)
    return [replace(truth, instance=number) for truth, number in zip(scene.truths, numbers, strict=True)]


def _place(truth: Truth, camera_world: tuple[Array, Array] | None) -> Array:
    """[3], metres, in the world's axes; in `cam` if the camera's position in the world is unknown."""
    if camera_world is None:
        return truth.t_cam_target_m
    R_world_cam, t_world_cam_m = camera_world
    return R_world_cam @ truth.t_cam_target_m + t_world_cam_m


def _judge_peer(
    sequence: PlayedSequence,
    truths: Sequence[Truth],
    recording: Recording,
    received: Iterable[tuple[Record, float]],
    read: Callable[[Record, int], TargetPose],
) -> PeerResult:
    estimates, ages, strays = [], [], 0
    for record, age_ms in received:
        frame = frame_of_record(record, recording, sequence)
        if frame is None:
            strays += 1
        else:
            estimates.append(read(record, frame))
            ages.append((frame, age_ms))
    matches, false_poses = match_poses(truths, estimates)
    visible = tuple(match for match in matches if match.truth.visible)
    return PeerResult(visible, tuple(false_poses), strays, tuple(ages))


def score_json(sequence: PlayedSequence, result: Result, model: dict[str, Any]) -> dict[str, Any]:
    """score.json: shares 0..1, degrees, metres, milliseconds; null where there is no data.

    The figures of the poses are those of `sim_replay.score.statistics`, of what the subscriber received; "peers" has
    what each peer received, see `sim_replay.report.peer.peer_figures`.
    """
    recording, subscriber = result.recording, result.subscriber
    frames = len(sequence.scene.images) - len(sequence.scene.unrecorded)
    occluded = {truth.frame for truth in sequence.scene.truths if truth.occluded}
    return {
        "sequence": sequence.scene.name,
        "poses": len(recording.poses),
        "directions_received": len(recording.directions),
        "stray_poses": subscriber.strays,
        **statistics(frames, subscriber.matches, subscriber.false_poses, occluded),
        "directions": direction_statistics(
            result.directions.matches, subscriber.matches, len(result.directions.false_poses)
        ),
        "latency_ms": _latency_ms(recording),
        "dropped_frames": recording.daemon_counters.get("dropped", 0),
        "peers": {
            name: {
                "poses": len(peer.ages) + peer.strays,
                "stray_poses": peer.strays,
                **peer_figures(
                    frames, sequence.fps, peer.matches, peer.false_poses, peer.ages, sequence.scene.unrecorded, occluded
                ),
                "age_ms": percentiles([age_ms for _, age_ms in told_ages(peer, recording)]),
            }
            for name, peer in zip(PEERS, (subscriber, result.autopilot), strict=True)
        },
        "mavlink_received": recording.mavlink.get("received", {}),
        "mavlink_refused": recording.mavlink.get("refused", {}),
        "zenoh_received": recording.zenoh.get("received", {}),
        "zenoh_refused": recording.zenoh.get("refused", {}),
        "model": model,
    }


def _latency_ms(recording: Recording) -> dict[str, float | None]:
    """Capture to MAVLink. `tracks_withheld` were not sent over MAVLink (not confirmed yet, too unsure or too old),
    so the percentiles do not include them. All null in lock-step.
    """
    if recording.in_lockstep:
        return {**latency_statistics([]), "tracks_withheld": None}
    withheld = recording.daemon_counters.get("mavlink_tracks_withheld", 0)
    told = latency_statistics([latency_ms(record, recording) for record in recording.targets])
    return {**told, "tracks_withheld": withheld}


def drops_told(sequence: PlayedSequence, score: dict[str, Any]) -> str | None:
    """A sentence on the frames that the daemon dropped, misses that are not the model's; None if it dropped none."""
    # It counts those that were never recorded as well, which no machine would have got.
    dropped = score["dropped_frames"] - len(sequence.scene.unrecorded)
    if dropped <= 0:
        return None
    were = "was" if dropped == 1 else "were"
    told = f"{dropped} of {score['overall']['frames']} frames {were} dropped: this machine was too busy or too slow"
    return f"{told}; each with a target in view counts as a miss."


def frame_views(sequence: PlayedSequence, result: Result) -> list[FrameView]:
    """Overlay data of each frame: its targets as the subscriber received them, and every direction.

    Inset and charts are of the target that is in view most; in frames without it they have none. A frame that was not
    recorded shows the image of the one before, and has its data.
    """
    most_seen = Counter(found.truth.target for found in result.subscriber.matches).most_common(1)
    by_frame: dict[int, list[tuple[Match, Extents]]] = {}
    for found in result.subscriber.matches:
        shown = (found, sequence.scene.extents[found.truth.object_id])
        by_frame.setdefault(found.truth.frame, []).append(shown)
    directions, latencies_ms = result.directions_seen, result.latencies_ms
    views: list[FrameView] = []
    for frame, K in enumerate(sequence.scene.K):
        if frame in sequence.scene.unrecorded:
            views.append(views[-1])
            continue
        seen = by_frame.get(frame, [])
        main = next((one for one in seen if one[0].truth.target == most_seen[0][0]), None)
        match, extents = main or (None, None)
        others = tuple(one for one in seen if one is not main)
        told = tuple(direction for direction, _ in directions[frame])
        views.append(FrameView(K, match, extents, latencies_ms.get(frame), others, told))
    return views
