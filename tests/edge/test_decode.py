"""From the network's outputs to estimates: what is told, how sure it is, and what is refused."""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.estimator.decode import Shown, decode, nearest_expected, pose_covariance
from edge.estimator.model import Peaks
from edge.estimator.window import PixelMap
from edge.tracking.boxes import overlap
from edge.types import Estimate
from msgs.contract import ModelContract

from .test_estimator import boxes, points, project
from .toy_model import CONTRACT
from .toy_scene import SIZE_WH, K

WHOLE = Shown(PixelMap((1, 1), (0, 0)), K, SIZE_WH, SIZE_WH)  # the frame as it is


@given(points, st.floats(0.1, 3), st.floats(0.1, 3), st.floats(0.01, 0.2))
def test_covariance_is_what_sampling_the_uncertainty_gives(t_m: np.ndarray, su: float, sv: float, slz: float) -> None:
    sigma = np.array([su, sv, slz, 0.1, 0.2, 0.3])
    covariance = pose_covariance(t_m, sigma, K)
    # Derivatives of t = Z K^-1 [u, v, 1] by central differences, as an independent way to the same matrix.
    u, v = project(K, t_m)

    def t_of(du: float, dv: float, dlz: float) -> np.ndarray:
        return t_m[2] * np.exp(dlz) * np.linalg.inv(K) @ [u + du, v + dv, 1.0]

    step = 1e-4
    J = np.column_stack([(t_of(*(step * e)) - t_of(*(-step * e))) / (2 * step) for e in np.eye(3)])
    np.testing.assert_allclose(covariance[:3, :3], J @ np.diag(sigma[:3] ** 2) @ J.T, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(covariance[3:, 3:], np.diag([0.01, 0.04, 0.09]))
    assert np.linalg.eigvalsh(covariance).min() > -1e-9 * np.linalg.eigvalsh(covariance).max()


def peaks_of(*, score: float = 0.9, z_m: float = 300.0, n: int = 1, apart_px: float = 0.0) -> Peaks:
    center = np.array([[[100.0 + apart_px * k, 100.0] for k in range(n)]], np.float32)
    return Peaks(
        score=np.array([[score - 0.1 * k for k in range(n)]], np.float32),
        center_px=center,
        size_px=np.full((1, n, 2), 40.0, np.float32),
        origin_px=center.copy(),
        t_cam_target_m=np.tile(np.array([1.0, 2.0, z_m], np.float32), (1, n, 1)),
        R_cam_target=np.tile(np.eye(3, dtype=np.float32), (1, n, 1, 1)),
        sigma=np.full((1, n, 6), 0.05, np.float32),
    )


def accepted(peaks: Peaks) -> tuple[int, Counter[str]]:
    refused: Counter[str] = Counter()
    contract = ModelContract(**CONTRACT)
    return len(decode(peaks, 0, WHOLE, contract, "track", contract.track_score_min, refused)), refused


def test_what_is_no_pose_is_refused_and_counted() -> None:
    nan, mirror, flat, thin, vague, boundless = (peaks_of() for _ in range(6))
    vague.sigma[0, 0, 2] = 1e6
    boundless.size_px[0, 0, 0] = 1e12
    nan.t_cam_target_m[0, 0, 0] = np.nan
    mirror.R_cam_target[0, 0, 0, 0] = -1
    flat.sigma[0, 0, 2] = 0
    thin.size_px[0, 0, 1] = 0
    assert accepted(peaks_of()) == (1, Counter())
    assert accepted(peaks_of(score=0.4)) == (0, Counter())
    assert accepted(nan) == (0, Counter(not_finite=1))
    assert accepted(mirror) == (0, Counter(no_rotation=1))
    assert accepted(flat) == accepted(thin) == (0, Counter(no_size=1))
    assert accepted(vague) == accepted(boundless) == (0, Counter(unsure=1))
    assert accepted(peaks_of(z_m=-5.0)) == (0, Counter(out_of_range=1))
    assert accepted(peaks_of(z_m=1201.0)) == (0, Counter(out_of_range=1))
    # What is only looked into, below what a stage asks for, is no loss.
    contract, refused = ModelContract(**(CONTRACT | {"acquire_score_min": 0.5, "track_score_min": 0.3})), Counter[str]()
    for stage, told in (("acquire", 0), ("track", 1)):
        assert decode(peaks_of(score=0.4, z_m=-5.0), 0, WHOLE, contract, stage, 0.1, refused) == []
        assert refused["out_of_range"] == told


def test_a_depth_beyond_the_trained_range_is_less_sure() -> None:
    contract = ModelContract(**(CONTRACT | {"trained_range_m": (50.0, 600.0), "depth_limits_m": (1.0, 5000.0)}))
    inside, outside = (
        decode(peaks_of(score=1.0, z_m=z_m), 0, WHOLE, contract, "track", 0.5, Counter())[0].covariance[2, 2] ** 0.5
        / z_m
        for z_m in (599.0, 900.0)
    )
    assert inside == pytest.approx(0.05, rel=1e-3)
    assert outside == pytest.approx(np.hypot(0.05, np.log(1.5)), rel=1e-3)


def test_a_depth_at_either_end_of_what_a_graph_can_tell_is_a_bound() -> None:
    contract = ModelContract(**(CONTRACT | {"depth_limits_m": (50.0, 600.0), "trained_range_m": (50.0, 600.0)}))
    sigma = {}
    for z_m in (50.01, 51.0, 590.0, 599.99):
        certain = peaks_of(score=1.0, z_m=z_m)
        (e,) = decode(certain, 0, WHOLE, contract, "track", contract.track_score_min, Counter())
        sigma[z_m] = e.covariance[2, 2] ** 0.5 / z_m
    assert (sigma[51.0], sigma[590.0]) == pytest.approx((0.05, 0.05), rel=1e-3)
    assert min(sigma[50.01], sigma[599.99]) > 0.9


@pytest.mark.parametrize(("steep_deg", "excess_deg"), [(0.0, 0.0), (39.0, 0.0), (60.0, 20.0), (-85.0, 45.0)])
def test_an_aircraft_seen_from_farther_above_or_below_than_in_training_is_less_sure_in_rotation(
    steep_deg: float, excess_deg: float
) -> None:
    contract, peaks = ModelContract(**CONTRACT), peaks_of(score=1.0)
    ray = peaks.t_cam_target_m[0, 0].astype(float) / np.linalg.norm(peaks.t_cam_target_m)
    across = np.cross(ray, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(ray, [1.0, 0.0, 0.0]))
    up_cam = np.sin(np.deg2rad(steep_deg)) * ray + np.cos(np.deg2rad(steep_deg)) * across
    estimates = [
        decode(peaks, 0, WHOLE._replace(up_cam=up), contract, "track", contract.track_score_min, Counter())[0]
        for up in (None, up_cam)
    ]
    unknown, steep = (np.sqrt(np.diag(e.covariance)) for e in estimates)
    np.testing.assert_allclose(steep[3:], np.hypot(unknown[3:], np.deg2rad(excess_deg)), atol=1e-4)
    np.testing.assert_array_equal(steep[:3], unknown[:3])


@pytest.mark.parametrize(("off_deg", "excess_deg"), [(39.0, 0.0), (60.0, 20.0)])
def test_an_aircraft_farther_off_the_optical_axis_than_in_training_is_less_sure_in_rotation(
    off_deg: float, excess_deg: float
) -> None:
    contract, stds = ModelContract(**CONTRACT), []
    for angle_rad in (0.0, np.deg2rad(off_deg)):
        peaks = peaks_of(score=1.0)
        peaks.t_cam_target_m[0, 0] = 300.0 * np.array(
            [np.sin(angle_rad) * 0.6, np.sin(angle_rad) * 0.8, np.cos(angle_rad)]
        )
        (e,) = decode(peaks, 0, WHOLE, contract, "track", contract.track_score_min, Counter())
        stds.append(np.sqrt(np.diag(e.covariance)[3:]))
    np.testing.assert_allclose(stds[1], np.hypot(stds[0], np.deg2rad(excess_deg)), atol=1e-4)


def test_what_may_not_be_what_it_is_taken_for_is_less_sure_in_all_it_tells() -> None:
    """Half a chance to be something else: half the variance of what such things are off by."""
    contract = ModelContract(**(CONTRACT | {"track_score_min": 0.3}))
    stds, across_px = [], []
    for score in (1.0, 0.5):
        peaks = peaks_of(score=score)
        (e,) = decode(peaks, 0, WHOLE, contract, "track", contract.track_score_min, Counter())
        stds.append(np.sqrt(np.diag(e.covariance)))
        across = np.cross(e.t_cam_target_m, [1.0, 0.0, 0.0]) / np.linalg.norm(e.t_cam_target_m)
        across_px.append(np.sqrt(across @ e.covariance[:3, :3] @ across) * K[1, 1] / e.t_cam_target_m[2])
    assert across_px == pytest.approx([0.05, np.hypot(0.05, np.sqrt(0.5) * 0.05 * 40.0)], rel=0.01)
    certain, doubtful = stds
    assert np.all(doubtful > certain)
    assert doubtful[2] / 300.0 == pytest.approx(np.sqrt(0.05**2 + 0.5 * 0.5**2), rel=1e-3)
    np.testing.assert_allclose(doubtful[3:], np.sqrt(0.05**2 + 0.5 * 0.5**2), rtol=1e-3)


def seen_at(
    left_px: float, width_px: float, *, origin_x_px: float | None = None
) -> tuple[list[Estimate], Counter[str]]:
    """What is made of a target 40 px high in the middle rows, whose box begins at `left_px`, and that surely is one."""
    peaks = peaks_of(score=1.0)
    peaks.center_px[0, 0] = [left_px + width_px / 2, 500.0]
    peaks.size_px[0, 0] = [width_px, min(40.0, width_px)]
    peaks.origin_px[0, 0] = [left_px + width_px / 2 if origin_x_px is None else origin_x_px, 500.0]
    refused: Counter[str] = Counter()
    contract = ModelContract(**CONTRACT)
    return decode(peaks, 0, WHOLE, contract, "track", contract.track_score_min, refused), refused


def test_a_target_below_eight_pixels_is_not_told() -> None:
    assert seen_at(700.0, 7.9) == ([], Counter(too_small=1))
    assert len(seen_at(700.0, 8.1)[0]) == 1


@pytest.mark.parametrize("left_px", [-30.0, 0.0, 1880.0, 1860.0])
def test_a_target_cut_by_the_edge_is_told_with_doubt_in_place_and_range(left_px: float) -> None:
    ((whole,), (cut,)) = seen_at(900.0, 60.0)[0], seen_at(left_px, 60.0)[0]
    depth_sigma, whole_sigma = (e.covariance[2, 2] ** 0.5 / e.t_cam_target_m[2] for e in (cut, whole))
    assert whole_sigma == pytest.approx(0.05, rel=1e-3)
    assert depth_sigma > 0.35
    across_px = cut.covariance[1, 1] ** 0.5 * K[1, 1] / cut.t_cam_target_m[2]
    assert across_px > 0.2 * 60
    assert np.sqrt(np.diagonal(cut.covariance)[3:]).min() > np.radians(40), "no nose to tell from a tail"
    assert cut.box_xyxy_px[0] >= -0.5
    assert cut.box_xyxy_px[2] <= SIZE_WH[0] - 0.5


@pytest.mark.parametrize("at_px", [(530.0, 440.0), (770.0, 440.0), (640.0, 330.0), (640.0, 550.0)])
def test_a_target_that_a_window_cuts_is_told_with_doubt_as_at_the_frame_s_edge(at_px: tuple[float, float]) -> None:
    """The window shows columns 500 to 799 and rows 300 to 579; the box of 60 by 60 reaches one of its sides."""
    contract, peaks = ModelContract(**CONTRACT), peaks_of(score=1.0)
    pixel_map = PixelMap((1, 1), (-500, -300))
    shown = Shown(pixel_map, pixel_map.intrinsics(K), (300, 280), SIZE_WH)
    peaks.size_px[:] = 60.0
    depth_sigma = []
    for x_px, y_px in (at_px, (640.0, 440.0)):
        peaks.center_px[:] = peaks.origin_px[:] = [x_px - 500.0, y_px - 300.0]
        (told,) = decode(peaks, 0, shown, contract, "track", 0.5, Counter())
        depth_sigma.append(told.covariance[2, 2] ** 0.5 / told.t_cam_target_m[2])
    assert depth_sigma == pytest.approx([np.hypot(0.05, 0.4), 0.05], rel=1e-3)


@pytest.mark.parametrize(("width_px", "height_px", "longer_px"), [(240, 90, 240), (90, 240, 240), (1e6, 90, 1920)])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_cut_target_is_as_long_as_expected_though_less_of_it_is_seen(
    width_px: float, height_px: float, longer_px: float, scale: float
) -> None:
    """Its origin is unsure by a quarter of the length that it was predicted to have, at most that of the frame."""
    contract, peaks = ModelContract(**CONTRACT), peaks_of(score=1.0)
    peaks.center_px[:] = peaks.origin_px[:] = [10.0, 500.0 * scale]
    expected = [5.0 - width_px, 500.0, 5.0, 500.0 + height_px]
    pixel_map = PixelMap((scale, scale), (0, 0))
    shown = WHOLE._replace(pixel_map=pixel_map, K=pixel_map.intrinsics(K))
    (cut,) = decode(peaks, 0, shown, contract, "track", 0.5, Counter(), None, expected)
    across_px = cut.covariance[1, 1] ** 0.5 * K[1, 1] / cut.t_cam_target_m[2]
    assert across_px == pytest.approx(0.25 * longer_px, rel=0.01)


def test_a_target_whose_middle_is_off_the_frame_is_not_told() -> None:
    for left_px, origin_x_px in ((-40.0, -10.0), (1900.0, 1930.0), (-20.0, np.nan)):
        assert seen_at(left_px, 60.0, origin_x_px=origin_x_px) == ([], Counter(cut_off=1))
    assert seen_at(-90.0, 60.0) == ([], Counter(too_small=1))


def test_a_size_that_was_not_trained_is_less_sure() -> None:
    (trained,), (larger,) = seen_at(700.0, 200.0)[0], seen_at(700.0, 300.0)[0]
    sigma = [e.covariance[2, 2] ** 0.5 / e.t_cam_target_m[2] for e in (trained, larger)]
    assert sigma[0] == pytest.approx(0.05, rel=1e-3)
    assert sigma[1] == pytest.approx(np.hypot(0.05, np.log(1.5)), rel=1e-3)


def test_two_peaks_on_one_aircraft_are_one_target_and_two_apart_are_two() -> None:
    assert accepted(peaks_of(n=2, apart_px=8.0))[0] == 1
    assert accepted(peaks_of(n=2, apart_px=60.0))[0] == 2


@pytest.mark.parametrize(("apart_px", "scores"), [(8.0, [0.8]), (60.0, [0.9, 0.8])])
def test_a_target_is_where_its_highest_peak_is_and_the_likeliest_target_comes_first(
    apart_px: float, scores: list[float]
) -> None:
    peaks = peaks_of(n=2, apart_px=apart_px)
    peaks.score[:] = peaks.score[:, ::-1].copy()
    kept = decode(peaks, 0, WHOLE, ModelContract(**CONTRACT), "track", 0.5, Counter())
    assert [estimate.score for estimate in kept] == pytest.approx(scores)


def test_of_two_in_a_window_the_one_that_lies_where_the_target_should_be_is_taken() -> None:
    def at(left_px: float, score: float) -> Estimate:
        box = np.array([1500.0 + left_px, 900.0, 1540.0 + left_px, 920.0])
        return Estimate(score, box, np.eye(3), np.array([0.0, 0.0, 200.0]), np.eye(6), "track")

    here = at(0.0, 0.8)
    for there in (at(80.0, 0.95), at(-80.0, 0.95)):
        assert nearest_expected([there, here], [1502.0, 900.0, 1542.0, 920.0]) is here
    assert nearest_expected([at(1.0, 0.3), here], [1502.0, 900.0, 1542.0, 920.0]) is here, "as near, and more sure"


@pytest.mark.parametrize(("stage", "offset"), [("acquire", -1.0), ("track", 1.0)])
def test_each_stage_is_scored_by_its_own_calibration(stage: Literal["acquire", "track"], offset: float) -> None:
    contract = ModelContract(**(CONTRACT | {"acquire_score": {"offset": -1.0}, "track_score": {"offset": 1.0}}))
    (e,) = decode(peaks_of(score=0.9), 0, WHOLE, contract, stage, 0.5, Counter())
    assert e.score == pytest.approx(1.0 / (1.0 + np.exp(-(np.log(9.0) + offset))), rel=1e-4)


@pytest.mark.parametrize(("scale", "shown_px"), [(2.0, 20.0), (0.5, 40.0)])
def test_a_score_that_depends_on_size_counts_the_pixels_that_there_really_are(scale: float, shown_px: float) -> None:
    """Of 40 in the network's image: enlarged from the frame's they tell no more than these did."""
    contract = ModelContract(**(CONTRACT | {"track_score": {"size_slope": -0.5, "size_cap_px": 1000.0}}))
    shown = WHOLE._replace(pixel_map=PixelMap((scale, scale), (0, 0)))
    peaks = peaks_of()
    peaks.center_px[:] = peaks.origin_px[:] = 400.0
    (e,) = decode(peaks, 0, shown, contract, "track", 0.1, Counter())
    assert e.score == pytest.approx(1.0 / (1.0 + np.exp(-(np.log(9.0) - 0.5 * np.log(shown_px)))), rel=1e-4)


@given(boxes, boxes)
def test_overlap_is_symmetric_and_one_for_a_box_inside_another(a: np.ndarray, b: np.ndarray) -> None:
    assert overlap(a, b) == pytest.approx(overlap(b, a))
    assert 0 <= overlap(a, b) <= 1 + 1e-9
    assert overlap(a, np.array([a[0] - 5, a[1] - 5, a[2] + 5, a[3] + 5])) == pytest.approx(1)
