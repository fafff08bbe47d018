"""All output made from a recorded flight, written into one folder."""

from __future__ import annotations

import errno
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sim_replay.evaluation.files import target_record
from sim_replay.ground_truth import PlayedSequence
from sim_replay.overlay import Image, Overlay, showcase_index
from sim_replay.report.flight_files import RecordedFlight
from sim_replay.result import PEERS, PeerResult, Result, frame_views, judge, score_json, told_ages
from sim_replay.score import TargetPose


def write_report(
    sequence: PlayedSequence, flight: RecordedFlight, out: Path, on_frame: Callable[[], None]
) -> tuple[dict[str, Any], list[str]]:
    """Evaluate a flight and write score.json, frames.jsonl, overlay.mp4, overlay.png and report.html.

    Returns:
        The score, and the names of the files.

    Raises:
        InputError, OSError.
    """
    from sim_replay.report.page import report_html  # matplotlib is slow to import

    out.mkdir(parents=True, exist_ok=True)
    result = judge(sequence, flight.recording)
    score = score_json(sequence, result, flight.model)
    (out / "score.json").write_text(json.dumps(score, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    with (out / "frames.jsonl").open("w", encoding="utf-8") as file:
        for record in frame_records(sequence, result):
            file.write(json.dumps(record, allow_nan=False) + "\n")
    _draw(sequence, result, out, on_frame)
    (out / "report.html").write_text(report_html(sequence, result, score, out), encoding="utf-8")
    return score, ["report.html", "score.json", "frames.jsonl", "overlay.mp4", "overlay.png"]


def frame_records(sequence: PlayedSequence, result: Result) -> Iterator[dict[str, Any]]:
    """One per frame: each visible target with what each peer received of it, its errors, and that pose's age; and the
    directions, which only the subscriber receives."""
    peers = dict(zip(PEERS, (result.subscriber, result.autopilot), strict=True))
    told = {name: _by_frame(peer, told_ages(peer, result.recording)) for name, peer in peers.items()}
    directions = result.directions_seen
    for frame, image in enumerate(sequence.scene.images):
        at_peers = {name: frames[frame] for name, frames in told.items()}
        seen = [_direction_record(*one) for one in directions[frame]]
        name = None if frame in sequence.scene.unrecorded else image.name
        yield {"frame": frame, "t_s": round(frame / sequence.fps, 6), "image": name, **at_peers, "directions": seen}


def _by_frame(peer: PeerResult, ages: Iterable[tuple[int, float]]) -> defaultdict[int, dict[str, Any]]:
    """What a peer received for each frame; empty lists for a frame without data."""
    told: defaultdict[int, dict[str, Any]] = defaultdict(lambda: {"targets": [], "false_poses": 0, "age_ms": []})
    for match in peer.matches:
        track = None if match.estimate is None else match.estimate.track
        told[match.truth.frame]["targets"].append({**target_record(match), "track": track})
    for pose in peer.false_poses:
        told[pose.frame]["false_poses"] += 1
    for frame, age_ms in ages:
        told[frame]["age_ms"].append(round(age_ms, 3))
    return told


def _direction_record(direction: TargetPose, error_deg: float | None) -> dict[str, Any]:
    ray_cam = direction.t_cam_target_m / np.linalg.norm(direction.t_cam_target_m)
    error_deg = None if error_deg is None else round(error_deg, 5)
    return {"track": direction.track, "ray_cam": ray_cam.round(6).tolist(), "bearing_error_deg": error_deg}


def _draw(sequence: PlayedSequence, result: Result, out: Path, on_frame: Callable[[], None]) -> None:
    """overlay.png of a typical frame and overlay.mp4 of all."""
    from sim_replay.report.film import write_video  # the trainer, which has no PyAV, imports this module

    scene = sequence.scene
    views = frame_views(sequence, result)
    first = scene.undistorted_bgr(0)
    size_wh = (first.shape[1], first.shape[0])
    overlay = Overlay(views, size_wh)
    shown = showcase_index(views)
    picture = out / "overlay.png"
    if not cv2.imwrite(str(picture), overlay.draw(shown, scene.undistorted_bgr(shown))):
        raise OSError(errno.EIO, "cannot be written", str(picture))

    def frames() -> Iterator[Image]:
        for index in range(len(views)):
            on_frame()
            yield overlay.draw(index, scene.undistorted_bgr(index))

    write_video(out / "overlay.mp4", frames(), sequence.fps, size_wh)
