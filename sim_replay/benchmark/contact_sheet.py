"""`uavpose-replay sheet --dataset`: a grid of a dataset's frames, each with its targets boxed and one enlarged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError
from sim_replay.bop import BopError, BopFrame, BopScene, BopTarget, find_scenes, object_names
from sim_replay.evaluation.judge import is_seen

Image = NDArray[np.uint8]
COLUMNS, ROWS = 4, 5
TILE_WH_PX = (400, 225)
INSET_PX = 116
INSET_SCALE = 1.5  # of the box's longer side
MAX_BYTES = 300_000
BOX_BGR = (255, 255, 0)
TEXT_BGR = (255, 255, 255)
FONT_PX = 13


def _inset(image_bgr: Image, box: NDArray[np.float64]) -> Image:
    """The box's surroundings, enlarged to a square."""
    height, width = image_bgr.shape[:2]
    side = int(np.clip(INSET_SCALE * (box[2:] - box[:2]).max(), 24, min(width, height)))
    corner = np.clip(np.round(0.5 * (box[:2] + box[2:] - side)), 0, np.array([width, height]) - side).astype(int)
    crop = image_bgr[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    how = cv2.INTER_AREA if side > INSET_PX else cv2.INTER_CUBIC
    inset = np.asarray(cv2.resize(crop, (INSET_PX, INSET_PX), interpolation=how), np.uint8)
    cv2.rectangle(inset, (0, 0), (INSET_PX - 1, INSET_PX - 1), TEXT_BGR, 1)
    return inset


def tile(image_bgr: Image, frame: BopFrame, names: Mapping[int, str]) -> Image:
    """A thumbnail [225, 400, 3] of the frame [H, W, 3]: boxes, the first target enlarged, its name and range."""
    scale = np.array(TILE_WH_PX) / image_bgr.shape[1::-1]
    out = np.asarray(cv2.resize(image_bgr, TILE_WH_PX, interpolation=cv2.INTER_AREA), np.uint8)
    seen = [target for target in frame.targets if is_seen(target)]  # BOP lists hidden ones too
    boxes = [target.box_visible_xyxy_px for target in seen if target.box_visible_xyxy_px is not None]
    for box in boxes:
        corners = np.round((box.reshape(2, 2) + 0.5) * scale - 0.5 + [[-2, -2], [2, 2]]).astype(int)
        cv2.rectangle(out, [int(v) for v in corners[0]], [int(v) for v in corners[1]], BOX_BGR, 1)
    if boxes:
        # In the corner opposite the target.
        middle = 0.5 * (boxes[0][:2] + boxes[0][2:]) * scale
        left = TILE_WH_PX[0] - INSET_PX if middle[0] < 0.5 * TILE_WH_PX[0] else 0
        top = TILE_WH_PX[1] - INSET_PX if middle[1] < 0.5 * TILE_WH_PX[1] else 0
        out[top : top + INSET_PX, left : left + INSET_PX] = _inset(image_bgr, boxes[0])
    _caption(out, _words(seen, names))
    return out


def _words(seen: Sequence[BopTarget], names: Mapping[int, str]) -> str:
    if not seen:
        return "no target"
    first = seen[0]
    name = names.get(first.object_id, f"object {first.object_id}")
    more = f" and {len(seen) - 1} more" if len(seen) > 1 else ""
    return f"{name} {np.linalg.norm(first.t_cam_target_m):.0f} m{more}"


def _caption(tile_bgr: Image, text: str) -> None:
    font: Any = cv2.FontFace("sans")
    for shift, color in ((1, (0, 0, 0)), (0, TEXT_BGR)):
        cv2.putText(tile_bgr, text, (4 + shift, TILE_WH_PX[1] - 6 + shift), color, font, FONT_PX, 500)


def _chosen(scenes: Sequence[BopScene]) -> list[tuple[BopScene, BopFrame]]:
    """Frames spread over the scenes: one of each in turn, from a different part of the flight each time."""
    pictured = [(scene, scene.pictured) for scene in scenes]
    pictured = [(scene, frames) for scene, frames in pictured if frames]
    count = min(COLUMNS * ROWS, sum(len(frames) for _, frames in pictured))
    picks: dict[tuple[int, int], None] = {}
    for k in range(40 * count):
        if len(picks) == count:
            break
        index = (k * max(len(pictured) // count, 1)) % len(pictured)
        frames = pictured[index][1]
        picks[index, round((0.5 + k * 0.618) % 1.0 * (len(frames) - 1))] = None
    return [(pictured[index][0], pictured[index][1][frame]) for index, frame in picks]


def contact_sheet(dataset: Path) -> Image:
    """The grid [H, W, 3]. Raises InputError."""
    try:
        scenes = find_scenes(dataset)
        names_of = cache(object_names)  # by dataset: the same number is another object in each
        tiles = [tile(scene.image_bgr(frame), frame, names_of(scene.root)) for scene, frame in _chosen(scenes)]
    except BopError as error:
        raise InputError(str(error)) from error
    if not tiles:
        raise InputError(f"{dataset}: holds no pictures")
    while len(tiles) % COLUMNS:
        tiles.append(np.zeros_like(tiles[0]))
    return np.vstack([np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)])


def run(dataset: Path, out: Path) -> int:
    """Write the sheet as a JPEG of at most 300 kB. Raises InputError."""
    sheet = contact_sheet(dataset)
    for quality in range(92, 10, -4):
        data = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        if len(data) <= MAX_BYTES:
            break
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(data.tobytes())
    print(f"{out}: {sheet.shape[1]}×{sheet.shape[0]}, {len(data) // 1000} kB")
    return 0
