"""The search for more targets: beside the loop, never in its way, and nothing but a place to look into."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge import threads
from edge.config import SHIPPED_MODEL
from edge.estimator.estimator import Estimator
from edge.estimator.model import load_model
from edge.search import PLACE_AGE_MAX_NS, Search
from edge.types import Estimate
from tests.waiting import until

from .looping import OTHER, Gated, box_around, frame
from .toy_model import write_toy_model

# Of a target that a larger window shows smaller, this one makes the model surer.
LOWEST = 19  # priority that the kernel knows


@pytest.fixture
def search() -> Iterator[Search]:
    search = Search()
    search.start()
    yield search
    search.stop()


@pytest.fixture
def estimator(toy_model: Path) -> Estimator:
    return Estimator(load_model(toy_model, 1))


def test_what_it_finds_is_a_place_off_the_targets_held(search: Search, estimator: Estimator) -> None:
    seen = frame(0, OTHER)
    assert search.begin(estimator, seen, [])
    until(lambda: search.counters()["searches"] == 1)
    (place,) = search.places(seen.meta.capture_ns, [], 4)
    np.testing.assert_allclose(place.box_xyxy_px, box_around(OTHER), atol=3.0)  # a third of the frame's resolution
    assert search.places(seen.meta.capture_ns, [], 4) == []  # told once

    assert search.begin(estimator, seen, [])
    until(lambda: search.counters()["searches"] == 2)
    assert search.places(seen.meta.capture_ns, [box_around(OTHER)], 4) == []  # held by now
    assert search.begin(estimator, seen, [box_around(OTHER)])
    until(lambda: search.counters()["searches"] == 3)
    assert search.places(seen.meta.capture_ns, [], 4) == []  # held when it began


def test_a_place_seen_too_long_ago_is_not_looked_into(search: Search, estimator: Estimator) -> None:
    seen = frame(0, OTHER)
    for late_ns, places in ((PLACE_AGE_MAX_NS, 1), (PLACE_AGE_MAX_NS + 1, 0)):
        before = search.counters()["searches"]
        assert search.begin(estimator, seen, [])
        until(lambda before=before: search.counters()["searches"] > before)  # type: ignore[misc]
        assert len(search.places(seen.meta.capture_ns + late_ns, [], 4)) == places


@pytest.mark.parametrize("fps", [0.5, 1.9])
def test_at_few_frames_a_second_a_place_of_the_last_two_frames_is_looked_into(
    search: Search, toy_model: Path, fps: float
) -> None:
    """The frame after is there no sooner, and a search on a slow machine may last longer than until then."""
    place = Estimate(0.9, box_around(OTHER), np.eye(3), np.array([0.0, 0.0, 200.0]), np.eye(6), "acquire")
    for frames_after, places in ((1, 1), (2, 1), (3, 0)):
        gated = Gated(load_model(toy_model, 1))
        gated.sees = [place]
        seen = frame(0, OTHER)
        at_ns = [seen.meta.capture_ns + round(index * 1e9 / fps) for index in range(4)]
        before = search.counters()["searches"]
        assert search.places(at_ns[0], [], 4) == []
        assert search.begin(gated, seen, [])
        for under_way_ns in at_ns[1:frames_after]:
            assert search.places(under_way_ns, [], 4) == []
        gated.gate.set()
        until(lambda before=before: search.counters()["searches"] > before)  # type: ignore[misc]
        assert len(search.places(at_ns[frames_after], [], 4)) == places


def test_after_a_gap_in_the_frames_a_place_from_before_it_is_not_looked_into(search: Search, toy_model: Path) -> None:
    gated = Gated(load_model(toy_model, 1))
    gated.sees = [Estimate(0.9, box_around(OTHER), np.eye(3), np.array([0.0, 0.0, 200.0]), np.eye(6), "acquire")]
    seen = frame(0, OTHER)
    assert search.places(seen.meta.capture_ns, [], 4) == []
    assert search.begin(gated, seen, [])
    gated.gate.set()
    until(lambda: search.counters()["searches"] > 0)
    assert search.places(seen.meta.capture_ns + 8_000_000_000, [], 4) == []


def test_the_model_looks_over_whole_frames_at_a_lower_priority_than_through_windows() -> None:
    before = set(os.listdir("/proc/self/task"))
    model = load_model(SHIPPED_MODEL, 3)
    begun = set(os.listdir("/proc/self/task")) - before
    own = os.getpriority(os.PRIO_PROCESS, 0)
    yielding = min(own + threads.YIELDS, LOWEST)
    priorities = sorted(os.getpriority(os.PRIO_PROCESS, int(thread)) for thread in begun)
    assert priorities == [own, own, yielding, yielding], model.path  # two beside the caller's for each kind


def test_the_search_itself_yields_to_the_loop_too(search: Search) -> None:
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "search")
    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    yielding = min(own + threads.YIELDS, LOWEST)
    until(lambda: os.getpriority(os.PRIO_PROCESS, thread.native_id or 0) == yielding)


def test_what_the_search_refuses_is_counted(search: Search, tmp_path: Path) -> None:
    near = load_model(write_toy_model(tmp_path / "near.onnx", trained_range_m=(1.0, 10.0)), 1)
    seen = frame(0, OTHER)
    assert search.begin(Estimator(near), seen, [])
    until(lambda: search.counters()["searches"] == 1)
    assert search.places(seen.meta.capture_ns, [], 4) == []
    assert search.counters()["refused_out_of_range"] == 1


@pytest.mark.usefixtures("stepped")
def test_in_lock_step_what_is_searched_for_is_found_at_once(estimator: Estimator) -> None:
    search, seen = Search(), frame(0, OTHER)
    search.start()
    assert search.begin(estimator, seen, [])
    (place,) = search.places(seen.meta.capture_ns, [], 4)
    np.testing.assert_allclose(place.box_xyxy_px, box_around(OTHER), atol=3.0)


def test_a_search_that_fails_is_counted_and_the_next_one_does(search: Search, gated: Gated) -> None:
    gated.sees = RuntimeError("out of memory")
    gated.gate.set()
    assert search.begin(gated, frame(0, OTHER), [])
    until(lambda: search.counters().get("search_failed") == 1)
    assert "search" in threads.running()
    gated.sees = []
    until(lambda: search.begin(gated, frame(1, OTHER), []))
    until(lambda: search.counters()["searches"] == 2)
    assert search.counters()["search_failed"] == 1


@pytest.mark.usefixtures("stepped")
def test_in_lock_step_a_search_that_fails_ends_the_replay(gated: Gated) -> None:
    gated.sees = RuntimeError("out of memory")
    gated.gate.set()
    search = Search()
    search.start()
    with pytest.raises(RuntimeError, match="out of memory"):
        search.begin(gated, frame(0, OTHER), [])


def test_one_search_at_a_time(search: Search, gated: Gated) -> None:
    assert search.begin(gated, frame(0, OTHER), [])
    assert gated.begun.wait(60)
    assert not search.begin(gated, frame(1, OTHER), [])
    gated.gate.set()
    until(lambda: search.begin(gated, frame(2, OTHER), []))
