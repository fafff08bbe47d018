"""What is drawn where windows show no aircraft but something else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_replay.render.distractors import Decoy, add_decoy
from sim_replay.render.other_things import KINDS, Canvas, paint

SPAN_PX = 60.0


@pytest.mark.parametrize("kind", range(len(KINDS)), ids=[draw.__name__ for draw, _ in KINDS])
def test_each_kind_is_about_as_large_as_asked_for_and_no_two_are_alike(kind: int) -> None:
    draw, _ = KINDS[kind]
    drawn = set()
    for seed in range(20):
        canvas = Canvas(160, (80.0, 80.0), SPAN_PX, 0.0, 0.2)
        draw(canvas, np.random.default_rng(seed))
        near = canvas.alpha[38:122, 38:122] > 0.1
        assert 0.4 * SPAN_PX < max(np.ptp(side) for side in np.nonzero(near)) <= 84
        drawn.add(canvas.alpha.tobytes() + canvas.colour.tobytes())
    assert len(drawn) == 20


@given(st.integers(0, 10**6), st.tuples(*[st.floats(-200.0, 300.0)] * 2), st.floats(2.0, 300.0), st.integers(24, 128))
def test_a_thing_is_drawn_wherever_it_lies_as_an_opacity_and_a_colour(
    seed: int, center_px: tuple[float, float], span_px: float, side: int
) -> None:
    canvas = paint(np.random.default_rng(seed), side, center_px, span_px)
    again = paint(np.random.default_rng(seed), side, center_px, span_px)
    np.testing.assert_array_equal(canvas.alpha, again.alpha)
    assert canvas.alpha.min() >= 0.0
    assert canvas.alpha.max() <= 1.0 + 1e-6
    assert canvas.colour.min() >= -1e-3
    assert canvas.colour[canvas.alpha > 0.01].max(initial=0.0) <= 255.0 * 1.36


def test_of_the_decoys_a_third_are_such_things() -> None:
    sky, decoy = np.full((96, 96, 3), 128, np.uint8), Decoy((48.0, 48.0), 60.0)
    things = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        rng.random()  # the kind of decoy
        thing = paint(rng, 96, decoy.center_px, decoy.span_px)
        with_it = (sky + thing.alpha[..., None] * (thing.colour - sky)).clip(0, 255).astype(np.uint8)
        things += bool((add_decoy(sky, decoy, np.random.default_rng(seed)) == with_it).all())
    assert 20 < things < 50


def test_a_thing_is_lit_from_above() -> None:
    canvas = Canvas(100, (50.0, 50.0), 80.0, 0.0, 0.3)
    canvas.ellipse((0.0, 0.0), (0.4, 0.5), np.array([100.0, 120.0, 140.0]))
    np.testing.assert_allclose(canvas.colour[[50, 20, 80], 50, 1], 120.0 * np.array([1.0, 1.225, 0.775]), rtol=0.01)
