"""Renderers that do something else than `synthetic_sampler.PlateSampler`, for one test each.

They are in a file of their own since each rendering process imports it, and torch, which the tests import, takes longer
than all that such a process does for them.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from synthetic_sampler import PlateSampler

from sim_replay.airframes import AIRFRAMES
from sim_replay.sample import SampleBatch
from trainer.data import TrainingBatch, training_batch

GOOD_SAMPLES = 8  # of a SpoiltSampler
LARGE_PX = 256  # a batch of such pictures is far more than a pipe holds


class Filling(PlateSampler):
    """Boxes as large as the picture, so that an untrained network's peak lies in them; every third is a stranger."""

    def batch(self, first_index: int, count: int) -> SampleBatch:
        batch = super().batch(first_index, count)
        box = np.tile(np.array([0, 0, self.size_px, self.size_px], np.float32), (count, 1))
        strange = np.where((first_index + np.arange(count)) % 3 == 0, len(AIRFRAMES) + 5, batch.airframe_id)
        return replace(batch, box_xyxy_px=box, airframe_id=strange.astype(np.int32))


class PartlyEmpty:
    """Of six windows the fifth is empty, and the sixth but for an aircraft that has no labels."""

    def __init__(self, seed: int, size_px: int) -> None:
        self.filled = Filling(seed, size_px, 0.0)

    def batch(self, first_index: int, count: int) -> TrainingBatch:
        batch = training_batch(self.filled.batch(first_index, count))
        kind = (first_index + np.arange(count)) % 6
        return batch._replace(present=kind < 4, others=batch.others | (kind == 5)[:, None, None])


class NoTargets(PlateSampler):
    def batch(self, first_index: int, count: int) -> SampleBatch:
        batch = super().batch(first_index, count)
        return replace(batch, present=batch.present & False)


class SpoiltSampler(PlateSampler):
    """From GOOD_SAMPLES on a position is no number."""

    def batch(self, first_index: int, count: int) -> SampleBatch:
        made = super().batch(first_index, count)
        if first_index < GOOD_SAMPLES:
            return made
        return replace(made, t_cam_target_m=np.full_like(made.t_cam_target_m, np.nan))


class Telling(PlateSampler):
    """Says, by a file, that it was asked for its third batch."""

    def __init__(self, told: Path) -> None:
        super().__init__(5, LARGE_PX)
        self.told = told

    def batch(self, first_index: int, count: int) -> SampleBatch:
        if first_index >= 2 * count:
            self.told.touch()
        return super().batch(first_index, count)


class Broken(PlateSampler):
    def batch(self, first_index: int, count: int) -> SampleBatch:
        if first_index:
            raise ZeroDivisionError("no such aircraft")
        return super().batch(first_index, count)


def opened_with_a_warning() -> PlateSampler:
    logging.getLogger("dataset").warning("two pictures are missing")
    return PlateSampler(5, 64)
