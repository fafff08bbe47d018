from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import onnx
import onnx.parser
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from edge.errors import InputError
from edge.estimator.decode import Shown, decode, nearest_expected, overlap, pose_covariance
from edge.estimator.estimator import Estimator
from edge.estimator.model import Peaks, load_model
from edge.estimator.window import PixelMap, cut, fit_frame, pixel_aspect, window_around
from edge.types import Estimate, Frame, FrameMeta
from msgs.contract import ModelContract

from .toy_model import CONTRACT, GRAPH, write_toy_model
from .toy_scene import SIZE_WH, TARGET_WH, K, draw, true_t_cam_target_m

TRACK_WH = (256, 256)
WHOLE = Shown(PixelMap((1, 1), (0, 0)), K, SIZE_WH, SIZE_WH)  # the frame as it is
boxes = st.tuples(st.floats(-50, 1900), st.floats(-50, 1060), st.floats(4, 700), st.floats(4, 500)).map(
    lambda b: np.array([b[0], b[1], b[0] + b[2], b[1] + b[3]])
)
points = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(60, 500)).map(np.array)


def frame_of(image: np.ndarray) -> Frame:
    return Frame(FrameMeta(0, 0, 0), image, K)


def project(K_px: np.ndarray, point_m: np.ndarray) -> np.ndarray:
    return (K_px @ point_m)[:2] / point_m[2]


@given(boxes, points)
def test_a_window_is_the_same_camera_with_other_pixels(box: np.ndarray, point_m: np.ndarray) -> None:
    pixel_map = window_around(box, 2.0, TRACK_WH, SIZE_WH).pixel_map(TRACK_WH)
    on_network = project(pixel_map.intrinsics(K), point_m)
    np.testing.assert_allclose(pixel_map.to_frame(on_network), project(K, point_m), atol=0.01)
    np.testing.assert_allclose(on_network, pixel_map.to_network(project(K, point_m)), atol=0.01)


def test_the_window_of_a_target_about_to_collide_is_no_larger_than_the_picture() -> None:
    window = window_around(np.array([-14_000.0, -9_000.0, 16_000.0, 10_000.0]), 2.0, TRACK_WH, SIZE_WH)
    assert 0.95 * max(SIZE_WH) < max(window.width, window.height) <= max(SIZE_WH)
    assert cut(np.zeros((SIZE_WH[1], SIZE_WH[0], 3), dtype=np.uint8), window, TRACK_WH).shape == (256, 256, 3)


def test_a_window_s_shorter_side_is_that_of_its_box_times_the_scale() -> None:
    box = np.array([900.0, 500.0, 1000.0, 540.0])
    for size_wh, window_wh in (((256, 256), (200, 200)), ((320, 256), (250, 200)), ((256, 320), (200, 250))):
        window = window_around(box, 2.0, size_wh, SIZE_WH)
        assert (window.width, window.height) == window_wh


@given(boxes)
def test_a_window_holds_its_box_and_stays_in_the_frame_where_it_fits(box: np.ndarray) -> None:
    window = window_around(box, 2.0, TRACK_WH, SIZE_WH)
    box_in_frame = np.clip(box, 0, [1919, 1079, 1919, 1079])
    assume(np.all(box_in_frame == box))
    for start, length, limit, low, high in (
        (window.left, window.width, SIZE_WH[0], box[0], box[2]),
        (window.top, window.height, SIZE_WH[1], box[1], box[3]),
    ):
        assert start - 0.5 <= low
        assert high <= start + length - 0.5
        if length <= limit:
            assert start >= 0
            assert start + length <= limit


@pytest.mark.parametrize("fit", ["letterbox", "squash"])
@pytest.mark.parametrize("size_wh", [(640, 384), (640, 640)])
def test_a_fitted_frame_shows_a_target_where_its_map_says(fit: str, size_wh: tuple[int, int]) -> None:
    center = (1500.5, 300.5)
    image, pixel_map = fit_frame(draw(center), size_wh, fit)  # type: ignore[arg-type]
    weights = image[..., 0].astype(float)
    rows, columns = np.indices(weights.shape)
    seen = np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()
    np.testing.assert_allclose(seen, pixel_map.to_network(center), atol=0.02)
    if fit == "letterbox":
        assert pixel_map.scale_xy[0] == pytest.approx(pixel_map.scale_xy[1], rel=0.01)
    else:
        assert pixel_map.scale_xy == pytest.approx(np.array(size_wh) / SIZE_WH)


@pytest.mark.parametrize(("wide", "high"), [(1, 2), (2, 1), (1, 1.42), (1.33, 1)])
@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.0, 0.0)])
def test_the_network_is_shown_square_pixels_whatever_the_camera_s_are(
    toy_model: Path, wide: float, high: float, distortion: tuple[float, ...]
) -> None:
    """As of a picture that a capture card has squeezed; the toy's truth holds for it, as its depth knows both f."""
    model = load_model(toy_model, 1)
    shown: list[np.ndarray] = []

    def run(images: np.ndarray, K_images: np.ndarray) -> Peaks:
        shown.extend(K_images)
        return model.infer(images, K_images)

    model.run = run  # type: ignore[method-assign]
    squeezed_wh = round(SIZE_WH[0] / wide), round(SIZE_WH[1] / high)
    by = np.array(squeezed_wh) / SIZE_WH
    squeezed_K = PixelMap(tuple(by), (0, 0)).intrinsics(K)  # type: ignore[arg-type]
    center, half = np.array([960.5, 540.5]), np.array(TARGET_WH) / 2  # in the middle, where the lens bends nothing
    image = np.asarray(cv2.resize(draw((960.5, 540.5)), squeezed_wh, interpolation=cv2.INTER_AREA), np.uint8)
    box = (np.concatenate([center - half, center + half]) + 0.5) * np.tile(by, 2) - 0.5
    frame = Frame(FrameMeta(0, 0, 0), image, squeezed_K, distortion)

    estimator = Estimator(model)
    (found,) = estimator.acquire(frame)
    (tracked,) = estimator.track(frame, [box])
    assert tracked is not None
    for K_shown in shown:
        assert K_shown[0, 0] == pytest.approx(K_shown[1, 1], rel=0.03)
    for estimate in (found, tracked):
        np.testing.assert_allclose(estimate.t_cam_target_m, true_t_cam_target_m((960.5, 540.5)), rtol=0.03, atol=0.3)
        np.testing.assert_allclose(estimate.box_xyxy_px, box, atol=1.5)


def test_a_slip_in_a_focal_length_asks_for_no_more_memory_than_there_is() -> None:
    assert pixel_aspect(K * [[1, 1, 1], [1, 1.02, 1], [1, 1, 1]]) == 1.0, "as calibrations scatter"
    mistyped = K * [[1, 1, 1], [1, 1000, 1], [1, 1, 1]]
    window = window_around([900, 500, 1000, 560], 2.0, TRACK_WH, SIZE_WH, None, pixel_aspect(mistyped))
    assert window.width * window.height <= 8 * SIZE_WH[0] * SIZE_WH[1]


@pytest.mark.parametrize("center", [(900.5, 500.5), (70.5, 40.5), (1850.5, 1040.5)])
def test_a_cut_window_shows_a_target_where_its_map_says(center: tuple[float, float]) -> None:
    box = np.array([center[0] - 60, center[1] - 30, center[0] + 60, center[1] + 30])
    window = window_around(box, 2.0, TRACK_WH, SIZE_WH)
    weights = cut(draw(center), window, TRACK_WH)[..., 0].astype(float)
    rows, columns = np.indices(weights.shape)
    seen = np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()
    np.testing.assert_allclose(seen, window.pixel_map(TRACK_WH).to_network(center), atol=0.05)


@given(points, st.floats(0.1, 3), st.floats(0.1, 3), st.floats(0.01, 0.2))
def test_covariance_is_what_sampling_the_uncertainty_gives(t_m: np.ndarray, su: float, sv: float, slz: float) -> None:
    sigma = np.array([su, sv, slz, 0.1, 0.2, 0.3])
    covariance = pose_covariance(t_m, sigma, K, (50.0, 600.0))
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
    nan, mirror, flat, thin, vague = (peaks_of() for _ in range(5))
    vague.sigma[0, 0, 2] = 1e6
    nan.t_cam_target_m[0, 0, 0] = np.nan
    mirror.R_cam_target[0, 0, 0, 0] = -1
    flat.sigma[0, 0, 2] = 0
    thin.size_px[0, 0, 1] = 0
    assert accepted(peaks_of()) == (1, Counter())
    assert accepted(peaks_of(score=0.4)) == (0, Counter())
    assert accepted(nan) == (0, Counter(not_finite=1))
    assert accepted(mirror) == (0, Counter(no_rotation=1))
    assert accepted(flat) == accepted(thin) == (0, Counter(no_size=1))
    assert accepted(vague) == (0, Counter(unsure=1))
    assert accepted(peaks_of(z_m=-5.0)) == (0, Counter(out_of_range=1))
    assert accepted(peaks_of(z_m=1201.0)) == (0, Counter(out_of_range=1))
    # What is only looked into, below what a stage asks for, is no loss.
    contract, refused = ModelContract(**(CONTRACT | {"acquire_score_min": 0.5, "track_score_min": 0.3})), Counter[str]()
    for stage, told in (("acquire", 0), ("track", 1)):
        assert decode(peaks_of(score=0.4, z_m=-5.0), 0, WHOLE, contract, stage, 0.1, refused) == []
        assert refused["out_of_range"] == told


def test_a_depth_beyond_the_trained_range_is_less_sure() -> None:
    sigma = np.full(6, 0.05)
    inside, outside = (pose_covariance([0, 0, z], sigma, K, (50, 600))[2, 2] ** 0.5 / z for z in (599.0, 900.0))
    assert inside == pytest.approx(0.05, rel=1e-6)
    assert outside == pytest.approx(np.hypot(0.05, np.log(1.5)), rel=1e-6)


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
    weaker_first = peaks_of(n=2, apart_px=8.0)
    weaker_first.score[:] = weaker_first.score[:, ::-1].copy()
    (kept,) = decode(weaker_first, 0, WHOLE, ModelContract(**CONTRACT), "track", 0.5, Counter())
    assert kept.score == pytest.approx(0.9)


def test_of_two_in_a_window_the_one_that_lies_where_the_target_should_be_is_taken() -> None:
    def at(left_px: float, score: float) -> Estimate:
        box = np.array([1500.0 + left_px, 900.0, 1540.0 + left_px, 920.0])
        return Estimate(score, box, np.eye(3), np.array([0.0, 0.0, 200.0]), np.eye(6), "track")

    here, there = at(0.0, 0.8), at(80.0, 0.95)
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


@pytest.mark.parametrize("center", [(960.5, 540.5), (150.5, 90.5), (1800.5, 1000.5)])
def test_acquire_finds_a_target_anywhere_and_refines_it_to_native_accuracy(
    toy_model: Path, center: tuple[float, float]
) -> None:
    (estimate,) = Estimator(load_model(toy_model, 1)).acquire(frame_of(draw(center)))
    assert estimate.stage == "track"
    truth_m = true_t_cam_target_m(center)
    np.testing.assert_allclose(estimate.t_cam_target_m, truth_m, rtol=0.02, atol=0.2)
    half = np.array(TARGET_WH) / 2
    np.testing.assert_allclose(estimate.box_xyxy_px, [*(center - half), *(center + half)], atol=1.0)


@pytest.mark.parametrize("sequence", [0, 1])
def test_what_the_window_s_edge_cuts_is_looked_at_again_whole(toy_model: Path, sequence: int) -> None:
    """Plain and mirrored: the target has moved by its own length, and its window's edge leaves half of it."""
    center = (700.5, 500.5)
    frame = Frame(FrameMeta(sequence, 0, 0), draw(center), K)
    half = np.array(TARGET_WH) / 2
    moved = np.array([*(center - half), *(center + half)]) - [TARGET_WH[0], 0, TARGET_WH[0], 0]
    (seen,) = Estimator(load_model(toy_model, 1)).track(frame, [moved])
    assert seen is not None
    np.testing.assert_allclose(seen.t_cam_target_m, true_t_cam_target_m(center), rtol=0.02, atol=0.2)
    np.testing.assert_allclose(seen.box_xyxy_px, [*(center - half), *(center + half)], atol=1.0)


def test_track_says_none_where_the_window_holds_no_target(toy_model: Path) -> None:
    frame = frame_of(draw((500.5, 500.5)))
    expected = [np.array([450.0, 480.0, 570.0, 540.0]), np.array([1500.0, 200.0, 1620.0, 260.0])]
    model = load_model(toy_model, 1)
    seen, missed = Estimator(model).track(frame, expected)
    ((begin_ns, end_ns),) = model.take_runs_ns()
    assert (begin_ns < end_ns, model.take_runs_ns()) == (True, []), "one inference, timed once"
    assert seen is not None
    assert missed is None
    np.testing.assert_allclose(seen.t_cam_target_m, true_t_cam_target_m((500.5, 500.5)), rtol=0.02, atol=0.2)


def test_a_known_target_is_not_acquired_again_nor_one_seen_by_two_windows_twice(toy_model: Path) -> None:
    estimator = Estimator(load_model(toy_model, 1))
    frame = frame_of(draw((500.5, 500.5)))
    (found,) = estimator.acquire(frame)
    assert estimator.acquire(frame, [found.box_xyxy_px]) == []
    seen = estimator.track(frame, [found.box_xyxy_px, found.box_xyxy_px + 20])
    assert sum(estimate is not None for estimate in seen) == 1


def test_a_model_without_track_stage_estimates_on_the_whole_frame(tmp_path: Path) -> None:
    changes = {"track_size_wh": None, "acquire_size_wh": (640, 640), "acquire_fit": "squash"}
    model = load_model(write_toy_model(tmp_path / "paper.onnx", **changes), 1)
    model.warm_up()
    estimator = Estimator(model)
    estimator.warm_up(frame_of(np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)))
    (estimate,) = estimator.acquire(frame_of(draw((700.5, 300.5))))
    assert estimate.stage == "acquire"
    np.testing.assert_allclose(estimate.t_cam_target_m, true_t_cam_target_m((700.5, 300.5)), rtol=0.03, atol=0.5)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda path: None, "cannot be read"),
        (lambda path: path.write_bytes(b"\x08\x07junk"), "not a loadable ONNX file"),
        (lambda path: onnx.save(onnx.parser.parse_model(GRAPH), path), "carries no contract"),
        (lambda path: write_toy_model(path, metadata="{"), "contract is not JSON"),
        (lambda path: write_toy_model(path, metadata="[]"), "contract version None"),
        (lambda path: write_toy_model(path, metadata='{"version": 7}'), "contract version 7; this program reads 1"),
        (lambda path: write_toy_model(path, metadata='{"version": 1}'), "contract key name"),
        (lambda path: write_toy_model(path, acquire_size_wh=(640, 380)), "not a multiple of 32"),
        (lambda path: write_toy_model(path, graph=GRAPH.replace("[N, H, W,", "[N, 256, 256,")), "run at 640x384: "),
        (lambda path: write_toy_model(path, graph=GRAPH.replace("[N, H, W,", "[N, 384, 640,")), "run at 256x256: "),
        (lambda path: write_toy_model(path, graph=GRAPH.replace("uint8[N", "int8[N")), "input image is tensor(int8)"),
        (
            lambda path: write_toy_model(path, graph=GRAPH.replace(" image", " picture").replace("(image", "(picture")),
            "takes inputs ['K', 'picture']",
        ),
        (
            lambda path: write_toy_model(path, graph=GRAPH.replace("sigma)", "spread)").replace("sigma =", "spread =")),
            "['sigma']",
        ),
        (lambda path: write_toy_model(path, max_peaks=4), "output score has shape (1, 1), its contract says (1, 4)"),
    ],
)
def test_a_model_that_does_not_fit_is_refused_with_what_is_wrong(tmp_path: Path, make: object, sentence: str) -> None:
    path = tmp_path / "model.onnx"
    assert callable(make)
    make(path)
    with pytest.raises(InputError) as error:
        load_model(path, 1).warm_up()
    assert "model.onnx" in str(error.value)
    assert sentence in str(error.value)
