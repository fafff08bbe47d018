"""The size of a scene's aircraft as its data sheet has it, for estimates that take it as given."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

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
        if model is None or model.size_m is None or min(model.size_m[:2]) <= 0.0:
            return None
        length_m, wingspan_m, _ = model.size_m
        return TargetSize(wingspan_m, length_m)

    return size_of
