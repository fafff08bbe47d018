"""Whole frames: every target's label is what OpenCV's projection and the picture itself say it must be."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from msgs.geometry import R_from_euler, so3_log
from sim_replay.render.frame import RenderedFrame, mask_extents_px, render_frame
from sim_replay.render.placing import looking_along
from sim_replay.render.projection import Distortion, solid_vertices_m
from sim_replay.render.scene import WEATHERS, Camera, Environment, Scene, Target, environment_from_seed
from sim_replay.render.sensor import Sensor

WIDTH, HEIGHT = 640, 360
FOCAL = 1400.0
PERFECT = Sensor(0.0, (0.0, 0.0), 1.0, 1.0, 1.0, (1.0, 1.0, 1.0), 0.0, 0.0, None)
LENSES: tuple[Distortion | None, ...] = (None, (-0.28, 0.09, 0.001, -0.002, 0.01), (0.15, -0.05, -0.002, 0.001, 0.0))


def _plain() -> Environment:
    """White sky all round, a black sun: aircraft are dark, nothing else is."""
    white = np.full(3, 0.9)
    return replace(
        environment_from_seed(1, "clear"), zenith=white, horizon=white, horizon_away=white, cloud=white,
        sun_colour=np.zeros(3), glow=0.0, cirrus=0.0, cloud_threshold=2.0, haze_per_m=1e-9, relief_m=0.0, veil=0.0,
        near_cloud=0.0, ground=np.zeros((3, 3)),
    )  # fmt: skip


def _camera(distortion: Distortion | None = None, up: float = 0.25) -> Camera:
    K = np.array([[FOCAL, 0, 318.2], [0, FOCAL * 1.01, 181.4], [0, 0, 1]])
    R = looking_along(np.array([1.0, 0.4, -up]), 0.1, np.array([0.0, 0.0, 1.0]))
    return Camera(K, WIDTH, HEIGHT, R, np.array([0.0, 0.0, -800.0]), distortion)


def _target(
    camera: Camera, airframe_id: int, pixel: tuple[float, float], range_m: float, yaw_rad: float = 0.7
) -> Target:
    ray = np.linalg.solve(camera.K, [*pixel, 1.0])
    t = camera.t_ned_cam_m + camera.R_ned_cam @ (ray / np.linalg.norm(ray)) * range_m
    return Target(airframe_id, 3, R_from_euler(0.5, 0.15, yaw_rad), t)


def _opencv_px(points_m: np.ndarray, target: Target, camera: Camera) -> np.ndarray:
    R, t = target.pose_in(camera)
    return cv2.projectPoints(points_m.astype(np.float64), so3_log(R), t, camera.K, np.array(camera.distortion or ()))[
        0
    ][:, 0]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("pixel", [(320.0, 180.0), (95.0, 70.0), (545.0, 300.0)])
def test_labels_lie_where_opencv_projects_the_aircraft(lens: Distortion | None, pixel: tuple[float, float]) -> None:
    camera = _camera(lens)
    target = _target(camera, 3, pixel, 160.0)
    seen = render_frame(Scene(camera, (target,), _plain()), PERFECT).targets[0]
    outline = _opencv_px(solid_vertices_m(3), target, camera)
    expected = np.concatenate([outline.min(axis=0), outline.max(axis=0)])
    assert seen.box_visible_xyxy_px is not None
    np.testing.assert_allclose(seen.box_visible_xyxy_px, expected, atol=0.05)
    assert seen.box_whole_xyxy_px == seen.box_visible_xyxy_px
    extents = mask_extents_px(seen.mask_visib)
    assert extents is not None
    np.testing.assert_allclose(extents, expected, atol=1.0)
    np.testing.assert_allclose(seen.origin_px, _opencv_px(np.zeros((1, 3)), target, camera)[0], atol=0.05)
    assert seen.visible_px == seen.whole_px == seen.mask.sum()


@pytest.mark.parametrize("lens", LENSES)
def test_the_mask_is_where_the_picture_shows_the_aircraft(lens: Distortion | None) -> None:
    camera = _camera(lens)
    target = _target(camera, 0, (120.0, 260.0), 150.0)
    frame = render_frame(Scene(camera, (target,), _plain()), PERFECT)
    dark = frame.image_bgr[..., 1] < 190
    mask = frame.targets[0].mask_visib
    assert np.sum(dark & mask) / np.sum(dark | mask) > 0.85
    assert not np.any(dark & ~(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0))


def test_a_lens_bends_the_horizon_as_opencv_does() -> None:
    lens = LENSES[1]
    camera = _camera(lens, up=0.0)
    env = replace(_plain(), ground_kind=2)
    image = render_frame(Scene(camera, (), env), PERFECT).image_bgr
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)[:, None]
    plane = cv2.undistortPoints(pixels, camera.K, np.array(lens), None, None, None)[:, 0]
    down = np.hstack([plane, np.ones((len(plane), 1))]) @ camera.R_ned_cam[2]
    assert np.mean((image[..., 1] < 128) == (down > 0).reshape(HEIGHT, WIDTH)) > 0.998


def _area(mask: np.ndarray) -> int:
    return int(mask.sum())


def test_several_targets_hide_each_other_by_range_whatever_their_order() -> None:
    camera = _camera()
    near, far = _target(camera, 3, (300, 180), 150.0), _target(camera, 0, (325, 190), 330.0, yaw_rad=2.0)
    aside = _target(camera, 5, (560, 60), 400.0)
    scene = Scene(camera, (near, far, aside), _plain())
    frames = [
        render_frame(replace(scene, targets=order), PERFECT) for order in ((near, far, aside), (aside, far, near))
    ]
    np.testing.assert_array_equal(frames[0].image_bgr, frames[1].image_bgr)
    a, b, c = frames[0].targets
    for seen, other in zip((a, b, c), reversed(frames[1].targets), strict=True):
        np.testing.assert_array_equal(seen.mask_visib, other.mask_visib)
        assert seen.box_visible_xyxy_px == other.box_visible_xyxy_px
    assert a.visible_px == a.whole_px
    assert c.visible_px == c.whole_px
    alone = render_frame(replace(scene, targets=(far,)), PERFECT).targets[0]
    np.testing.assert_array_equal(b.mask, alone.mask)
    np.testing.assert_array_equal(b.mask_visib, alone.mask & ~a.mask)
    assert 0 < b.visible_px < b.whole_px
    assert b.box_whole_xyxy_px == alone.box_whole_xyxy_px
    assert b.box_visible_xyxy_px == mask_extents_px(b.mask_visib)


def test_a_target_beyond_the_picture_has_a_whole_box_and_no_visible_one() -> None:
    camera = _camera()
    frame = render_frame(Scene(camera, (_target(camera, 3, (-150, 180), 150.0),), _plain()), PERFECT)
    seen = frame.targets[0]
    assert seen.box_visible_xyxy_px is None
    assert seen.visible_px == seen.whole_px == 0
    assert seen.box_whole_xyxy_px is not None
    assert seen.box_whole_xyxy_px[2] < 0


def test_the_picture_cuts_a_target_that_leaves_it() -> None:
    camera = _camera()
    seen = render_frame(Scene(camera, (_target(camera, 3, (4, 180), 150.0),), _plain()), PERFECT).targets[0]
    assert seen.box_visible_xyxy_px is not None
    assert seen.box_whole_xyxy_px is not None
    assert seen.box_visible_xyxy_px[0] == -0.5
    assert seen.box_whole_xyxy_px[0] < -20
    np.testing.assert_allclose(seen.box_visible_xyxy_px[2], seen.box_whole_xyxy_px[2], atol=1.5)


def test_cloud_before_the_target_takes_its_pixels() -> None:
    camera = _camera()
    env = replace(environment_from_seed(8, "clear"), near_cloud=0.0)
    scene = Scene(camera, (_target(camera, 3, (320, 180), 130.0),), env)
    clear = render_frame(scene, PERFECT).targets[0]
    shares = []
    for offset in np.linspace(0.0, 0.9, 6):
        cloudy = replace(env, near_cloud=0.6, noise_offset=(float(offset), 0.3))
        frame = render_frame(replace(scene, environment=cloudy), PERFECT)
        seen = frame.targets[0]
        np.testing.assert_array_equal(seen.mask, clear.mask)
        assert not np.any(seen.mask_visib & ~seen.mask)
        shares.append(seen.visible_px / seen.whole_px)
        hidden = seen.mask & ~seen.mask_visib
        if _area(hidden) > 200 and _area(seen.mask_visib) > 200:
            spread = [frame.image_bgr[..., 1][m].astype(float).std() for m in (hidden, seen.mask_visib)]
            assert spread[0] < spread[1]
    assert min(shares) < 0.5 < max(shares)


def test_birds_before_the_target_hide_it_and_birds_behind_do_not() -> None:
    camera = _camera()
    scene = Scene(camera, (_target(camera, 3, (320, 180), 90.0),), _plain())
    clear = render_frame(scene, PERFECT)
    crossed = passed_behind = 0
    for seed in range(6):
        frame = render_frame(replace(scene, sensor_seed=seed, distractors=40), PERFECT)
        seen = frame.targets[0]
        assert np.any(frame.image_bgr != clear.image_bgr)
        np.testing.assert_array_equal(seen.mask, clear.targets[0].mask)
        crossed += seen.whole_px - seen.visible_px
        solid = cv2.erode(seen.mask_visib.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        changed = np.abs(frame.image_bgr[solid].astype(int) - clear.image_bgr[solid]).max(axis=1) > 12
        passed_behind += int(changed.sum())
    assert crossed > 25
    # What is left to see of the target looks as it did: only the birds' soft edges reach into it.
    assert passed_behind < 0.3 * crossed


def test_birds_move_little_from_frame_to_frame() -> None:
    scene = Scene(_camera(), (), _plain(), sensor_seed=5, distractors=12)
    dark = [render_frame(replace(scene, frame_index=k), PERFECT).image_bgr[..., 1] < 150 for k in (0, 1, 40)]
    assert _area(dark[0]) > 20
    near = cv2.dilate(dark[0].astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    assert np.mean(near[dark[1]]) > 0.9
    assert np.mean(near[dark[2]]) < 0.9


@pytest.mark.parametrize("weather", WEATHERS)
def test_every_weather_shows_a_world_and_the_same_one_again(weather: str) -> None:
    env = environment_from_seed(11, weather, sight_ned=np.array([1.0, 0.4, -0.1]))  # type: ignore[arg-type]
    scene = Scene(_camera(up=0.05), (), env)
    first: RenderedFrame = render_frame(scene, PERFECT)
    assert 10 < first.image_bgr.mean() < 250
    np.testing.assert_array_equal(first.image_bgr, render_frame(scene, PERFECT).image_bgr)


def test_the_sun_stands_near_the_line_of_sight_in_glare() -> None:
    sight = R_from_euler(0.0, 0.1, 2.0) @ np.array([1.0, 0.0, 0.0])
    away = [
        np.degrees(np.arccos(environment_from_seed(seed, "glare", sight_ned=sight).sun_ned @ sight))
        for seed in range(40)
    ]
    assert np.median(away) < 16
    assert max(away) < 45


def test_fog_hides_more_with_range() -> None:
    camera = _camera()
    env = environment_from_seed(3, "fog")
    contrast = []
    for range_m in (100.0, 400.0):
        frame = render_frame(Scene(camera, (_target(camera, 3, (320, 180), range_m),), env), PERFECT)
        mask = frame.targets[0].mask_visib
        grey = frame.image_bgr[..., 1].astype(float)
        contrast.append(np.abs(grey[mask] - np.median(grey[~mask])).mean())
    assert contrast[1] < 0.6 * contrast[0]
