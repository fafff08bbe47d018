"""test_targets_bop19.json: which images and objects of a test split count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_replay.bop.fields import integer, load_json
from sim_replay.bop.records import BopError, BopTarget

Wanted = dict[tuple[int, int], Counter[int]]  # by scene and image id: how many instances of each object


def read_targets(path: Path) -> Wanted | None:
    """test_targets_bop19.json; None if the dataset has none. Raises BopError."""
    if not path.is_file():
        return None
    entries = load_json(path)
    if not isinstance(entries, list):
        raise BopError(f"{path} does not hold a list of targets")
    wanted: Wanted = {}
    for number, entry in enumerate(entries):
        scene_id, image_id, object_id = (
            integer(path, f"entry {number}", entry, name) for name in ("scene_id", "im_id", "obj_id")
        )
        count = integer(path, f"entry {number}", entry, "inst_count") if "inst_count" in entry else 1
        wanted.setdefault((scene_id, image_id), Counter())[object_id] += count
    return wanted


def chosen_of(targets: Sequence[BopTarget], wanted: Counter[int]) -> list[int]:
    """Indices of the wanted instances of each object; if there are too many, the most visible ones.

    Where no pixels are counted, a target is as visible as its box is large.
    """
    by_visible = sorted(range(len(targets)), key=lambda index: -_visible_px(targets[index]))
    left, chosen = wanted.copy(), []
    for index in by_visible:
        if left[targets[index].object_id] > 0:
            left[targets[index].object_id] -= 1
            chosen.append(index)
    return sorted(chosen)


def _visible_px(target: BopTarget) -> float:
    box = target.box_visible_xyxy_px
    if target.visible_px is not None or box is None:
        return target.visible_px or 0.0
    return float(np.prod(box[2:] - box[:2]))
