"""The size of a scene's aircraft as its data sheet has it, for estimates that take it as given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np

from edge.estimator.given_size import TargetSize
from sim_replay.bop import BopScene, Model

SizeOf = Callable[[BopScene], TargetSize | None]


def no_size(_: BopScene) -> None:
    """Nobody gives a size."""


def sizes_of(models: Mapping[int, Model]) -> SizeOf:
    """A function from a scene to the wingspan and length of its aircraft; None if they differ in type, or if the
    dataset does not tell."""

    @cache
    def size_of(scene: BopScene) -> TargetSize | None:
        objects = {target.object_id for frame in scene.frames for target in frame.targets}
        model = models.get(objects.pop()) if len(objects) == 1 else None
        size_m = None if model is None else model.size_m
        if model is not None and size_m is None and model.points_m is not None:
            size_m = np.ptp(model.points_m, axis=0)
        return None if size_m is None else TargetSize(wingspan_m=float(size_m[1]), length_m=float(size_m[0]))

    return size_of
