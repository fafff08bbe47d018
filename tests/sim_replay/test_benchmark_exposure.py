"""No sequence is blown out, whatever gain was drawn for its camera; one that is well exposed is left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim_replay.benchmark.exposure import metered
from sim_replay.benchmark.filming import Film, fly
from sim_replay.benchmark.plan import plan_dataset
from sim_replay.benchmark.preset import parse_preset
from sim_replay.render.frame import render_frame

PRESET = parse_preset(
    "small.toml",
    """
name = "small"
size_wh_px = [240, 136]
sequence_frames = [2, 4]
splits = { test = { sequences = 1, frames = 3 } }
lens = { focal_px = [200, 1000] }
picture = { weather = { overcast = 1 }, quality = { ordinary = 1 } }
""",
)


def _film(gain: float) -> Film:
    plan = plan_dataset(PRESET, 2)[0]
    film = fly(plan, PRESET, plan.focal_px)
    return replace(film, sensor=replace(film.sensor, gain=gain))


def _white_share(film: Film) -> float:
    return float(np.mean(render_frame(film.scene(0), film.sensor).image_bgr.min(axis=2) >= 250))


def test_a_blown_out_sequence_is_exposed_again() -> None:
    film = _film(gain=3.0)
    assert _white_share(film) > 0.5
    assert _white_share(metered(film)) <= 0.2


def test_a_well_exposed_sequence_stays_as_it_was_drawn() -> None:
    film = _film(gain=0.7)
    assert metered(film).sensor == film.sensor
