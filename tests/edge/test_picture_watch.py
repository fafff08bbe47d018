"""A camera that shows nothing: covered, at night, or wrongly exposed."""

from __future__ import annotations

import numpy as np
import pytest

from edge.picture_watch import PictureWatch
from edge.types import Frame, FrameMeta

from .looping import HELD, frame
from .toy_scene import K

NOISE = np.random.default_rng(0).normal(0.0, 1.5, (270, 480, 3))
QUARTER_NS = 250_000_000


def picture(level: float, index: int) -> Frame:
    """A noisy picture of brightness `level`, four a second."""
    image = np.clip(level + NOISE, 0, 255).round().astype(np.uint8)
    return Frame(FrameMeta(index, index * QUARTER_NS, index * QUARTER_NS), image, K)


def told(watch: PictureWatch, level: float, indices: range) -> list[list[str]]:
    said = []
    for index in indices:
        watch.seen(picture(level, index))
        said.append([reason.kind for reason in watch.reasons()])
    return said


@pytest.mark.parametrize(("level", "kind"), [(0.0, "camera_dark"), (20.0, "camera_dark"), (300.0, "camera_white")])
def test_a_picture_that_shows_nothing_for_a_second_is_told_of_until_it_is_over(level: float, kind: str) -> None:
    watch = PictureWatch()
    assert told(watch, 120.0, range(8)) == [[]] * 8
    assert told(watch, level, range(8, 16)) == [[]] * 3 + [[kind]] * 5
    assert told(watch, 120.0, range(16, 24)) == [[kind]] * 3 + [[]] * 5


def test_a_single_flash_or_blink_is_nothing() -> None:
    watch = PictureWatch()
    levels = [120.0, 120.0, 0.0, 300.0] * 10
    assert [told(watch, level, range(i, i + 1)) for i, level in enumerate(levels)] == [[[]]] * 40


@pytest.mark.parametrize("level", [45.0, 230.0])
def test_dusk_and_haze_are_not_told_of(level: float) -> None:
    assert told(PictureWatch(), level, range(8)) == [[]] * 8


def test_one_bright_target_before_black_is_a_picture() -> None:
    watch = PictureWatch()
    for index in range(90):
        watch.seen(frame(index, HELD))
    assert watch.reasons() == ()
