"""The worst frames of an evaluation on one contact sheet, with true and estimated box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs.geometry import Array
from sim_replay import metrics
from sim_replay.bop import Model
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.ground_truth import extents_of
from sim_replay.overlay import ESTIMATE_BGR, TRUTH_BGR, Color, Extents, draw_pose, project, window_camera
from sim_replay.score import Match, TargetPose

Image = NDArray[np.uint8]

SHOWN = 12
MISSES_SHOWN_MAX = 4
_COLUMNS = 4
_TILE_PX = 420
_CAPTION_PX = 54
_VIEW_SCALE = 2.6  # side of the cut-out over the target's projected box
_VIEW_MIN_PX = 96
_UP_LENGTHS = 0.3  # length of the line that leads up, over the target's own


def badness(match: Match) -> float:
    """An estimate's error as a multiple of the limits of Pose@10°/5 %; infinite for a missed target.

    If its rotation is unknown, only the position counts.
    """
    if match.estimate is None:
        return float("inf")
    translation_rel = metrics.translation_error_rel(match.estimate.t_cam_target_m, match.truth.t_cam_target_m)
    in_place = float(translation_rel) / metrics.TRANSLATION_LIMIT_REL
    turn_deg = match.rotation_error_deg
    return in_place if turn_deg is None else max(turn_deg / metrics.ROTATION_LIMIT_DEG, in_place)


def worst_matches(judged: Sequence[JudgedFrame], shown: int = SHOWN) -> list[tuple[JudgedFrame, Match]]:
    """The `shown` worst targets, worst first; a few evenly spread misses represent all of them."""
    ordered = sorted(((frame, match) for frame in judged for match in frame.matches), key=lambda p: -badness(p[1]))
    missed = [pair for pair in ordered if pair[1].estimate is None]
    found = [pair for pair in ordered if pair[1].estimate is not None]
    count = min(MISSES_SHOWN_MAX, len(missed))
    spread = [missed[int(i)] for i in np.linspace(0, len(missed) - 1, count).round()] if count else []
    return [*spread, *found[: shown - count]]


def write_worst(path: Path, judged: Sequence[JudgedFrame], models: Mapping[int, Model]) -> Path | None:
    """Write the sheet; None, and no file, if there is no target. Raises BopError on an unreadable image."""
    tiles = [_tile(frame, match, models) for frame, match in worst_matches(judged)]
    if not tiles:
        return None
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % _COLUMNS)
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    if not cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 88]):
        raise OSError(f"{path} cannot be written")
    return path


def _tile(frame: JudgedFrame, match: Match, models: Mapping[int, Model]) -> Image:
    """The target's surroundings, enlarged, with a caption above."""
    truth = match.truth
    image_bgr, K = frame.picture.undistorted_bgr(), frame.picture.K
    tile = np.full((_TILE_PX + _CAPTION_PX, _TILE_PX, 3), 255, dtype=np.uint8)
    tile[_CAPTION_PX:] = close_up(image_bgr, K, match, extents_of(models[truth.object_id]), _TILE_PX)
    range_m = float(np.linalg.norm(truth.t_cam_target_m))
    told = "not found"
    if match.translation_error_m is not None:
        turn_deg = match.rotation_error_deg
        turn = "not known" if turn_deg is None else f"{turn_deg:.0f} deg"
        told = f"E_r {turn}, E_t {match.translation_error_m:.1f} m"
    where = f"scene {frame.picture.scene_id} image {frame.picture.image_id}, {range_m:.0f} m"
    for line, text in enumerate((where, told)):
        cv2.putText(tile, text, (8, 22 + 23 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (20, 20, 20), 1, cv2.LINE_AA)
    return tile


def close_up(image_bgr: Image, K: Array, match: Match, extents: Extents, side_px: int) -> Image:
    """The target's surroundings enlarged to [side_px, side_px, 3], with true and estimated box.

    Beside the nose's arrow, a line leads up from each, like a fin: axes that are turned about the nose show by it.
    """
    truth, estimate = match.truth, match.estimate
    corners = project(extents.corners_m() @ truth.R_cam_target.T + truth.t_cam_target_m, K)
    low, high = (np.zeros(2), np.array(image_bgr.shape[1::-1])) if corners is None else (corners.min(0), corners.max(0))
    side = int(min(max(_VIEW_SCALE * float(np.max(high - low)), _VIEW_MIN_PX), 2 * max(image_bgr.shape)))
    left, top = (int(value) for value in np.round(0.5 * (low + high - side)))
    view = _cut(image_bgr, left, top, side)
    inset = np.asarray(cv2.resize(view, (side_px, side_px), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    K_view = window_camera(K, (left, top), side_px / side)
    for pose, color, thickness in ((truth, TRUTH_BGR, 2), (estimate, ESTIMATE_BGR, 1)):
        if pose is not None:
            draw_pose(inset, K_view, pose, extents, color, thickness)
            _draw_up(inset, K_view, pose, extents, color, thickness)
    return inset


def _draw_up(canvas: Image, K: Array, pose: TargetPose, extents: Extents, color: Color, thickness: int) -> None:
    """A line from the target's origin, up in its own axes, in place; nothing for a pose of unknown rotation."""
    tip_m = [0.0, 0.0, min(extents.min_m[2], 0.0) - _UP_LENGTHS * extents.size_m[0]]
    ends_px = project(np.array([np.zeros(3), tip_m]) @ pose.R_cam_target.T + pose.t_cam_target_m, K)
    if ends_px is not None and pose.rotation_known and np.abs(ends_px).max() < 1e5:
        start, end = ((int(u), int(v)) for u, v in np.round(ends_px))
        cv2.line(canvas, start, end, color, thickness + 1, cv2.LINE_AA)


def _cut(image_bgr: Image, left: int, top: int, side: int) -> Image:
    """A square of the image; black beyond its edges."""
    height, width = image_bgr.shape[:2]
    out = np.zeros((side, side, 3), dtype=np.uint8)
    rows, columns = slice(max(top, 0), min(top + side, height)), slice(max(left, 0), min(left + side, width))
    if rows.start < rows.stop and columns.start < columns.stop:
        out[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = image_bgr[rows, columns]
    return out
