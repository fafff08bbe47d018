"""The lens of every sequence: planned from airframe and range, then adjusted to the flown aspect of the target.

A plan only knows an airframe's mean size; the flown aspect makes it larger or smaller. Flying takes a fraction of the
time that rendering does, so all sequences are flown first and all lenses set together: the mean share of the image
covered by the main target's box is then the preset's, over all frames of the dataset.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from edge.errors import InputError
from sim_replay.benchmark.crew import Stopped, Tell, crew
from sim_replay.benchmark.filming import encounter_plan, mean_box_area, pointing_focal_px
from sim_replay.benchmark.plan import SequencePlan
from sim_replay.benchmark.preset import Preset
from sim_replay.benchmark.scene_store import replace_text
from sim_replay.flight import fly_encounter

FILE = "lenses.json"


def settle_lenses(preset: Preset, plans: Sequence[SequencePlan], areas: Sequence[float]) -> dict[int, float]:
    """Focal length, px, of each sequence by its index.

    Args:
        areas: Area of each main target's box at focal length 1, averaged over its frames.

    Each lens shows its target as large as planned, times a common factor found by bisection; none is longer than what
    the camera was pointed for, so a target that was kept in the image stays in it.
    """
    picture = float(preset.size_wh_px[0] * preset.size_wh_px[1])
    area, frames = np.asarray(areas), np.array([plan.frames for plan in plans], dtype=np.float64)
    wanted = np.sqrt(np.array([plan.box_share for plan in plans]) * picture / area)
    longest = np.array([pointing_focal_px(plan, preset) for plan in plans])
    shown = np.array([plan.shown > 0 for plan in plans])
    weight = np.where(shown, frames, 0.0) / max(float(frames[shown].sum()), 1.0)
    low, high = 0.1, 10.0
    for _ in range(60):
        factor = 0.5 * (low + high)
        focal = np.clip(factor * wanted, preset.lens.focal_px[0], longest)
        share = float(weight @ (np.square(focal) * area)) / picture
        low, high = (factor, high) if share < preset.lens.box_share else (low, factor)
    return {plan.index: round(float(f), 2) for plan, f in zip(plans, focal, strict=True)}


def box_area(preset: Preset, plan: SequencePlan, tell: Tell, stopped: Stopped) -> float:
    """A crew's task: fly a sequence, measure its main target's box at focal length 1. Raises FlightError."""
    return mean_box_area(fly_encounter(encounter_plan(plan, preset)))


def lenses_of(
    folder: Path, preset: Preset, plans: Sequence[SequencePlan], workers: int, on_flown: Callable[[], None]
) -> dict[int, float]:
    """The focal lengths stored in `folder`; if there are none, every plan is flown and they are stored.

    Raises InputError if the stored file does not match these plans, and CrewError.
    """
    path = folder / FILE
    if path.is_file():
        return _read(path, plans)
    areas = [0.0] * len(plans)
    for said in crew(partial(box_area, preset), plans, workers):
        areas[said.task] = said.value
        on_flown()
    focal_px = settle_lenses(preset, plans, areas)
    replace_text(path, json.dumps(focal_px, indent=0) + "\n")
    return focal_px


def _read(path: Path, plans: Sequence[SequencePlan]) -> dict[int, float]:
    try:
        focal_px = {int(key): float(value) for key, value in json.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if set(focal_px) != {plan.index for plan in plans}:
        raise InputError(f"{path}: does not hold the {len(plans)} sequences of the preset")
    return focal_px
