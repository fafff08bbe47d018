"""A method's poses against the truth of a dataset's pictures, one by one. What answers may be a model or a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edge.errors import InputError
from sim_replay.bop import BopTarget, Model
from sim_replay.datasets import Dataset, DatasetFrame
from sim_replay.score import Match, TargetPose, Truth, latency_statistics, match_poses, statistics


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method says of one picture."""

    poses: tuple[TargetPose, ...]
    time_ms: float | None  # it took; None: not known
    measured: tuple[TargetPose, ...] | None = None  # what a tracker was given of this picture; None: no tracker
    surplus: tuple[TargetPose, ...] = ()  # poses beyond the aircraft there are: false, wherever they lie


Answerer = Callable[[int, DatasetFrame], Answer]  # the index is what the poses name as their frame


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """One picture, judged by itself."""

    picture: DatasetFrame
    matches: tuple[Match, ...]  # of the targets of which something is seen, in the order of picture.targets
    false_poses: tuple[TargetPose, ...]  # those that belong to no target
    time_ms: float | None
    measured: tuple[Match, ...] = ()  # of the same targets, what a tracker was given of them; empty without one
    not_asked: tuple[Truth, ...] = ()  # others that are there: who finds them is neither right nor wrong


def is_seen(target: BopTarget) -> bool:
    """Whether something of it may be seen: the dataset says so, or does not say and it is not behind the camera."""
    known = target.visible_px is not None or target.box_visible_xyxy_px is not None
    return target.visible_px != 0 if known else bool(target.t_cam_target_m[2] > 0)


def truths_of(index: int, picture: DatasetFrame, models: Mapping[int, Model]) -> list[Truth]:
    """The picture's targets of which something is seen, with size, name and model points; then those not asked for.

    Raises InputError for an object without a model that is asked for; of others it is passed over.
    """
    truths = []
    for target, wanted in [*((t, True) for t in picture.targets), *((t, False) for t in picture.unlisted)]:
        if not is_seen(target):
            continue
        model = models.get(target.object_id)
        if model is None and not wanted:
            continue
        if model is None:
            raise InputError(
                f"{picture.scene.folder}: obj_id {target.object_id} is not among the dataset's models; "
                "without models, give its diameter_m in model_frame.toml"
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
                wanted=wanted,
            )
        )
    return truths


def judge_frames(
    pictures: Sequence[DatasetFrame],
    models: Mapping[int, Model],
    answer: Answerer,
    on_frame: Callable[[JudgedFrame], None] = lambda _: None,
) -> list[JudgedFrame]:
    """Ask for every picture's poses and match them; `on_frame` sees each as it comes. Raises InputError."""
    judged = []
    for index, picture in enumerate(pictures):
        answered = answer(index, picture)
        truths = truths_of(index, picture, models)
        matches, false_poses = match_poses(truths, answered.poses)
        measured = match_poses(truths, answered.measured)[0] if answered.measured is not None else ()
        judged.append(
            JudgedFrame(
                picture,
                _wanted(matches),
                (*false_poses, *answered.surplus),
                answered.time_ms,
                measured=_wanted(measured),
                not_asked=tuple(truth for truth in truths if not truth.wanted),
            )
        )
        on_frame(judged[-1])
    return judged


def _wanted(matches: Sequence[Match]) -> tuple[Match, ...]:
    return tuple(match for match in matches if match.truth.wanted)


def score_of(dataset: Dataset, method: dict[str, Any], judged: Sequence[JudgedFrame]) -> dict[str, Any]:
    """The score of many frames: shares 0..1, degrees, metres, milliseconds; None where there is nothing to tell.

    `method` says what was judged. The figures are those of `sim_replay.score.statistics`.
    """
    matches = [match for frame in judged for match in frame.matches]
    false_poses = [pose for frame in judged for pose in frame.false_poses]
    return {
        "dataset": dataset.name,
        "split": dataset.split,
        "method": method,
        "time_ms": latency_statistics([frame.time_ms for frame in judged if frame.time_ms is not None]),
        **statistics(len(judged), matches, false_poses, [truth.frame for frame in judged for truth in frame.not_asked]),
    }
