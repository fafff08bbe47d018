"""Compares a method's poses with a dataset's ground truth, image by image. The source may be a model or a file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.errors import InputError
from sim_replay.bop import BopTarget, Model
from sim_replay.datasets import Dataset, DatasetFrame
from sim_replay.score import Match, TargetPose, Truth, latency_statistics, match_poses, statistics


@dataclass(frozen=True, eq=False)
class Answer:
    """A method's output for one image."""

    poses: tuple[TargetPose, ...]
    time_ms: float | None  # processing time; None: unknown
    measured: tuple[TargetPose, ...] | None = None  # a tracker's inputs for this image; None: no tracker
    directions: tuple[TargetPose, ...] = ()  # of targets whose range is not known: only where they are seen is told
    surplus: tuple[TargetPose, ...] = ()  # poses beyond the number of aircraft: false, wherever they are


Answerer = Callable[[int, DatasetFrame], Answer]  # the index is the poses' `frame`


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """The result for one image."""

    picture: DatasetFrame
    matches: tuple[Match, ...]  # of the visible targets, in the order of picture.targets
    false_poses: tuple[TargetPose, ...]  # those that belong to no target
    time_ms: float | None
    measured: tuple[Match, ...] = ()  # matches of the tracker's inputs with the same targets; empty without a tracker
    directions: tuple[Match, ...] = ()  # matches of the directions with the same targets; empty without any
    false_directions: tuple[TargetPose, ...] = ()  # those that belong to no target
    not_asked: tuple[Truth, ...] = ()  # hidden or unlisted, but present: detecting them is neither right nor wrong


def is_seen(target: BopTarget) -> bool:
    """Whether it may be visible: the dataset says so, or it does not say and the target is not behind the camera."""
    return bool(target.t_cam_target_m[2] > 0) if target.visible_px is None else target.visible_px != 0


def is_hidden(target: BopTarget) -> bool:
    """Whether it is in the picture, entirely behind something: its outline has pixels, none of them visible."""
    return target.visible_px == 0 and bool(target.whole_px)


def truths_of(
    index: int, picture: DatasetFrame, models: Mapping[int, Model], *, out_of_view: bool = False
) -> list[Truth]:
    """The image's targets, with size, name and model points, then the unlisted ones; to be estimated are the visible
    ones among the former. `out_of_view`: also those that the dataset tells of, and the image does not show.

    Raises InputError for an object without a model that is to be estimated; others are as large as their box tells.
    """
    truths = []
    for target, listed in [*((t, True) for t in picture.targets), *((t, False) for t in picture.unlisted)]:
        visible = is_seen(target)
        wanted = listed and visible
        if not (visible or is_hidden(target) or out_of_view):
            continue
        model = models.get(target.object_id) or (None if wanted else _as_it_looks(target, picture))
        if model is None and not wanted:
            continue
        if model is None:
            raise InputError(
                f"{picture.scene.folder}: obj_id {target.object_id} is not among the dataset's models; "
                f"if it has none, give its diameter_m under [objects.{target.object_id}] in model_frame.toml"
            )
        truths.append(
            Truth(
                index,
                target.R_cam_target,
                target.t_cam_target_m,
                target.object_id,
                model.diameter_m,
                model.name,
                model.points_m,
                visible=visible,
                occluded=is_hidden(target),
                wanted=wanted,
            )
        )
    return truths


def _as_it_looks(target: BopTarget, picture: DatasetFrame) -> Model | None:
    """An aircraft as large as its box at its depth; None if it has no box."""
    box = target.box_visible_xyxy_px if target.box_whole_xyxy_px is None else target.box_whole_xyxy_px
    if box is None:
        return None
    sides_m = (box[2:] - box[:2]) / np.array([picture.K[0, 0], picture.K[1, 1]]) * target.t_cam_target_m[2]
    return Model(float(sides_m.max()))


def judge_frames(
    pictures: Sequence[DatasetFrame],
    models: Mapping[int, Model],
    answer: Answerer,
    on_frame: Callable[[JudgedFrame], None] = lambda _: None,
) -> list[JudgedFrame]:
    """Get every image's poses and match them; `on_frame` is called with each result. Raises InputError."""
    judged = []
    for index, picture in enumerate(pictures):
        answered = answer(index, picture)
        # A tracker rightly tells of what has just left the image.
        truths = truths_of(index, picture, models, out_of_view=answered.measured is not None)
        matches, false_poses = match_poses(truths, answered.poses)
        measured = match_poses(truths, answered.measured)[0] if answered.measured is not None else ()
        seen, false_directions = match_poses(truths, answered.directions) if answered.directions else ((), ())
        judged.append(
            JudgedFrame(
                picture,
                _wanted(matches),
                (*false_poses, *answered.surplus),
                answered.time_ms,
                measured=_wanted(measured),
                directions=_wanted(seen),
                false_directions=tuple(false_directions),
                not_asked=tuple(t for t in truths if not t.wanted and (t.visible or t.occluded)),
            )
        )
        on_frame(judged[-1])
    return judged


def labels_sha256(pictures: Iterable[DatasetFrame]) -> str:
    """Of the images and the targets in them: the same for a copy of a dataset, another for one of another seed."""
    told = hashlib.sha256()
    for picture in pictures:
        told.update(f"{picture.scene_id}/{picture.image_id}".encode())
        for target in picture.targets:
            told.update(f" {target.object_id} {np.round(1e3 * target.t_cam_target_m).astype(int).tolist()}".encode())
    return told.hexdigest()


def _wanted(matches: Sequence[Match]) -> tuple[Match, ...]:
    return tuple(match for match in matches if match.truth.wanted)


def score_of(dataset: Dataset, method: dict[str, Any], judged: Sequence[JudgedFrame]) -> dict[str, Any]:
    """The score of many frames: shares 0..1, degrees, metres, milliseconds; None where there is no data.

    `method` describes what was evaluated. The figures are those of `sim_replay.score.statistics`.
    """
    matches = [match for frame in judged for match in frame.matches]
    false_poses = [pose for frame in judged for pose in frame.false_poses]
    return {
        "dataset": dataset.name,
        "split": dataset.split,
        "labels_sha256": labels_sha256(frame.picture for frame in judged),
        "method": method,
        "time_ms": latency_statistics([frame.time_ms for frame in judged if frame.time_ms is not None]),
        **statistics(len(judged), matches, false_poses, [truth.frame for frame in judged for truth in frame.not_asked]),
    }
