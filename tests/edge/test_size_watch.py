"""A size in [target] that what is seen contradicts: when it is told of, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge.config import load_config
from edge.daemon import Pipeline
from edge.size_watch import SizeWatch
from edge.types import PROBABLE_SCORE, Estimate
from tests.waiting import until

from .looping import HELD, Gated, frame, looping

PERIOD_NS = 33_000_000


def estimate(oversize: float | None, score: float) -> Estimate:
    t_m = np.array([0.0, 0.0, 300.0])
    return Estimate(score, np.array([0.0, 0.0, 90.0, 30.0]), np.eye(3), t_m, np.eye(6), "track", oversize)


def sights(
    watch: SizeWatch,
    oversizes: list[float | None],
    *,
    score: float = 0.9,
    doubtful_below: float = PROBABLE_SCORE,
    first: int = 0,
    period_ns: int = PERIOD_NS,
) -> list[str]:
    """What is told of after these sights, the first of which is in that frame."""
    for index, oversize in enumerate(oversizes, start=first):
        watch.seen(index * period_ns, [estimate(oversize, score)], doubtful_below)
    return [reason.text for reason in watch.reasons((first + len(oversizes)) * period_ns)]


def test_a_size_that_most_of_what_is_seen_contradicts_is_told_of_until_it_is_over() -> None:
    watch = SizeWatch()
    assert sights(watch, [0.31] * 6 + [None] * 4) == ["the target appears to be 0.31 times as large as [target] says"]
    assert watch.reasons(4_000_000_000) == (), "not seen for three seconds"
    assert sights(SizeWatch(), [2.0, 3.0, 8.0, 3.0, 4.0]) != sights(SizeWatch(), [8.0] * 5), "the median, no outlier"
    assert sights(SizeWatch(), [0.31] * 5 + [None] * 5) == [], "one of two aircraft is of another type"
    assert sights(SizeWatch(), [3.0] * 4) == [], "too few to say"
    assert sights(SizeWatch(), [3.0] * 10, score=0.5) == [], "birds"


def test_scores_that_are_no_probabilities_count_like_all_that_is_sent() -> None:
    assert sights(SizeWatch(), [3.0] * 10, score=0.5, doubtful_below=0.0) != []


def test_a_size_contradicted_in_every_other_second_is_told_of_once() -> None:
    """Of the last three seconds that is a third, then two, and so on; each change would be announced over the radio."""
    watch = SizeWatch()
    seconds = [[3.0 if second % 2 else None] * 30 for second in range(20)]
    told = [sights(watch, oversizes, first=30 * second) != [] for second, oversizes in enumerate(seconds)]
    assert told == [False] * 3 + [True] * 17
    assert sights(watch, [3.0, None, None, None, None] * 18, first=600) == [], "one in five is no more than an outlier"


@pytest.mark.parametrize("period_s", [0.7, 1.0, 1.9])
def test_a_camera_of_rare_frames_tells_of_a_wrong_size_too(period_s: float) -> None:
    watch, period_ns = SizeWatch(), round(period_s * 1e9)
    assert sights(watch, [0.31] * 4, period_ns=period_ns) == [], "too few to say"
    told = sights(watch, [0.31] * 3, first=4, period_ns=period_ns)
    assert told == ["the target appears to be 0.31 times as large as [target] says"]
    assert sights(watch, [None] * 6, first=7, period_ns=period_ns) == []


TOO_LARGE = "[target]\nwingspan_m = 60.0\nlength_m = 40.0\n"


@pytest.fixture
def flown(gated: Gated, toy_model: Path, tmp_path: Path) -> Iterator[tuple[Pipeline, Path]]:
    """A loop, and its configuration."""
    path = tmp_path / "config.toml"
    path.write_text(f'[camera]\ntype = "sequence"\npath = "scene"\n[model]\npath = "{toy_model}"\nthreads = 1\n')
    with looping(gated) as (loop, _, _):
        loop._board.file = load_config(path)
        yield loop, path


def reload(loop: Pipeline, path: Path, text: str) -> None:
    path.write_text(text)
    before = loop._board.file
    loop._reloader.ask()
    until(lambda: loop._board.file is not before, loop._take_reload, what="the new configuration")


def told_of(loop: Pipeline, frames: range) -> list[str]:
    for index in frames:
        loop._process(frame(index, HELD))
    return [reason.kind for reason in loop._reasons(frame(frames.stop, HELD).meta.capture_ns)]


@pytest.mark.parametrize("more", ["", "[target]\nwingspan_m = 15.0\nlength_m = 10.0\n"])
def test_once_the_size_is_corrected_or_taken_back_the_old_one_is_told_of_no_more(
    flown: tuple[Pipeline, Path], more: str
) -> None:
    loop, path = flown
    text = path.read_text()
    assert told_of(loop, range(10)) == [], "no size is given"
    reload(loop, path, text + TOO_LARGE)
    assert told_of(loop, range(10, 20)) == ["target_size"]
    reload(loop, path, text + TOO_LARGE + "[health]\nlatency_max_ms = 500.0\n")
    assert told_of(loop, range(20, 20)) == ["target_size"], "as before"
    reload(loop, path, text + more)
    assert told_of(loop, range(20, 20)) == [], "at once"
    assert told_of(loop, range(20, 30)) == []
