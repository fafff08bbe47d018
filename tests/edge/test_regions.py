"""Regions of a frame that are searched: the whole and its tiles, what a tile shows, and in which order they come."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.estimator.estimator import Estimator
from edge.estimator.lens import lens_of
from edge.estimator.model import load_model
from edge.estimator.pace import Pace
from edge.estimator.regions import OVERLAP, TILE_REDUCTION, Region, Sweep, tiles, whole
from edge.estimator.window import fit_frame, whole_frame
from edge.search import Search
from edge.types import Frame, FrameMeta

from .looping import Gated, looping
from .toy_model import write_toy_model
from .toy_scene import FAINT_XYXY, SIZE_WH, K, draw_faint

NETWORK_WH = (768, 448)
BARREL = (-0.25, 0.06, 0.0, 0.0)


def faint(index: int = 0) -> Frame:
    """What `draw_faint` draws, as the camera's frame."""
    time_ns = 1_000_000_000 + index * 33_000_000
    return Frame(FrameMeta(index, time_ns, time_ns), draw_faint(), K)


@given(
    frame_wh=st.tuples(st.integers(64, 8000), st.integers(64, 5000)),
    aspect=st.sampled_from([1.0, 0.5, 2.0]),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_what_is_smaller_than_the_overlap_lies_whole_in_a_tile(
    frame_wh: tuple[int, int], aspect: float, at: tuple[float, float]
) -> None:
    regions = tiles(frame_wh, NETWORK_WH, None, aspect)
    frame = whole(frame_wh).window
    reduction = max(frame.width / NETWORK_WH[0], frame.height * aspect / NETWORK_WH[1])
    if reduction < TILE_REDUCTION:
        assert not regions, "the whole is as fine"
    if not regions:
        assert reduction <= 1.3 * TILE_REDUCTION
        return
    assert sum(region.share for region in regions) == pytest.approx(1.0)
    assert len(regions) <= 16
    windows = [region.window for region in regions]
    size = np.array([windows[0].width, windows[0].height])
    assert max(size[0] / NETWORK_WH[0], size[1] * aspect / NETWORK_WH[1]) < 0.81 * reduction, "finer"
    side = np.minimum(np.floor(OVERLAP * size) - 2, np.array(frame_wh))
    first = np.floor(np.array(at) * (np.array(frame_wh) - side))
    assert any(
        window.left <= first[0]
        and window.top <= first[1]
        and first[0] + side[0] <= window.left + window.width
        and first[1] + side[1] <= window.top + window.height
        for window in windows
    )
    for window in windows:
        assert 0 <= window.left <= frame_wh[0] - window.width
        assert 0 <= window.top <= frame_wh[1] - window.height


def test_a_frame_of_1080p_has_four_tiles_and_one_of_720p_none() -> None:
    four = tiles((1920, 1080), NETWORK_WH, None, 1.0)
    assert [(w.left, w.top, w.width, w.height) for w, _ in four] == [
        (0, 0, 1229, 717),
        (691, 0, 1229, 717),
        (0, 363, 1229, 717),
        (691, 363, 1229, 717),
    ]
    assert tiles((1280, 720), NETWORK_WH, None, 1.0) == ()


@pytest.mark.parametrize("distortion", [(), BARREL])
def test_a_point_of_a_tile_goes_through_its_pixels_and_back_within_a_hundredth(distortion: tuple[float, ...]) -> None:
    lens = lens_of(K, distortion)
    image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    regions = tiles(SIZE_WH, NETWORK_WH, lens, 1.0)
    assert len(regions) >= 4
    for region in regions:
        _, to_network = fit_frame(image, NETWORK_WH, "letterbox", lens, 1.0, region.window)
        K_tile = to_network.intrinsics(K)
        corners = np.array([[40.0, 40.0], [700.0, 60.0], [384.0, 224.0], [60.0, 400.0]])
        rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(K_tile).T
        pinhole = (rays @ K.T)[:, :2]
        on_frame = pinhole if lens is None else lens.to_frame(pinhole)
        np.testing.assert_allclose(to_network.to_network(on_frame), corners, atol=0.01)


def test_a_tile_shows_its_part_of_the_frame_and_no_more() -> None:
    image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    image[:, :, 0] = (np.arange(SIZE_WH[0]) // 8)[None, :]
    image[:, :, 1] = (np.arange(SIZE_WH[1]) // 8)[:, None]
    for window, _ in tiles(SIZE_WH, NETWORK_WH, None, 1.0):
        shown, to_network = fit_frame(image, NETWORK_WH, "letterbox", None, 1.0, window)
        for point in np.array([[2.0, 2.0], [765.0, 2.0], [400.0, 200.0], [765.0, 445.0]]):
            column, row = to_network.to_frame(point)
            blue, green, _ = shown[int(point[1]), int(point[0])]
            assert abs(int(blue) - column / 8) <= 1.5
            assert abs(int(green) - row / 8) <= 1.5


def test_a_peak_in_one_of_four_tiles_has_a_quarter_of_the_odds() -> None:
    quarter = Region(whole_frame(SIZE_WH), 0.25)
    assert quarter.probability(0.9) == pytest.approx(9 / 13)  # 9 : 1 becomes 9 : 4
    assert quarter.probability(0.0) == 0.0
    assert quarter.probability(1.0) == 1.0
    assert quarter.score_of(quarter.probability(0.37)) == pytest.approx(0.37)
    assert whole(SIZE_WH).probability(0.37) == pytest.approx(0.37)


def test_the_whole_frame_comes_every_other_time_and_each_tile_in_turn() -> None:
    regions = [whole(SIZE_WH), *tiles(SIZE_WH, NETWORK_WH, None, 1.0)]

    def order(sweep: Sweep, counts: list[int]) -> list[list[int]]:
        return [[regions.index(region) for region in sweep.next(regions, count)] for count in counts]

    assert order(Sweep(), [1] * 9) == [[0], [1], [0], [2], [0], [3], [0], [4], [0]]
    assert order(Sweep(), [3, 3, 1, 1]) == [[0, 1, 2], [0, 3, 4], [1], [0]]
    assert order(Sweep(), [5, 9]) == [[0, 1, 2, 3, 4], [0, 1, 2, 3, 4]], "none twice"
    assert Sweep().next(regions[:1], 4) == regions[:1]
    small = Sweep()
    assert [small.next(regions[:1]) for _ in range(3)] == [regions[:1]] * 3


@pytest.mark.parametrize(("fps", "regions"), [(60, 1), (30, 1), (10, 1), (5, 3), (1, 16)])
def test_a_slow_camera_leaves_time_for_more_regions(fps: int, regions: int) -> None:
    pace = Pace()
    pace.unhurried(FrameMeta(0, 0, 0))
    assert pace.regions() == 1, "who knows"
    pace.unhurried(FrameMeta(1, 1_000_000_000 // fps, 0))
    assert pace.regions() == regions


def test_a_camera_that_was_lost_is_no_slow_one() -> None:
    """To search all regions of its first frame, of 4K seventeen, would take seconds, and all that is found be stale."""
    pace = Pace()
    for k, time_ns in enumerate((0, 33_000_000, 5_033_000_000, 5_066_000_000)):
        pace.unhurried(FrameMeta(k, time_ns, time_ns))
        assert pace.regions() == 1


def test_a_target_that_the_whole_frame_does_not_show_is_found_in_a_tile(toy_model: Path) -> None:
    estimator, seen = Estimator(load_model(toy_model, 1)), faint()
    assert estimator.acquire(seen) == []
    regions = estimator.regions(seen)
    (found,) = estimator.acquire(seen, regions=regions)
    x0, y0, x1, y1 = FAINT_XYXY
    centre = (found.box_xyxy_px[:2] + found.box_xyxy_px[2:]) / 2
    np.testing.assert_allclose(centre, [(x0 + x1 - 1) / 2, (y0 + y1 - 5) / 2], atol=2.0)
    holding = [estimator.acquire(seen, regions=[region]) != [] for region in regions]
    assert holding == [*[False] * (len(regions) - 1), True]


def test_a_model_without_track_stage_searches_whole_frames_alone(tmp_path: Path) -> None:
    """Nothing would confirm what a tile shows, and that model's pose is of this very image."""
    single = write_toy_model(tmp_path / "single.onnx", track_size_wh=None)
    estimator = Estimator(load_model(single, 1))
    assert estimator.regions(faint()) == (whole(SIZE_WH),)


def test_the_loop_and_the_search_beside_it_take_the_regions_in_turn(toy_model: Path) -> None:
    gated = Gated(load_model(toy_model, 1))
    last = 2 * len(gated.regions(faint())) - 3  # the last tile; before each tile comes the whole frame
    with looping(gated) as (pipeline, ear, _):
        for index in range(last + 1):
            pipeline._process(faint(index))
    assert [len(report.tracks) for report in ear.reports] == [0] * last + [1]

    estimator, search = Estimator(load_model(toy_model, 1)), Search()  # not started: it runs in the caller's thread
    found = []
    for _ in range(last + 2):
        assert search.begin(estimator, faint(), [])
        found.append(len(search.places(faint().meta.capture_ns, [], 4)))
    assert found == [*[0] * last, 1, 0]
