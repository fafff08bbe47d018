"""BOP results files (bop_toolkit docs/bop_challenge_2019 format): reads any method's poses, writes those of a model.

METHOD_DATASET-SPLIT.csv with a header, which may be missing as for bop_toolkit's reader, and one pose per line:
scene_id,im_id,obj_id,score,R,t,time. R is nine and t three numbers separated by spaces, of the dataset's model axes, t
in millimetres; time in seconds, -1 if unknown.
"""

from __future__ import annotations

import csv
import logging
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError
from msgs.geometry import nearest_rotation
from sim_replay.bop.fields import is_rotation
from sim_replay.bop.records import MM_PER_M
from sim_replay.datasets import Dataset, DatasetFrame
from sim_replay.evaluation.judge import Answer, Answerer, JudgedFrame, is_hidden, is_seen
from sim_replay.score import TargetPose

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
NO_OBJECT = 0  # obj_id of a pose that belongs to no target: BOP counts from 1, though not every dataset does
UNKNOWN_TIME_S = -1.0
_UNITS_REL = 100.0  # no method is off by so much, but metres for millimetres are
_LARGEST = 1e15  # beyond it, squares and sums exceed what JSON can represent

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ResultRow:
    """One pose of the file, lengths in metres."""

    scene_id: int
    image_id: int
    object_id: int
    score: float
    R_cam_model: Array  # [3, 3]
    t_cam_model_m: Array  # [3]
    time_s: float


def read_results(path: Path) -> list[ResultRow]:
    """All rows of a results file. Raises InputError, naming file, line and column."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets write a byte order mark before UTF-8
            reader = csv.reader(file)
            first = [cell.strip() for cell in next(reader, [])]
            if tuple(first) == COLUMNS:
                rows = []
            elif len(first) == len(COLUMNS) and first[0].isdecimal():
                rows = [_row(path, 1, first)]
            else:
                raise InputError(f"{path} line 1: its columns are not {','.join(COLUMNS)}")
            return rows + [_row(path, reader.line_num, cells) for cells in reader if cells]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _row(path: Path, line: int, cells: Sequence[str]) -> ResultRow:
    if len(cells) != len(COLUMNS):
        raise InputError(f"{path} line {line}: {len(cells)} columns, not {len(COLUMNS)}")
    told = dict(zip(COLUMNS, cells, strict=True))
    at = f"{path} line {line}"
    scene_id, image_id, object_id = (_whole(at, name, told[name]) for name in COLUMNS[:3])
    R = _of(at, "R", told["R"], 9).reshape(3, 3)
    if not is_rotation(R):
        raise InputError(f"{at}: R is not a rotation")
    score, time_s = (float(_of(at, name, told[name], 1)[0]) for name in ("score", "time"))
    return ResultRow(scene_id, image_id, object_id, score, R, _of(at, "t", told["t"], 3) / MM_PER_M, time_s)


def _of(at: str, name: str, cell: str, count: int) -> Array:
    """The numbers [count] in a cell. Raises InputError."""
    try:
        values = np.array([float(number) for number in cell.split()])
    except ValueError as error:
        raise InputError(f"{at}: {name} is not a number: {cell!r}") from error
    if values.shape != (count,) or not (np.abs(values) < _LARGEST).all():
        raise InputError(f"{at}: {name} is not {count} finite number{'s' * (count > 1)}")
    return values


def _whole(at: str, name: str, cell: str) -> int:
    """The number in a cell, also if it is written as 5.0. Raises InputError."""
    with suppress(ValueError):
        return int(cell)  # exactly, as images may be numbered by their time
    (value,) = _of(at, name, cell, 1)
    if value % 1:
        raise InputError(f"{at}: {name} is not a whole number: {cell!r}")
    return int(value)


def file_answers(path: Path, dataset: Dataset) -> Answerer:
    """Answers from a results file; poses of images that are not evaluated are ignored.

    Of each object, as many poses are compared with the ground truth of an image as there are instances of it: as in BOP
    those with the highest score, the first of equal ones, because otherwise the ground truth would choose. If an object
    has too few, the best of those that name an object which is not in the image take their place (a model-free method
    names none). The rest are false.

    Raises InputError if the file is invalid, none of its rows belongs to an image of the dataset, or two splits of the
    dataset share a scene number.
    """
    by_picture: dict[tuple[int, int], list[ResultRow]] = {}
    for row in read_results(path):
        by_picture.setdefault((row.scene_id, row.image_id), []).append(row)
    numbers = [scene.scene_id for scene in dataset.scenes]
    if len(set(numbers)) < len(numbers):
        raise InputError(f"{dataset.root}: two of its splits have a scene of one number; give --split")
    known = {(scene.scene_id, frame.image_id) for scene in dataset.scenes for frame in scene.frames}
    if by_picture and not known & by_picture.keys():
        raise InputError(f"{path}: none of its scene_id and im_id is a picture of {dataset.name}")
    _warn_of_other_pictures(path, by_picture, dataset, known)
    _warn_of_other_units(path, by_picture, dataset)

    def answer(index: int, picture: DatasetFrame) -> Answer:
        rows = by_picture.get((picture.scene_id, picture.image_id), [])
        times_s = [row.time_s for row in rows if row.time_s >= 0]
        present = [t for t in (*picture.targets, *picture.unlisted) if is_seen(t) or is_hidden(t)]
        best = _best(rows, [target.object_id for target in present])
        kept, surplus = ([row for row in rows if (id(row) in best) is one] for one in (True, False))
        return Answer(
            tuple(_pose(index, row, picture) for row in kept),
            1e3 * max(times_s) if times_s else None,
            surplus=tuple(_pose(index, row, picture) for row in surplus),
        )

    return answer


def _warn_of_other_pictures(
    path: Path,
    by_picture: Mapping[tuple[int, int], Sequence[ResultRow]],
    dataset: Dataset,
    known: Set[tuple[int, int]],
) -> None:
    """Of the opened scenes alone: a file may tell of more than are evaluated."""
    numbers = {scene.scene_id for scene in dataset.scenes}
    unknown = [key for key in sorted(by_picture) if key not in known and key[0] in numbers]
    if unknown:
        told = "%s: %d poses are of pictures that their scenes do not have, and count nowhere, such as %d of scene %d"
        scene_id, image_id = unknown[0]
        _log.warning(told, path, sum(len(by_picture[key]) for key in unknown), image_id, scene_id)


def _warn_of_other_units(
    path: Path, by_picture: Mapping[tuple[int, int], Sequence[ResultRow]], dataset: Dataset
) -> None:
    told_m = [np.linalg.norm(row.t_cam_model_m) for rows in by_picture.values() for row in rows]
    targets = (target for scene in dataset.scenes for frame in scene.frames for target in frame.targets)
    true_m = [np.linalg.norm(target.t_cam_target_m) for target in targets]
    if told_m and true_m and not 1 / _UNITS_REL < np.median(told_m) / np.median(true_m) < _UNITS_REL:
        distances = f"its poses lie {np.median(told_m):.3g} m from the camera, the targets {np.median(true_m):.3g} m"
        _log.warning("%s: %s (medians): t is in millimetres", path, distances)


def _best(rows: Sequence[ResultRow], there: Sequence[int]) -> set[int]:
    """Rows, by id(), that are compared with the aircraft `there`, given by their object ids."""
    left, best = Counter(there), set()
    others = []
    for row in sorted(rows, key=lambda row: -row.score):
        if left[row.object_id] > 0:
            left[row.object_id] -= 1
            best.add(id(row))
        elif row.object_id not in there:
            others.append(id(row))
    return best.union(others[: left.total()])


def _pose(index: int, row: ResultRow, picture: DatasetFrame) -> TargetPose:
    """The pose of the body axes, from that of the row's model axes."""
    R_cam_model = nearest_rotation(row.R_cam_model)
    R, t_m = picture.scene.models.of(row.object_id).pose_of_body(R_cam_model, row.t_cam_model_m)
    return TargetPose(index, R, t_m, score=row.score)


def results_name(method: str, dataset: Dataset) -> str:
    """METHOD_DATASET-SPLIT.csv; BOP splits the name at the underscore."""
    parts = (part.replace("_", "-") for part in (method, dataset.name, dataset.split or "all"))
    return "{}_{}-{}.csv".format(*parts)


def write_results(path: Path, judged: Sequence[JudgedFrame]) -> None:
    """Write every pose, matched ones under their true obj_id (a model-free method names none), others under 0, or a
    negative number if an object has that one.

    Poses of unknown rotation are left out, with a warning: the format cannot mark them, and a reader would score the
    placeholder.
    """
    left_out = 0
    there = {target.object_id for frame in judged for target in (*frame.picture.targets, *frame.picture.unlisted)}
    no_object = NO_OBJECT if NO_OBJECT not in there else min(there) - 1
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frame in judged:
            time_s = UNKNOWN_TIME_S if frame.time_ms is None else frame.time_ms * 1e-3
            found = [(m.truth.object_id, m.estimate) for m in frame.matches if m.estimate is not None]
            for object_id, pose in [*found, *((no_object, pose) for pose in frame.false_poses)]:
                if not pose.rotation_known:
                    left_out += 1
                    continue
                model = frame.picture.scene.models.of(object_id)
                R = pose.R_cam_target @ model.R_body_model
                t_mm = (pose.t_cam_target_m + pose.R_cam_target @ model.t_body_model_m) * MM_PER_M
                score = 1.0 if pose.score is None else pose.score
                ids = (frame.picture.scene_id, frame.picture.image_id, object_id)
                writer.writerow([*ids, f"{score:.6f}", _numbers(R.ravel(), 9), _numbers(t_mm, 4), f"{time_s:.6f}"])
    if left_out:
        _log.warning("%s: %d poses are left out, as the format cannot say that a rotation is unknown", path, left_out)


def _numbers(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
