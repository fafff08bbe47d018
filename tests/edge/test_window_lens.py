"""Windows cut through lenses that bend: the network must see the pinhole camera that its K tells of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from edge.estimator.decode import Shown, grown
from edge.estimator.estimator import Estimator
from edge.estimator.lens import Lens, _extent, lens_of
from edge.estimator.model import load_model
from edge.estimator.window import cut, fit_frame, whole_frame, window_around
from edge.reload import warm_estimator
from edge.types import CameraInfo, Frame, FrameMeta

from .toy_scene import SIZE_WH, TARGET_WH, K, true_t_cam_target_m

NETWORK_WH = (160, 160)
BARREL = (-0.32, 0.12, 0.001, -0.0008, -0.02)


@dataclass(frozen=True)
class Camera:
    K: np.ndarray
    size_wh: tuple[int, int]
    distortion: tuple[float, ...]

    @property
    def lens(self) -> Lens:
        return Lens(self.K, self.distortion)

    def bend(self, rays_xy: np.ndarray) -> np.ndarray:
        """Rays (x / z, y / z) [..., 2] to frame pixels: the plumb-bob model as its authors write it."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = rays_xy[..., 0], rays_xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        (fx, fy), (cx, cy) = np.diag(self.K)[:2], self.K[:2, 2]
        return np.stack([fx * bent_x + cx, fy * bent_y + cy], axis=-1)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Any focal length and centre; distortion by up to a fifth of the radius at the corner."""
    width, height = draw(st.sampled_from([(1920, 1080), (1280, 1024), (640, 480)]))
    focal = draw(st.floats(0.6, 8.0)) * width
    fy = focal * draw(st.floats(0.97, 1.03))
    cx = width * draw(st.floats(0.45, 0.55))
    cy = height * draw(st.floats(0.45, 0.55))
    corner = np.hypot(width, height) / 2 / focal
    shares = [draw(st.floats(-0.12, 0.2)), draw(st.floats(-0.02, 0.05)), draw(st.floats(-0.005, 0.02))]
    decentred = [draw(st.floats(-0.01, 0.01)) / corner for _ in range(2)]
    k1, k2, k3 = (share / corner ** (2 * n) for n, share in enumerate(shares, start=1))
    camera = Camera(np.array([[focal, 0, cx], [0, fy, cy], [0, 0, 1]]), (width, height), (k1, k2, *decentred, k3))
    # A lens whose picture fills the frame: growing outwards to beyond the farthest corner.
    out = np.linspace(0.0, 2.5 * corner, 500)
    radius = out * (1 + k1 * out**2 + k2 * out**4 + k3 * out**6)
    grows = np.diff(radius) > 0.02 * out[1]
    reach = radius[-1] if grows.all() else radius[np.argmin(grows)]
    assume(reach > 1.25 * corner)
    return camera


shares = st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)).map(np.array)
sizes = st.floats(8.0, 500.0)


@given(cameras(), shares, shares, sizes, st.floats(60, 500))
def test_a_point_goes_through_any_window_and_back_within_a_hundredth_of_a_pixel(
    camera: Camera, at: np.ndarray, beside: np.ndarray, size_px: float, z_m: float
) -> None:
    lens, K_frame = camera.lens, camera.K
    on_frame = at * (np.array(camera.size_wh) - 1)
    rays = np.linalg.inv(K_frame) @ [*lens.to_pinhole(on_frame), 1.0]
    assume(np.linalg.norm(rays[:2]) < lens.radius_max)
    point_m = z_m * rays
    np.testing.assert_allclose(camera.bend(rays[:2]), on_frame, atol=0.01)
    center = beside * np.array(camera.size_wh)  # a window around something else: partly off the frame at its edges
    box = np.array([*(center - size_px / 2), *(center + size_px / 2)])
    windows = [window_around(box, 1.8, NETWORK_WH, camera.size_wh, lens), whole_frame(camera.size_wh, lens)]
    for window in windows:
        pixel_map = window.pixel_map(NETWORK_WH, lens)
        on_network = pixel_map.intrinsics(K_frame) @ point_m / point_m[2]
        np.testing.assert_allclose(pixel_map.to_frame(on_network[:2]), camera.bend(rays[:2]), atol=0.01)
        np.testing.assert_allclose(pixel_map.to_network(camera.bend(rays[:2])), on_network[:2], atol=0.01)


def dot(size_wh: tuple[int, int], at_px: np.ndarray, sigma_px: float = 3.0) -> np.ndarray:
    """A picture with one soft dot, exact below the pixel."""
    x = np.exp(-((np.arange(size_wh[0]) - at_px[0]) ** 2) / (2 * sigma_px**2))
    y = np.exp(-((np.arange(size_wh[1]) - at_px[1]) ** 2) / (2 * sigma_px**2))
    return np.repeat((250 * y[:, None] * x[None, :]).astype(np.uint8)[..., None], 3, axis=-1)


def centroid(image: np.ndarray) -> np.ndarray:
    weights = image[..., 0].astype(float)
    rows, columns = np.indices(weights.shape)
    return np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()


@settings(max_examples=30, deadline=None)
@given(cameras(), shares, sizes)
def test_a_window_shows_a_point_where_its_pinhole_sees_it(camera: Camera, at: np.ndarray, size_px: float) -> None:
    width, height = camera.size_wh
    on_frame = 30 + at * (np.array([width, height]) - 60)
    lens = camera.lens
    rays = np.linalg.inv(camera.K) @ [*lens.to_pinhole(on_frame), 1.0]
    assume(np.linalg.norm(rays[:2]) < 0.9 * lens.radius_max)
    box = np.array([*(on_frame - size_px / 2), *(on_frame + size_px / 2)])
    window = window_around(box, 1.8, NETWORK_WH, camera.size_wh, lens)
    assume(window.width >= 40)
    image = cut(dot(camera.size_wh, on_frame), window, NETWORK_WH, lens)
    expected = (window.pixel_map(NETWORK_WH, lens).intrinsics(camera.K) @ rays)[:2]
    np.testing.assert_allclose(centroid(image), expected, atol=0.2)


@pytest.mark.parametrize("fit", ["letterbox", "squash"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("corner", [(20, 20), (1899, 20), (20, 1059), (1899, 1059)])
def test_the_whole_frame_is_seen_to_its_corners_through_barrel_and_pincushion(
    fit: str, sign: float, corner: tuple[int, int]
) -> None:
    camera = Camera(K, SIZE_WH, (sign * 0.25, 0.0, 0.0, 0.0, 0.0))
    image, pixel_map = fit_frame(dot(SIZE_WH, np.array(corner), 5.0), (640, 384), fit, camera.lens)  # type: ignore[arg-type]
    expected = pixel_map.to_network(np.array(corner))
    assert np.all(expected > 0)
    assert np.all(expected < (639, 383))
    np.testing.assert_allclose(centroid(image), expected, atol=0.25)


@pytest.mark.parametrize(("focal_px", "k1"), [(2000.0, -0.3), (2000.0, 0.3), (1250.0, -0.17), (1000.0, -0.1)])
def test_a_lens_s_picture_without_distortion_ends_where_its_corners_and_sides_do(focal_px: float, k1: float) -> None:
    """Farthest out are a barrel's corners and the middles of a pincushion's sides; by the roots of r + k1 r^3."""
    lens = Lens(np.array([[focal_px, 0.0, 959.5], [0.0, focal_px, 539.5], [0.0, 0.0, 1.0]]), (k1, 0.0, 0.0, 0.0))
    half = np.array([960.0, 540.0])
    bent = np.linalg.norm(half) / focal_px if k1 < 0.0 else half / focal_px
    grown = []
    for one in np.broadcast_to(bent, 2):
        roots = np.roots([k1, 0.0, 1.0, -one])
        grown.append(min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0.0) / one)
    reach = half * np.array(grown)
    assert np.all(reach < 2.0 * half)
    middle = np.array([959.5, 539.5])
    np.testing.assert_allclose(lens.extent_xyxy_px(SIZE_WH), [*(middle - reach), *(middle + reach)], atol=0.1)


def test_of_a_lens_that_bends_very_much_no_more_than_half_a_frame_is_added_at_each_side() -> None:
    lens = Lens(np.array([[1157.0, 0.0, 959.5], [0.0, 1157.0, 539.5], [0.0, 0.0, 1.0]]), (-0.33, 0.05, 0.0, 0.0))
    assert np.all(lens.to_pinhole([1910.0, 1070.0]) > [2900.0, 1640.0])
    np.testing.assert_allclose(lens.extent_xyxy_px(SIZE_WH), [-960.5, -540.5, 2879.5, 1619.5])


@pytest.mark.parametrize(
    ("focal_px", "size_wh", "distortion"),
    [
        (900.0, (1920, 1080), (-0.3, 0.1, 0.0, 0.0, -0.015)),
        (900.0, (1920, 1080), (-0.3, 0.1, 0.001, -0.001, -0.015)),
        (300.0, (640, 480), (-0.3, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_all_that_a_lens_lets_through_is_seen_though_it_folds_inside_the_frame(
    focal_px: float, size_wh: tuple[int, int], distortion: tuple[float, ...]
) -> None:
    width, height = size_wh
    K_frame = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    lens = Lens(K_frame, distortion)
    radius, angle = np.meshgrid(np.linspace(0.0, 0.9 * lens.radius_max, 100), np.linspace(0.0, 2 * np.pi, 361))
    rays = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones_like(radius)], axis=-1).reshape(-1, 3)
    on_frame, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K_frame, np.array(distortion))
    shown = np.all((on_frame[:, 0] >= 0) & (on_frame[:, 0] <= (width - 1, height - 1)), axis=-1)
    on_pinhole = (rays @ K_frame.T)[shown, :2]
    seen = whole_frame(size_wh, lens)
    assert np.all(on_pinhole >= (seen.left, seen.top))
    assert np.all(on_pinhole <= (seen.left + seen.width - 1, seen.top + seen.height - 1))


def test_a_window_has_the_pixels_of_the_straightened_frame() -> None:
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (1080, 1920, 3), dtype=np.uint8), (0, 0), 4.0)
    camera = Camera(K, SIZE_WH, BARREL)
    whole = cv2.undistort(texture, K, np.array(BARREL))
    for box in ([900, 500, 960, 540], [300, 200, 700, 500], [1500, 800, 1700, 900]):
        window = window_around(np.array(box), 1.8, NETWORK_WH, SIZE_WH, camera.lens)
        own = cut(texture, window, NETWORK_WH, camera.lens).astype(float)
        reference = cut(np.asarray(whole, dtype=np.uint8), window, NETWORK_WH).astype(float)
        assert np.abs(own - reference).mean() < 0.02 * reference.std() + 1.0
        shifted = np.roll(reference, 1, axis=1)
        assert np.abs(own - reference).mean() < 0.5 * np.abs(shifted - reference).mean()


@pytest.mark.parametrize(
    ("distortion", "folds"),
    [
        ((-0.3, 0.1, 0.0, 0.0, -0.015), True),
        ((0.5, 0.1, 0.0, 0.0, 0.0, 0.8, 0.2, 0.05), True),  # eight coefficients
        ((0.5, 0.1, 0.0, 0.0, 0.02, 0.8, 0.2, 0.01), False),
    ],
)
def test_a_lens_is_looked_through_as_far_as_what_is_farther_out_is_shown_farther_out(
    distortion: tuple[float, ...], folds: bool
) -> None:
    lens = Lens(np.diag([1000.0, 1000.0, 1.0]), distortion)
    radius = np.linspace(0.0, 1.2 * lens.radius_max, 1201)
    shown_px = lens.to_frame(np.stack([1000.0 * radius, np.zeros_like(radius)], axis=-1))[:, 0]
    grows = np.diff(shown_px) > 0
    assert grows[:998].all()
    assert grows[1002:].any() != folds


@pytest.mark.parametrize(
    "distortion",
    [
        (-0.3, 0.0, 0.0, 0.0, 0.0),  # no ray comes to a pixel beyond the circle
        (-0.28, 0.03, 0.0, 0.0, 0.0),  # rays from beyond the fold do
    ],
)
def test_a_lens_shows_what_lies_in_the_circle_that_its_rays_fill_before_they_fold(
    distortion: tuple[float, ...],
) -> None:
    camera = Camera(np.array([[900.0, 0, 960], [0, 900.0, 540], [0, 0, 1]]), SIZE_WH, distortion)
    on_axis = np.stack([np.linspace(0.0, 4.0, 4001), np.zeros(4001)], axis=-1)
    reach_px = camera.bend(on_axis)[:, 0] - 960
    circle_px = reach_px[np.argmax(np.diff(reach_px) < 0)]
    grid = np.stack(np.meshgrid(np.arange(0.0, 1920, 4), np.arange(0.0, 1080, 4)), axis=-1)
    away_px = np.linalg.norm(grid - [960, 540], axis=-1)
    shown = camera.lens.shows(grid)
    assert shown[away_px < circle_px - 3].all()
    assert not shown[away_px > circle_px + 1].any()
    assert (away_px > circle_px + 1).any()


def test_a_pixel_that_a_lens_shows_is_where_its_ray_comes_to() -> None:
    camera = Camera(np.array([[900.0, 0, 960], [0, 900.0, 540], [0, 0, 1]]), SIZE_WH, (-0.4, 0.0, 0.01, -0.01, 0.0))
    grid = np.stack(np.meshgrid(np.arange(0.0, 1920, 4), np.arange(0.0, 1080, 4)), axis=-1)
    shown = grid[camera.lens.shows(grid)]
    assert 0.3 < len(shown) / (480 * 270) < 0.6
    np.testing.assert_allclose(camera.bend(camera.lens.rays(camera.lens.to_pinhole(shown))[:, :2]), shown, atol=0.5)


def test_what_is_made_smaller_through_a_lens_is_averaged_as_without_one() -> None:
    """Sampled at points, the grain of a sensor would be as coarse as the aircraft."""
    grain = np.random.default_rng(5).integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    bent, straight = (fit_frame(grain, (480, 270), "squash", lens)[0] for lens in (lens_of(K, BARREL), None))
    assert bent[100:-100, 100:-100].std() < 1.2 * straight[100:-100, 100:-100].std()


@pytest.mark.parametrize("away_px", [(180.0, 0.0), (127.0, 127.0)])
def test_a_lens_that_folds_the_picture_shows_nothing_twice(away_px: tuple[float, float]) -> None:
    camera = Camera(np.array([[300.0, 0, 319.5], [0, 300.0, 239.5], [0, 0, 1]]), (640, 480), (-0.3, 0, 0, 0, 0))
    on_frame = np.array([319.5, 239.5]) + away_px
    image, pixel_map = fit_frame(dot((640, 480), on_frame), (640, 480), "squash", camera.lens)
    bright = (image[..., 0] > 100).astype(np.uint8)
    count, _ = cv2.connectedComponents(bright)
    assert count - 1 == 1
    np.testing.assert_allclose(centroid(image), pixel_map.to_network(on_frame), atol=0.5)


def test_windows_off_the_frame_and_beyond_the_lens_are_still_pictures() -> None:
    folding = Lens(np.array([[300.0, 0, 319.5], [0, 300.0, 239.5], [0, 0, 1]]), (-0.3, 0, 0, 0))
    image = np.full((480, 640, 3), 90, np.uint8)
    for box in ([-300, -200, -250, -150], [630, 470, 900, 800], [-1e4, -1e4, 1e4, 1e4], [0, 0, 1, 1]):
        window = window_around(np.array(box, dtype=float), 1.8, NETWORK_WH, (640, 480), folding)
        seen = cut(image, window, NETWORK_WH, folding)
        assert seen.shape == (160, 160, 3)
        assert np.all(seen == 90)  # no black, no noise: the frame's border is repeated


def bent_rectangle(camera: Camera, center_px: tuple[float, float]) -> np.ndarray:
    """The toy target at a place of the pinhole's picture, as the lens throws it on the frame."""
    half = np.array(TARGET_WH) / 2
    columns, rows = np.meshgrid(np.arange(SIZE_WH[0]), np.arange(SIZE_WH[1]))
    left, top = np.array(center_px) - 150
    near = (np.abs(columns - left - 150) < 250) & (np.abs(rows - top - 150) < 250)
    image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    points = np.stack([columns[near], rows[near]], axis=-1).astype(float)
    inside = np.all(np.abs(camera.lens.to_pinhole(points) - center_px) <= half, axis=-1)
    image[rows[near][inside], columns[near][inside]] = 255
    return image


@pytest.mark.parametrize("center", [(960.5, 540.5), (200.5, 150.5), (1750.5, 950.5)])
def test_a_target_seen_through_a_lens_is_where_it_is_and_its_box_where_the_frame_shows_it(
    toy_model: Path, center: tuple[float, float]
) -> None:
    camera = Camera(K, SIZE_WH, BARREL)
    image = bent_rectangle(camera, center)
    frame = Frame(FrameMeta(0, 0, 0), image, K, BARREL)
    estimator = Estimator(load_model(toy_model, 1))
    (found,) = estimator.acquire(frame)
    (tracked,) = estimator.track(frame, [found.box_xyxy_px + 10.0])
    rows, columns = np.nonzero(image[..., 0])
    seen = np.array([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])
    for estimate in (found, tracked):
        assert estimate is not None
        np.testing.assert_allclose(estimate.t_cam_target_m, true_t_cam_target_m(center), rtol=0.02, atol=0.3)
        np.testing.assert_allclose(estimate.box_xyxy_px, seen, atol=3.0)
    # What the lens does is more than what is tolerated: ignoring it must fail.
    naive = Estimator(load_model(toy_model, 1)).acquire(Frame(FrameMeta(0, 0, 0), image, K))
    away_m = [float(np.linalg.norm(e.t_cam_target_m - true_t_cam_target_m(center))) for e in naive]
    if center != (960.5, 540.5):
        assert min(away_m) > 3.0


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BARREL, (-0.45, 0.2, 0.0, 0.0, -0.05)])  # the last one folds
def test_only_a_window_that_lies_wrong_cuts_a_target_off_the_frame_s_edge(distortion: tuple[float, ...]) -> None:
    """Whatever the lens: the whole frame shows it all, and so does a window that lies right."""
    wh, lens = (1920, 1080), lens_of(K, distortion)
    box = np.array([850.0, 500.0, 1010.0, 560.0])
    _, pixel_map = fit_frame(np.zeros((wh[1], wh[0], 3), np.uint8), (768, 448), "letterbox", lens)
    assert not np.any(Shown(pixel_map, pixel_map.intrinsics(K), (768, 448), wh).cut_sides(box))
    aside = window_around([60.0, 60.0, 140.0, 90.0], 1.8, NETWORK_WH, wh, lens).pixel_map(NETWORK_WH, lens)
    view = Shown(aside, aside.intrinsics(K), NETWORK_WH, wh)
    assert grown(np.array([60.0, 60.0, 140.0, 90.0]), view) is None, "where the lens bends most"
    for moved_px, expected in (
        ((0.0, 0.0), [0, 0, 0, 0]),
        ((110.0, 0.0), [1, 0, 0, 0]),
        ((0.0, 110.0), [0, 1, 0, 0]),
        ((-110.0, 0.0), [0, 0, 1, 0]),
        ((0.0, -110.0), [0, 0, 0, 1]),
    ):
        window = window_around(box + np.tile(moved_px, 2), 1.8, NETWORK_WH, wh, lens)
        window_map = window.pixel_map(NETWORK_WH, lens)
        view = Shown(window_map, window_map.intrinsics(K), NETWORK_WH, wh)
        np.testing.assert_array_equal(view.cut_sides(box), np.array(expected, dtype=bool))
        larger = grown(box, view)
        assert (larger is None) == (moved_px == (0.0, 0.0))
        if larger is not None:
            outwards = np.array([-1.0, -1.0, 1.0, 1.0])
            np.testing.assert_allclose(larger - box, 160.0 * outwards * expected)


def test_the_first_frame_through_a_lens_finds_it_worked_out(toy_model: Path) -> None:
    """What of the pinhole's picture the frame holds takes milliseconds, and on a small board a frame."""
    camera_K = np.array([[1990.0, 0.0, 959.5], [0.0, 1990.0, 539.5], [0.0, 0.0, 1.0]])  # of no other test
    camera = CameraInfo("toy", SIZE_WH, camera_K, 30.0, BARREL)
    estimator = warm_estimator(load_model(toy_model, 1), 4, camera)
    worked_out = _extent.cache_info().misses
    image = np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8)
    estimator.acquire(Frame(FrameMeta(1, 1, 1), image, camera_K, BARREL))
    assert _extent.cache_info().misses == worked_out


def test_a_corner_where_the_lens_cannot_be_inverted_has_a_window_all_the_same() -> None:
    distortion = (-1.62, -0.25, 0.0, 0.0, 0.0, 0.54, 0.02, -0.19)
    lens = Lens(np.array([[549.0, 0, 960], [0, 549.0, 540], [0, 0, 1]]), distortion)
    corners = [[0, 0, 40, 20], [1880, 0, 1919, 20], [0, 1060, 40, 1079], [1880, 1060, 1919, 1079]]
    straight = lens.box_to_pinhole(np.array(corners, dtype=float))
    assert not np.isfinite(straight).all(), "there is such a corner"
    image = np.full((1080, 1920, 3), 90, np.uint8)
    for corner in corners:
        window = window_around(np.array(corner, dtype=float), 1.8, NETWORK_WH, SIZE_WH, lens)
        assert cut(image, window, NETWORK_WH, lens).shape == (160, 160, 3)
