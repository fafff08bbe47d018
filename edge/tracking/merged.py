"""Detections that may show two aircraft as one: what the network finds where targets overlap in the image. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge.tracking.boxes import overlap
from edge.types import Array, Estimate

# A detection may show a target, too, of whose box, or of its own if that is smaller, it covers this share.
COVERED_SHARE = 0.25
# Such a detection lies anywhere between its targets: variance along their distance, as a share of its square.
BETWEEN = 1.0 / 3.0
# How much longer than predicted, in width or height, a box is too large for one target.
LONGER = 1.25


def shown_at_once(
    estimates: Sequence[Estimate], boxes_xyxy_px: Sequence[Array], lately: Sequence[bool]
) -> dict[int, list[int]]:
    """By index of the estimates that lie on several targets: the indices of these targets.

    `boxes_xyxy_px` [4] are the targets' predicted ones. A target counts for the estimate that covers most of it, so
    nothing is said against one that is seen apart from its neighbour. Of the two, the one that is not detected may soon
    be predicted elsewhere: an estimate on one that was shown with another `lately` is listed while it is too large.
    """
    shown: dict[int, list[int]] = {}
    for target, box in enumerate(boxes_xyxy_px):
        shares = [overlap(estimate.box_xyxy_px, box) for estimate in estimates]
        if shares and max(shares) >= COVERED_SHARE:
            shown.setdefault(int(np.argmax(shares)), []).append(target)
    return {
        estimate: targets
        for estimate, targets in shown.items()
        if len(targets) > 1
        or (lately[targets[0]] and _too_large(estimates[estimate].box_xyxy_px, boxes_xyxy_px[targets[0]]))
    }


def less_sure(estimate: Estimate, boxes_xyxy_px: Sequence[Array], K: Array) -> Estimate:
    """An estimate that may lie anywhere between the targets with these predicted boxes [4].

    They are as far apart as predicted, or as the estimate's box is larger than theirs: each such estimate draws the
    predictions together.
    """
    boxes = np.array(boxes_xyxy_px)
    centers, sizes = 0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]
    larger_px = estimate.box_xyxy_px[2:] - estimate.box_xyxy_px[:2] - sizes.mean(axis=0)
    apart_px = np.maximum(np.ptp(centers, axis=0), larger_px)
    Z = estimate.t_cam_target_m[2]
    across_m = np.diag([apart_px[0] * Z / K[0, 0], apart_px[1] * Z / K[1, 1], 0.0])
    along = estimate.t_cam_target_m / np.linalg.norm(estimate.t_cam_target_m)
    across_m -= np.outer(along, along @ across_m)
    covariance = estimate.covariance.copy()
    covariance[:3, :3] += BETWEEN * across_m @ across_m.T
    return replace(estimate, covariance=covariance)


def _too_large(box_xyxy_px: Array, predicted_xyxy_px: Array) -> bool:
    return bool(np.any(box_xyxy_px[2:] - box_xyxy_px[:2] > LONGER * (predicted_xyxy_px[2:] - predicted_xyxy_px[:2])))
