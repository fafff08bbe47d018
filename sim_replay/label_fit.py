"""Whether a dataset's camera matrices, poses, boxes and models belong together. Pure.

They do not where cam_K is that of another resolution than the images, or lengths are in another unit.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.bop import BopTarget, Distortion

Array = NDArray[np.float64]
NEAR_PX = 10.0  # the least distance that counts as beside a box: labels of small targets are rough
FEWEST = 3  # targets of a scene: a single one may be cut, or hidden but for a wing tip
# The longer side of a whole target at its depth, over its model's diameter; 2.5 where a box around four pixels is drawn
# three too large on each side.
SIZES_REL = (0.05, 3.0)


class Labelled(NamedTuple):
    """A target and the camera of its image."""

    target: BopTarget
    K: Array  # [3, 3]
    distortion: Distortion | None
    scene: Path


def lies_beside_its_box(labelled: Labelled) -> bool | None:
    """Whether the target's origin projects farther from its box than the box is long; None: it has no box.

    An aircraft's origin lies in or near its box. So it does where the box is that of its visible part, unless little of
    it is visible.
    """
    target, box = labelled.target, _box(labelled.target)
    if box is None or target.t_cam_target_m[2] <= 0:
        return None
    lens = np.array(labelled.distortion or np.zeros(5))
    pixels, _ = cv2.projectPoints(target.t_cam_target_m[None], np.zeros(3), np.zeros(3), labelled.K, lens)
    beside = np.maximum(box[:2] - pixels[0, 0], pixels[0, 0] - box[2:]).max()
    return bool(beside > max((box[2:] - box[:2]).max(), NEAR_PX))


def size_rel(labelled: Labelled, diameter_m: float) -> float | None:
    """The longer side of its box at its depth over the diameter; None: it has no box."""
    box, Z_m = _box(labelled.target), labelled.target.t_cam_target_m[2]
    if box is None or Z_m <= 0:
        return None
    return float(((box[2:] - box[:2]) / labelled.K[[0, 1], [0, 1]]).max() * Z_m / diameter_m)


def lie_beside_their_boxes(all_labelled: Iterable[Labelled]) -> bool:
    """Whether more than half of the targets do, of at least FEWEST."""
    told = [is_so for labelled in all_labelled if (is_so := lies_beside_its_box(labelled)) is not None]
    return len(told) >= FEWEST and 2 * sum(told) > len(told)


def told_of_places(all_labelled: Iterable[Labelled]) -> str | None:
    """The scenes whose targets mostly lie beside their boxes, in a sentence; None: there is none."""
    scenes: dict[Path, list[Labelled]] = defaultdict(list)
    for labelled in all_labelled:
        scenes[labelled.scene].append(labelled)
    odd = [scene for scene, own in scenes.items() if lie_beside_their_boxes(own)]
    if not odd:
        return None
    first = f"{odd[0].parent.name}/{odd[0].name}"  # splits number their scenes alike
    others = f" and {len(odd) - 1} more" if len(odd) > 1 else ""
    return (
        f"in scene {first}{others}, most poses project beside their boxes: is cam_K in pixels of these images, "
        "and do poses and boxes belong to the same targets?"
    )


def told_of_sizes(all_labelled: Iterable[Labelled], diameters_m: Mapping[int, float]) -> str | None:
    """What is wrong, as a sentence, if an object's targets (their median) are not of its size; otherwise None."""
    sizes: dict[int, list[float]] = defaultdict(list)
    for one in all_labelled:
        object_id = one.target.object_id
        if object_id in diameters_m and (size := size_rel(one, diameters_m[object_id])) is not None:
            sizes[object_id].append(size)
    middle = {object_id: float(np.median(found)) for object_id, found in sorted(sizes.items())}
    odd = [f"obj_id {key} {size:.2g}" for key, size in middle.items() if not SIZES_REL[0] < size < SIZES_REL[1]]
    if not odd:
        return None
    return (
        f"targets look as many times as large as their model: {', '.join(odd)}; are models and cam_t_m2c in "
        "millimetres, and is cam_K in pixels of these images?"
    )


def _box(target: BopTarget) -> Array | None:
    return target.box_visible_xyxy_px if target.box_whole_xyxy_px is None else target.box_whole_xyxy_px
