"""The worst moments of a flight, with images; stills and videos as data: URLs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sim_replay.evaluation.worst import badness, close_up
from sim_replay.ground_truth import PlayedSequence
from sim_replay.overlay import Image
from sim_replay.score import Match

SHOWN = 8
MISSES_SHOWN_MAX = 2
APART_S = 0.5  # neighbours of a bad frame are equally bad and add no information
STILLS = 6
VIDEO_MAX_BYTES = 12_000_000  # for a larger one, stills are shown: browsers fail on pages of hundreds of megabytes
_PICTURE_PX = 360
_STILL_PX = 560


@dataclass(frozen=True)
class Moment:
    """One bad frame of one target."""

    frame: int
    t_s: float
    range_m: float
    rotation_error_deg: float | None  # None: unknown
    range_error_m: float | None  # None: no pose of the target was received
    picture: str  # a data: URL


def worst_moments(sequence: PlayedSequence, matches: Sequence[Match]) -> list[Moment]:
    """Up to SHOWN of them, in the order of the flight. Raises InputError on an unreadable image."""
    chosen = _choose(matches, sequence.fps)
    return [_moment(sequence, match) for match in sorted(chosen, key=lambda match: match.truth.frame)]


def _choose(matches: Sequence[Match], fps: float) -> list[Match]:
    """The worst first, none near another of the same target; few misses, since they look alike."""
    chosen: list[Match] = []
    misses = 0
    for match in sorted(matches, key=lambda match: (-badness(match), match.truth.frame)):
        missed = match.estimate is None
        if len(chosen) == SHOWN or (missed and misses == MISSES_SHOWN_MAX):
            continue
        if all(_apart_s(match, other, fps) >= APART_S for other in chosen):
            chosen.append(match)
            misses += missed
    return chosen


def _apart_s(a: Match, b: Match, fps: float) -> float:
    same = a.truth.target == b.truth.target
    return abs(a.truth.frame - b.truth.frame) / fps if same else np.inf


def _moment(sequence: PlayedSequence, match: Match) -> Moment:
    scene, frame, truth = sequence.scene, match.truth.frame, match.truth
    picture = close_up(scene.undistorted_bgr(frame), scene.K[frame], match, scene.extents[truth.object_id], _PICTURE_PX)
    range_m = float(np.linalg.norm(truth.t_cam_target_m))
    error_m = None if match.estimate is None else float(np.linalg.norm(match.estimate.t_cam_target_m)) - range_m
    return Moment(frame, frame / sequence.fps, range_m, match.rotation_error_deg, error_m, jpeg_url(picture))


def film(video: Path) -> tuple[str | None, list[str]]:
    """The overlay as a data: URL if it is small enough, else STILLS of it."""
    data = video.read_bytes()
    if len(data) <= VIDEO_MAX_BYTES:
        return f"data:video/mp4;base64,{base64.b64encode(data).decode('ascii')}", []
    capture = cv2.VideoCapture(str(video.absolute()))  # a relative path with a colon would be taken for a URL
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    stills = []
    for index in np.linspace(0, max(frames - 1, 0), STILLS).astype(int):
        capture.set(cv2.CAP_PROP_POS_FRAMES, int(index))
        read, frame = capture.read()
        if read:
            scale = _STILL_PX / frame.shape[1]
            small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            stills.append(jpeg_url(np.asarray(small, dtype=np.uint8)))
    return None, stills


def jpeg_url(image_bgr: Image) -> str:
    """The image [H, W, 3] as a data: URL."""
    _, data = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, 86])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
