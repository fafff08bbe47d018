"""The exposure of a sequence: metered so that highlights may saturate, but not the whole image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim_replay.benchmark.filming import Film
from sim_replay.render.frame import render_frame

WHITE_FROM = 250  # of 255, in all three channels
BLOWN_SHARE_MAX = 0.2
GAIN_STEP = 0.85
STEPS_MAX = 8


def metered(film: Film) -> Film:
    """The film with its sensor's gain reduced until its first frame is not overexposed; dark frames stay dark."""
    for _ in range(STEPS_MAX):
        white = render_frame(film.scene(0), film.sensor).image_bgr.min(axis=2) >= WHITE_FROM
        if float(np.mean(white)) <= BLOWN_SHARE_MAX:
            break
        film = replace(film, sensor=replace(film.sensor, gain=GAIN_STEP * film.sensor.gain))
    return film
