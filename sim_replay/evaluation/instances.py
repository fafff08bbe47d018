"""Identifies the targets of an object over a scene: BOP's ground truth states the object but no instance. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from msgs.geometry import Array
from sim_replay.score import Truth


def instances(truths: Sequence[Truth], places_m: Sequence[Array]) -> list[int]:
    """A number for each truth that identifies its target, among those of its object, in every frame.

    As long as a frame contains as many of an object as the one before, their order is the same. Where one has appeared
    or vanished, each is the target that was last seen nearest.

    Args:
        truths: Of one scene; those of a frame in the order of its scene_gt.json.
        places_m: Where each is, [3], in axes that do not move if they are known, otherwise in `cam`.
    """
    by_object: dict[int, dict[int, list[int]]] = {}
    for i, truth in enumerate(truths):
        by_object.setdefault(truth.object_id, {}).setdefault(truth.frame, []).append(i)
    numbers = [0] * len(truths)
    for frames in by_object.values():
        last_seen_m: dict[int, Array] = {}
        before: list[int] = []
        before_frame = -1
        for frame, present in sorted(frames.items()):
            here_m = [places_m[i] for i in present]
            # After a frame without any, the order is the same only if all are back.
            unbroken = frame == before_frame + 1 or len(before) == len(last_seen_m)
            if not (unbroken and len(before) == len(present)):
                before = _nearest(here_m, last_seen_m)
            before_frame = frame
            last_seen_m |= zip(before, here_m, strict=True)
            for i, number in zip(present, before, strict=True):
                numbers[i] = number
    return numbers


def _nearest(here_m: Sequence[Array], last_seen_m: dict[int, Array]) -> list[int]:
    """Numbers of those in this frame: pairs by increasing distance, then new numbers."""
    pairs = [
        (float(np.linalg.norm(a - b)), i, number) for i, a in enumerate(here_m) for number, b in last_seen_m.items()
    ]
    found: dict[int, int] = {}
    for _, i, number in sorted(pairs):
        if i not in found and number not in found.values():
            found[i] = number
    new = iter(range(len(last_seen_m), len(last_seen_m) + len(here_m)))
    return [found[i] if i in found else next(new) for i in range(len(here_m))]
