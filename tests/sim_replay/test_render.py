"""What the renderer draws lies where OpenCV's projection says it must."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from msgs.geometry import R_from_euler, so3_exp, so3_log
from sim_replay.airframes import AIRFRAMES
from sim_replay.render.placing import crop_K, looking_along
from sim_replay.render.projection import project_px, solid_vertices_m
from sim_replay.render.renderer import Rendered, Renderer
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed

SIDE = 160
UP_500_M = np.array([0.0, 0.0, -500.0])


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(SIDE, SIDE, 4, 2)


def _scene(airframe_id: int, seed: int, long_side_px: float = 110.0) -> Scene:
    """A target off the optical axis, seen from a random side by a camera with a skewless, anisotropic K."""
    rng = np.random.default_rng([seed, airframe_id])
    focal = long_side_px * 250.0 / AIRFRAMES[airframe_id].diameter_m()
    K = np.array([[focal, 0, 75.3], [0, focal * 1.01, 84.2], [0, 0, 1]])
    ray = np.linalg.solve(K, [*rng.uniform(70, 90, 2), 1.0])
    los = R_from_euler(0.0, rng.uniform(-0.6, 0.6), rng.uniform(-3, 3)) @ np.array([1.0, 0, 0])
    camera = Camera(K, SIDE, SIDE, looking_along(los, rng.uniform(-0.5, 0.5), ray), UP_500_M)
    attitude = R_from_euler(rng.uniform(-1, 1), rng.uniform(-0.4, 0.4), rng.uniform(-3, 3))
    target = Target(airframe_id, seed, attitude, UP_500_M + 250.0 * los)
    return Scene(camera, (target,), environment_from_seed(seed))


def _opencv_px(points_m: np.ndarray, scene: Scene, target: int = 0) -> np.ndarray:
    R, t = scene.targets[target].pose_in(scene.camera)
    return cv2.projectPoints(points_m.astype(np.float64), so3_log(R), t, scene.camera.K, None)[0][:, 0]


def _mask_extents(mask: np.ndarray) -> np.ndarray:
    x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    return np.array([x[0], y[0], x[-1], y[-1]], dtype=np.float64)


@pytest.fixture(scope="module")
def drawn(renderer: Renderer) -> list[tuple[Scene, Rendered, int]]:
    scenes = [_scene(airframe, seed) for airframe in range(len(AIRFRAMES)) for seed in (1, 2)]
    out = []
    for start in range(0, len(scenes), renderer.capacity):
        chunk = scenes[start : start + renderer.capacity]
        rendered = renderer.draw(chunk)
        out += [(scene, rendered, k) for k, scene in enumerate(chunk)]
    return out


def test_projection_agrees_with_opencv() -> None:
    for seed in range(10):
        scene = _scene(seed % len(AIRFRAMES), seed)
        points = solid_vertices_m(scene.targets[0].airframe_id)
        ours = project_px(points, *scene.targets[0].pose_in(scene.camera), scene.camera.K)
        np.testing.assert_allclose(ours, _opencv_px(points, scene), atol=0.05)


def test_the_mask_ends_where_opencv_projects_the_outermost_vertices(drawn: list[tuple[Scene, Rendered, int]]) -> None:
    for scene, rendered, k in drawn:
        outline = _opencv_px(solid_vertices_m(scene.targets[0].airframe_id), scene)
        expected = np.concatenate([outline.min(axis=0), outline.max(axis=0)])
        np.testing.assert_allclose(_mask_extents(rendered.coverage[k] > 0), expected, atol=1.0)


def test_each_pixel_names_the_body_point_that_projects_into_it(drawn: list[tuple[Scene, Rendered, int]]) -> None:
    for scene, rendered, k in drawn:
        inside = cv2.erode((rendered.coverage[k] == 255).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rows, columns = np.nonzero(inside)
        assert len(rows) > 2
        diameter = AIRFRAMES[scene.targets[0].airframe_id].diameter_m()
        points = rendered.coordinate[k][rows, columns].astype(np.float64) * diameter
        error = np.linalg.norm(_opencv_px(points, scene) - np.stack([columns, rows], axis=-1), axis=1)
        assert np.median(error) < 0.1
        assert np.quantile(error, 0.98) < 0.75


def test_a_small_target_moves_by_fractions_of_a_pixel(renderer: Renderer) -> None:
    scene = _scene(0, 3, long_side_px=14.0)
    shifts = np.linspace(0.0, 1.0, 8, endpoint=False)
    scenes = []
    for shift in shifts:
        K = scene.camera.K.copy()
        K[0, 2] += shift
        scenes.append(replace(scene, camera=replace(scene.camera, K=K)))
    coverage = renderer.draw(scenes).coverage.astype(np.float64)
    total = coverage.sum(axis=(1, 2))
    centre = (coverage * np.arange(SIDE)).sum(axis=(1, 2)) / total
    # Four samples across a pixel resolve a quarter of it.
    np.testing.assert_allclose(centre - centre[0], shifts, atol=0.15)
    assert total.std() < 0.04 * total.mean()


def test_the_horizon_tilts_with_the_camera(renderer: Renderer) -> None:
    env = environment_from_seed(1)
    black, white = np.zeros(3), np.full(3, 0.9)
    env = replace(
        env, zenith=white, horizon=white, cloud=white, ground=np.zeros((3, 3)), ground_kind=2, haze_per_m=1e-9,
        horizon_away=white, relief_m=0.0, veil=0.0, near_cloud=0.0, sun_colour=black, glow=0.0, cirrus=0.0,
        cloud_threshold=2.0,
    )  # fmt: skip
    K = np.array([[150.0, 0, 79.5], [0, 150.0, 79.5], [0, 0, 1]])
    cameras = [
        Camera(K, SIDE, SIDE, looking_along(np.array([1.0, 0.3, 0.05]), roll, np.array([0.0, 0, 1])), UP_500_M)
        for roll in (0.0, 0.6, -1.2, 2.8)
    ]
    rendered = renderer.draw([Scene(camera, (), env) for camera in cameras])
    u, v = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    rays = np.stack([(u - 79.5) / 150, (v - 79.5) / 150, np.ones_like(u)], axis=-1)
    for k, camera in enumerate(cameras):
        below = (rays @ camera.R_ned_cam.T)[..., 2] > 0
        assert 0.1 < below.mean() < 0.9
        assert np.mean((rendered.image_bgr[k, ..., 0] < 128) == below) > 0.995


def test_the_world_stays_when_the_camera_turns(renderer: Renderer) -> None:
    env = replace(
        environment_from_seed(4), ground_kind=0, haze_per_m=1e-6, ground=np.array([[0.1] * 3, [0.5] * 3, [0.3] * 3])
    )
    K = np.array([[400.0, 0, 79.5], [0, 400.0, 79.5], [0, 0, 1]])
    first = Camera(K, SIDE, SIDE, looking_along(np.array([1.0, 0, 0.6]), 0.0, np.array([0.0, 0, 1])), UP_500_M * 3)
    turned = replace(first, R_ned_cam=first.R_ned_cam @ so3_exp([0.04, -0.06, 0.2]))
    rendered = renderer.draw([Scene(camera, (), env) for camera in (first, turned)])
    homography = K @ turned.R_ned_cam.T @ first.R_ned_cam @ np.linalg.inv(K)
    warped = cv2.warpPerspective(rendered.image_bgr[0], homography, (SIDE, SIDE), borderValue=(0, 0, 0))
    seen = cv2.warpPerspective(np.ones((SIDE, SIDE), np.uint8), homography, (SIDE, SIDE)) > 0
    a, b = (
        image[cv2.erode(seen.astype(np.uint8), np.ones((5, 5))) > 0, 1] for image in (warped, rendered.image_bgr[1])
    )
    assert np.corrcoef(a, b)[0, 1] > 0.95
    assert abs(np.corrcoef(rendered.image_bgr[0, ..., 1].ravel(), rendered.image_bgr[1, ..., 1].ravel())[0, 1]) < 0.6


def test_the_nearer_of_two_targets_hides_the_other(renderer: Renderer) -> None:
    scene = _scene(3, 5)
    target = scene.targets[0]
    sight = target.t_ned_body_m - scene.camera.t_ned_cam_m
    behind = replace(target, t_ned_body_m=scene.camera.t_ned_cam_m + 1.15 * sight + [0.0, 1.5, 0.5])
    orders = [(behind, target), (target, behind)]
    drawn = renderer.draw([scene, *(replace(scene, targets=targets) for targets in orders)])
    alone = drawn.coverage[0] == 255
    for k, number in ((1, 2), (2, 1)):
        assert np.all(drawn.target[k][alone] == number)
        np.testing.assert_allclose(drawn.coordinate[k][alone], drawn.coordinate[0][alone], atol=1e-3)
        assert np.sum(drawn.target[k] == 3 - number) > 30


def test_haze_takes_contrast_with_range(renderer: Renderer) -> None:
    scene = _scene(3, 6)
    clear, thick = (replace(scene, environment=replace(scene.environment, haze_per_m=h)) for h in (1e-6, 0.02))
    rendered = renderer.draw([clear, thick])
    solid = rendered.coverage[0] == 255
    spread = [float(rendered.image_bgr[k][solid].astype(float).std(axis=0).max()) for k in (0, 1)]
    assert spread[1] < 0.1 * spread[0]


def test_a_window_is_the_same_camera() -> None:
    scene = _scene(2, 7)
    points = solid_vertices_m(2)
    whole = _opencv_px(points, scene)
    window = replace(scene, camera=replace(scene.camera, K=crop_K(scene.camera.K, 31.5, 12.25, 1.7, 1.7)))
    np.testing.assert_allclose(_opencv_px(points, window), (whole - [31.5, 12.25] + 0.5) * 1.7 - 0.5, atol=1e-6)
