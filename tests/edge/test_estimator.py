from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
import onnx.parser
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from edge.errors import InputError
from edge.estimator.decode import Shown
from edge.estimator.estimator import Estimator
from edge.estimator.given_size import TargetSize
from edge.estimator.model import Peaks, load_model
from edge.estimator.window import PixelMap, Window, cut, fit_frame, pixel_aspect, window_around
from edge.types import Frame, FrameMeta

from .toy_model import GRAPH, write_toy_model
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
        if start > 0 and start + length < limit:
            assert start + 0.5 * (length - 1) == pytest.approx(0.5 * (low + high), abs=0.5 + 1e-9)


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


@given(st.tuples(*[st.integers(-9, 25)] * 4))
def test_beyond_the_frame_a_window_repeats_its_border(margins: tuple[int, int, int, int]) -> None:
    """Margins at the left, top, right and bottom; where negative, the window ends inside the frame."""
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    left, top, right, bottom = margins
    window = Window(-left, -top, 60 + left + right, 40 + top + bottom)
    wide = np.pad(image, ((30, 30), (30, 30), (0, 0)), mode="edge")
    expected = wide[30 - top : 70 + bottom, 30 - left : 90 + right]
    np.testing.assert_array_equal(cut(image, window, (window.width, window.height)), expected)


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


def test_one_that_two_windows_see_is_told_once(toy_model: Path) -> None:
    estimator = Estimator(load_model(toy_model, 1))
    frame = frame_of(draw((500.5, 500.5)))
    (found,) = estimator.acquire(frame)
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
    estimator.target_size = TargetSize(wingspan_m=16.0, length_m=10.0)
    (sized,) = estimator.acquire(frame_of(draw((700.5, 300.5))))
    assert sized.t_cam_target_m[2] > estimate.t_cam_target_m[2] + 0.5


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
