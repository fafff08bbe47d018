"""What a replay came to: the peers' records set against the truth, and score.json made of it. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.estimator.model import Model
from msgs.geometry import R_from_q_wxyz
from sim_replay.ground_truth import PlayedSequence
from sim_replay.overlay import FrameView
from sim_replay.play import Record, Recording
from sim_replay.score import (
    Match,
    TargetPose,
    frame_of,
    latency_statistics,
    match_poses,
    statistics,
)


@dataclass(frozen=True, eq=False)
class Result:
    """One replay, judged."""

    matches: tuple[Match, ...]
    false_poses: tuple[TargetPose, ...]  # those of a frame that belong to no target
    strays: int  # poses of no frame of the sequence
    latencies_ms: dict[int, float]  # by frame: capture to the first TARGET_RELATIVE of that frame
    recording: Recording


def pose_of(record: Record, frame: int) -> TargetPose:
    """The pose in a peer's record."""
    R_cam_target = R_from_q_wxyz(record["q_cam_target_wxyz"])
    return TargetPose(frame, R_cam_target, np.array(record["t_cam_target_m"], dtype=np.float64))


def frame_of_record(record: Record, recording: Recording, sequence: PlayedSequence) -> int | None:
    """Index of the frame that a peer's record was measured in."""
    return frame_of(recording.capture_ns(record), recording.start_at_ns, sequence.fps, len(sequence.scene.images))


def latency_ms(record: Record, recording: Recording) -> float:
    """From capture to the autopilot's receiving a `target_relative`."""
    return float(record["received_ns"] - recording.capture_ns(record)) * 1e-6


def judge(sequence: PlayedSequence, recording: Recording) -> Result:
    """Set what zenoh brought against the truth, and MAVLink's arrival against the exposure."""
    estimates, strays = [], 0
    for record in recording.poses:
        frame = frame_of_record(record, recording, sequence)
        if frame is None:
            strays += 1
        else:
            estimates.append(pose_of(record, frame))
    matches, false_poses = match_poses(sequence.scene.truths, estimates)
    latencies_ms: dict[int, float] = {}
    for record in recording.targets:
        frame = frame_of_record(record, recording, sequence)
        if frame is not None:
            latencies_ms.setdefault(frame, latency_ms(record, recording))
    return Result(tuple(matches), tuple(false_poses), strays, latencies_ms, recording)


def score_json(sequence: PlayedSequence, result: Result, model: Model) -> dict[str, Any]:
    """score.json: shares 0..1, degrees, metres, milliseconds; null where there is nothing to tell.

    The figures of the poses are those of `sim_replay.score.statistics`.
    """
    recording = result.recording
    return {
        "sequence": sequence.scene.name,
        "poses": len(recording.poses),
        "stray_poses": result.strays,
        **statistics(len(sequence.scene.images), result.matches, result.false_poses),
        "latency_ms": latency_statistics([latency_ms(record, recording) for record in recording.targets]),
        "dropped_frames": recording.daemon_counters.get("dropped", 0),
        "mavlink_received": recording.mavlink.get("received", {}),
        "mavlink_refused": recording.mavlink.get("refused", {}),
        "zenoh_received": recording.zenoh.get("received", {}),
        "zenoh_refused": recording.zenoh.get("refused", {}),
        "model": {"file": model.path.name, "sha256": model.sha256, "precision": model.contract.precision},
    }


def frame_views(sequence: PlayedSequence, result: Result) -> list[FrameView]:
    """What the overlay draws of each frame: its first target."""
    by_frame: dict[int, Match] = {}
    for match in result.matches:
        by_frame.setdefault(match.truth.frame, match)
    views = []
    for frame, K in enumerate(sequence.scene.K):
        seen = by_frame.get(frame)
        extents = None if seen is None else sequence.scene.extents[seen.truth.object_id]
        views.append(FrameView(K, seen, extents, result.latencies_ms.get(frame)))
    return views
