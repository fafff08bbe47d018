"""The loop with the search beside it: what is found becomes a track, and what is none takes no place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.daemon import Pipeline
from edge.estimator.decode import lies_on
from edge.estimator.lens import Lens
from edge.estimator.model import load_model
from edge.requests import RequestQueue, StopTracking, TrackBox
from edge.types import Array, Estimate, Frame, FrameMeta, TrackState
from msgs.contract import ScoreCalibration
from tests.waiting import until

from .looping import HELD, OTHER, PERIOD_NS, Ear, Gated, box_around, frame, looping
from .toy_scene import SIZE_WH, K, draw

# Of a target that a larger window shows smaller, this one makes the model surer.
SURER_OF_SMALL = ScoreCalibration(offset=1.5, slope=0.2, size_slope=-0.5, size_cap_px=1000.0)
BESIDE_PX = np.array([10.5, -89.5, 190.5, 90.5])  # of a target's middle: a larger box that does not lie on its own


@pytest.fixture
def pipeline(gated: Gated) -> Iterator[tuple[Pipeline, Ear, RequestQueue]]:
    with looping(gated) as told:
        yield told


def test_poses_go_out_while_the_search_is_under_way_and_what_it_finds_becomes_a_track(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated
) -> None:
    loop, ear, _ = pipeline
    for index in range(20):
        loop._process(frame(index, HELD))
    until(gated.begun.is_set, what="the search")
    assert loop.search.counters()["searches"] == 0  # still at it
    assert [len(report.tracks) for report in ear.reports] == [1] * 20

    (estimate,) = [e for e in gated.track(frame(20, HELD, OTHER), [box_around(OTHER)]) if e]
    gated.sees = [estimate]
    gated.gate.set()
    until(lambda: loop.search.counters()["searches"] == 1)
    gated.sees = []
    for index in range(20, 24):
        loop._process(frame(index, HELD, OTHER))
    assert len(ear.reports[-1].tracks) == 2
    np.testing.assert_allclose(ear.reports[-1].tracks[1].box_xyxy_px, box_around(OTHER), atol=3.0)


def test_a_second_target_is_found_beside_a_first_at_one_frame_a_second(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated
) -> None:
    loop, ear, _ = pipeline
    gated.sees = [e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e]
    gated.gate.set()
    for index in range(6):
        loop._process(frame(30 * index, HELD, OTHER) if index == 5 else frame(30 * index, HELD))
    until(lambda: loop.search.counters()["searches"] == 1)
    assert [len(report.tracks) for report in ear.reports] == [1] * 6
    loop._process(frame(180, HELD, OTHER))
    assert len(ear.reports[-1].tracks) == 2


def test_a_target_that_has_left_its_window_is_looked_for_in_that_same_frame(
    pipeline: tuple[Pipeline, Ear, RequestQueue],
) -> None:
    """Five pictures a second: it crosses by more than its window before anybody can know how fast it is."""
    loop, ear, _ = pipeline
    for index in range(5):
        loop._process(frame(6 * index, (300.5 + 300 * index, 420.5)))
    assert [len(report.tracks) for report in ear.reports] == [1] * 5
    track = ear.reports[-1].tracks[0]
    assert (track.state, track.measured_ns) == (TrackState.CONFIRMED, ear.reports[-1].meta.capture_ns)


def test_stamps_that_jump_teach_no_speed(pipeline: tuple[Pipeline, Ear, RequestQueue]) -> None:
    """The target creeps by 8 px a frame; stamps a millisecond apart make it fly by 1,900 m/s and then vanish."""
    loop, ear, _ = pipeline
    for index in range(8):
        time_ns = 1_000_000_000 + index * 1_000_000
        meta = FrameMeta(index, time_ns, time_ns, time_jumps=index)
        loop._process(Frame(meta, draw((HELD[0] + 8 * index, HELD[1])), K))
    (held,) = ear.reports[-1].tracks
    empty = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    for index in range(10):
        time_ns = 1_050_000_000 + index * PERIOD_NS
        loop._process(Frame(FrameMeta(8 + index, time_ns, time_ns, time_jumps=7), empty, K))
    (coasting,) = ear.reports[-1].tracks
    assert coasting.state is TrackState.COASTING
    away_m = np.abs(coasting.t_cam_target_m - held.t_cam_target_m)
    assert np.all(away_m <= 3.0 * np.sqrt(np.diag(coasting.covariance)[:3]))
    assert away_m.max() < 1.0, "nothing true was learnt of its speed"


def test_a_target_that_is_missed_is_looked_for_and_told_where_the_lens_would_show_it(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It flies outwards, across the sight line, by 16 px a frame of a camera without the lens."""
    loop, ear, _ = pipeline
    lens = Lens(K, (-0.5, 0.0, 0.0, 0.0))
    looked_into: list[Array] = []
    look = gated.track

    def listening(frame: Frame, boxes: Sequence[Array], twice: Sequence[bool] = ()) -> list[Estimate | None]:
        looked_into[:] = boxes
        return look(frame, boxes, twice)

    monkeypatch.setattr(gated, "track", listening)

    def center(index: int) -> Array:
        return lens.to_frame(np.array([1259.5 + 16.0 * index, 539.5]))

    empty = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    for index in range(32):
        picture = draw((center(index)[0], center(index)[1])) if index < 20 else empty
        loop._process(replace(frame(index, HELD), image_bgr=picture, distortion=lens.distortion))
    (coasting,) = ear.reports[-1].tracks
    assert coasting.state is TrackState.COASTING
    np.testing.assert_allclose(looked_into, [coasting.box_xyxy_px], atol=1e-6)
    told = 0.5 * (coasting.box_xyxy_px[:2] + coasting.box_xyxy_px[2:])
    np.testing.assert_allclose(told, center(31), atol=12.0)


def test_a_place_that_the_window_does_not_make_likely_enough_is_no_target(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated
) -> None:
    """The toy is as sure as can be of what it sees, the whole frame nearly that there is nothing: two to one."""
    loop, ear, _ = pipeline
    gated.model.contract = gated.model.contract.model_copy(update={"acquire_score_min": 0.8})
    (estimate,) = [e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e]
    gated.sees = [replace(estimate, score=0.01)]
    gated.gate.set()
    for index in range(8):
        loop._process(frame(index, HELD))
    until(lambda: loop.search.counters()["searches"] >= 1)
    for index in range(8, 12):
        loop._process(frame(index, HELD, OTHER))
    assert [len(report.tracks) for report in ear.reports] == [1] * 12


def test_a_place_where_the_window_sees_nothing_is_no_target(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated
) -> None:
    loop, ear, _ = pipeline
    (estimate,) = [e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e]
    gated.sees = [estimate]
    gated.gate.set()
    for index in range(8):
        loop._process(frame(index, HELD))
    until(lambda: loop.search.counters()["searches"] == 1)
    loop._process(frame(8, HELD))
    assert [len(report.tracks) for report in ear.reports] == [1] * 9


def test_a_person_s_stop_holds_against_a_search_under_way(
    pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated
) -> None:
    loop, ear, requests = pipeline
    for index in range(8):
        loop._process(frame(index, HELD))
    assert gated.begun.wait(60)
    (estimate,) = [e for e in gated.track(frame(8, HELD), [box_around(HELD)]) if e]
    requests.put(StopTracking())
    loop._process(frame(8, HELD))
    gated.sees = [estimate]
    gated.gate.set()
    until(lambda: loop.search.counters()["searches"] == 1)
    for index in range(9, 14):
        loop._process(frame(index, HELD))
    assert [len(report.tracks) for report in ear.reports[8:]] == [0] * 6


def test_pointing_beside_a_target_that_is_held_chooses_it_and_throws_none_out(gated: Gated) -> None:
    """The window that is pointed at is larger, so it shows the target smaller."""
    gated.model.contract = gated.model.contract.model_copy(update={"track_score": SURER_OF_SMALL})
    with looping(gated, max_targets=2) as (loop, ear, requests):
        gated.sees = [e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e]
        gated.gate.set()
        for index in range(6):
            loop._process(frame(index, HELD))
        until(lambda: loop.search.counters()["searches"] == 1)
        for index in range(6, 12):
            loop._process(frame(index, HELD, OTHER))
        before = ear.reports[-1].tracks
        assert [track.state for track in before] == [TrackState.CONFIRMED] * 2

        left, top, right, bottom = ((np.tile(OTHER, 2) + BESIDE_PX) / np.tile(SIZE_WH, 2)).tolist()
        requests.put(TrackBox((left, top, right, bottom)))
        for index in range(12, 15):
            loop._process(frame(index, HELD, OTHER))
    held = [(TrackState.CONFIRMED, track.born_ns) for track in before]
    for report in ear.reports[-3:]:
        assert [(track.state, track.born_ns) for track in report.tracks] == held
        assert report.chosen_id == before[1].track_id


def test_a_false_place_beside_a_target_that_is_held_takes_no_sight_of_it_away(gated: Gated) -> None:
    """The window around the place shows the target better than its own; the place itself is as good as nothing."""
    gated.model.contract = gated.model.contract.model_copy(update={"track_score": SURER_OF_SMALL})
    with looping(gated, max_targets=3) as (loop, ear, _):
        (seen,) = gated.sees = [e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e]
        gated.gate.set()
        for index in range(6):
            loop._process(frame(index, HELD))
        until(lambda: loop.search.counters()["searches"] == 1)
        gated.sees = [replace(seen, score=0.01, box_xyxy_px=np.tile(OTHER, 2) + BESIDE_PX)]
        for index in range(6, 12):
            loop._process(frame(index, HELD, OTHER))
        until(lambda: loop.search.counters()["searches"] == 2)
        for index in range(12, 15):
            loop._process(frame(index, HELD, OTHER))
    for report in ear.reports[8:]:
        assert [track.measured_ns for track in report.tracks] == [report.meta.capture_ns] * 2


def test_where_there_is_room_for_one_more_a_likelier_false_place_hides_no_target(gated: Gated) -> None:
    with looping(gated, max_targets=2) as (loop, ear, _):
        (real,) = (e for e in gated.track(frame(0, OTHER), [box_around(OTHER)]) if e)
        cloud = replace(real, score=0.99, box_xyxy_px=box_around((1100.5, 200.5)))
        gated.sees = [cloud, replace(real, score=0.9)]
        gated.gate.set()
        for index in range(6):
            loop._process(frame(index, HELD))
        until(lambda: loop.search.counters()["searches"] == 1)
        for index in range(6, 10):
            loop._process(frame(index, HELD, OTHER))
    assert [track.state for track in ear.reports[-1].tracks] == [TrackState.CONFIRMED] * 2


class Doubting(Gated):
    """Takes what flies at HELD for a bird."""

    def track(self, frame: Frame, boxes_xyxy_px: Sequence[Array], twice: Sequence[bool] = ()) -> list[Estimate | None]:
        seen = super().track(frame, boxes_xyxy_px, twice)
        bird = box_around(HELD)
        return [one and (replace(one, score=0.6) if lies_on(one.box_xyxy_px, [bird]) else one) for one in seen]


def test_a_bird_in_the_only_slot_hides_no_aircraft(toy_model: Path) -> None:
    doubting = Doubting(load_model(toy_model, 1), 1)
    doubting.model.contract = doubting.model.contract.model_copy(update={"track_score": ScoreCalibration(offset=0.01)})
    with looping(doubting, max_targets=1) as (loop, ear, _):
        doubting.sees = [e for e in doubting.track(frame(0, OTHER), [box_around(OTHER)]) if e]
        doubting.gate.set()
        for index in range(6):
            loop._process(frame(index, HELD))
        assert [track.score < 0.8 for track in ear.reports[-1].tracks] == [True]
        until(lambda: loop.search.counters()["searches"] == 1)
        for index in range(6, 10):
            loop._process(frame(index, HELD, OTHER))
    (track,) = ear.reports[-1].tracks
    assert track.state is TrackState.CONFIRMED
    assert lies_on(track.box_xyxy_px, [box_around(OTHER)])


def test_the_diagnostics_count_searches(pipeline: tuple[Pipeline, Ear, RequestQueue], gated: Gated) -> None:
    loop, _, _ = pipeline
    gated.gate.set()
    for index in range(12):
        loop._process(frame(index, HELD))
    until(lambda: loop.supervisor.snapshot().counters["searches"] >= 1)
