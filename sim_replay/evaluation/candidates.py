"""Detections of both stages in whole frames, before any threshold, and whether each is a target."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from edge.estimator.decode import shown_size_px
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model
from edge.estimator.window import PixelMap, fit_frame, pixel_aspect, window_around
from edge.tracking.boxes import iou
from edge.types import Array, Estimate, Frame, FrameMeta
from msgs.contract import ScoreCalibration
from sim_replay.datasets import DatasetFrame

SCORE_LEAST = 0.08  # below it are the noise peaks
PEAKS_MOST = 8
# Intersection over union with a true box. In between it counts as neither, nor on an aircraft that is not to be found.
ON_TARGET, OFF_TARGET = 0.2, 0.05


class Candidate(NamedTuple):
    """One peak of one stage in one frame."""

    stage: Literal["acquire", "track"]
    score: float  # the network's, 0..1
    shown_px: float  # see edge.estimator.decode.shown_size_px
    is_target: bool


def candidates(
    model: Model, pictures: Sequence[DatasetFrame], on_frame: Callable[[], None] = lambda: None
) -> Iterator[Candidate]:
    """Every peak in the whole frames, and what the track stage detects in a window around each.

    The model's calibration and thresholds are not applied. Raises InputError if the model does not run, BopError for an
    image that cannot be read.
    """
    estimator = Estimator(_bare(model), PEAKS_MOST)
    model.warm_up()
    for picture in pictures:
        frame = Frame(FrameMeta(picture.image_id, 0, 0), picture.undistorted_bgr(), picture.K)
        truth_boxes, other_boxes = (
            [box for box in picture.undistorted_boxes_xyxy_px(frame.size_wh, targets) if box is not None]
            for targets in (picture.targets, picture.unlisted)
        )
        yield from _in_frame(estimator, frame, truth_boxes, other_boxes)
        on_frame()


def _bare(model: Model) -> Model:
    as_it_is = {"acquire_score": ScoreCalibration(), "track_score": ScoreCalibration()}
    least = {"acquire_score_min": SCORE_LEAST, "track_score_min": SCORE_LEAST}
    model.contract = model.contract.model_copy(update=as_it_is | least)
    return model


def _in_frame(
    estimator: Estimator, frame: Frame, truth_boxes: Sequence[Array], other_boxes: Sequence[Array]
) -> Iterator[Candidate]:
    contract = estimator.model.contract
    aspect = pixel_aspect(frame.K)
    whole_map = fit_frame(frame.image_bgr, contract.acquire_size_wh, contract.acquire_fit, aspect=aspect)[1]
    for found in estimator.anywhere(frame, (), Counter()):
        yield from _labelled(found, whole_map, truth_boxes, other_boxes)
        if contract.track_size_wh is None:
            continue
        scale, size_wh = contract.track_window_scale, contract.track_size_wh
        window = window_around(found.box_xyxy_px, scale, size_wh, frame.size_wh, aspect=aspect)
        for seen in estimator.track(frame, [found.box_xyxy_px]):
            if seen is not None:
                yield from _labelled(seen, window.pixel_map(size_wh), truth_boxes, other_boxes)


def _labelled(
    found: Estimate, pixel_map: PixelMap, truth_boxes: Sequence[Array], other_boxes: Sequence[Array]
) -> Iterator[Candidate]:
    lies_on, lies_on_other = (
        max((iou(found.box_xyxy_px, box) for box in boxes), default=0.0) for boxes in (truth_boxes, other_boxes)
    )
    if lies_on >= ON_TARGET or max(lies_on, lies_on_other) <= OFF_TARGET:
        size_px = (found.box_xyxy_px[2:] - found.box_xyxy_px[:2]) * np.array(pixel_map.scale_xy)
        yield Candidate(found.stage, found.score, shown_size_px(size_px, pixel_map), lies_on >= ON_TARGET)
