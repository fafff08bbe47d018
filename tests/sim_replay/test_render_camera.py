"""Shutter, sensor and backdrops: blur is what many short exposures add up to; marks of the camera are reproducible."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs.geometry import R_from_euler, so3_exp
from sim_replay.render.backdrop import BackdropError, load_backdrop
from sim_replay.render.frame import render_frame
from sim_replay.render.placing import looking_along
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed, rays_ned
from sim_replay.render.sensor import Sensor, drifted, exposed, sensor_from

WIDTH, HEIGHT, FOCAL = 480, 320, 900.0
PERFECT = Sensor(0.0, (0.0, 0.0), 1.0, 1.0, 1.0, (1.0, 1.0, 1.0), 0.0, 0.0, None)
K = np.array([[FOCAL, 0, 239.5], [0, FOCAL, 159.5], [0, 0, 1]])


def _scene(up: float = 0.2) -> Scene:
    R = looking_along(np.array([1.0, 0.2, -up]), 0.1, np.array([0.0, 0.0, 1.0]))
    camera = Camera(K, WIDTH, HEIGHT, R, np.array([0.0, 0.0, -600.0]))
    t = camera.t_ned_cam_m + R @ np.array([3.0, -2.0, 110.0])
    env = replace(environment_from_seed(2, "clear"), near_cloud=0.0, veil=0.0, ground_kind=0, haze_per_m=1e-5)
    return Scene(camera, (Target(3, 4, R_from_euler(0.4, 0.1, 1.0), t),), env)


def _moved(scene: Scene, share: float, turn_cam_rad: np.ndarray, shift_m: np.ndarray) -> Scene:
    camera = replace(scene.camera, R_ned_cam=scene.camera.R_ned_cam @ so3_exp(share * turn_cam_rad))
    targets = tuple(replace(t, t_ned_body_m=t.t_ned_body_m + share * shift_m) for t in scene.targets)
    return replace(scene, camera=camera, targets=targets)


def _linear(scene: Scene) -> np.ndarray:
    return np.square(render_frame(scene, PERFECT).image_bgr.astype(np.float64) / 255)


@pytest.mark.parametrize(
    ("turn_px", "roll_rad", "shift_m"),
    [((7.0, 0.0), 0.0, 0.0), ((0.0, 6.0), 0.0, 1.0), ((0.0, 0.0), 0.0, 1.2), ((2.0, 1.0), 0.03, 0.0)],
)
def test_blur_is_the_average_of_the_exposure(turn_px: tuple[float, float], roll_rad: float, shift_m: float) -> None:
    scene = _scene(up=-0.35)
    turn = np.array([-turn_px[1] / FOCAL, turn_px[0] / FOCAL, roll_rad]) / 2
    shift = scene.camera.R_ned_cam @ np.array([0.8, 0.6, 0.0]) * shift_m / 2
    close = _moved(scene, 1.0, turn, shift)
    blurred = _linear(replace(scene, shutter_close=(close.camera, close.targets)))
    instants = [_linear(_moved(scene, share, turn, shift)) for share in np.linspace(-1.0, 1.0, 9)]
    truth, sharp = np.mean(instants, axis=0), instants[4]
    inside = np.s_[20:-20, 20:-20]
    error, unblurred = (np.abs(image - truth)[inside].mean() for image in (blurred, sharp))
    assert error < 0.4 * unblurred
    # The other direction would be as wrong as none at all.
    mirrored = replace(
        scene, shutter_close=(_moved(scene, 1.0, turn[[1, 0, 2]], -shift[[1, 0, 2]]).camera, close.targets)
    )
    if roll_rad == 0.0 and shift_m == 0.0:
        assert np.abs(_linear(mirrored) - truth)[inside].mean() > 2.0 * error


def test_labels_do_not_move_with_the_blur() -> None:
    scene = _scene()
    close = _moved(scene, 1.0, np.array([0.0, 0.01, 0.0]), np.zeros(3))
    still = render_frame(scene, PERFECT).targets[0]
    moving = render_frame(replace(scene, shutter_close=(close.camera, close.targets)), PERFECT).targets[0]
    np.testing.assert_array_equal(still.mask_visib, moving.mask_visib)
    assert still.box_visible_xyxy_px == moving.box_visible_xyxy_px


def test_the_same_frame_has_the_same_bytes_and_the_next_has_other_noise() -> None:
    scene = replace(_scene(), sensor_seed=7, distractors=3)
    sensor = sensor_from(np.random.default_rng(1), "poor")
    first, again = (render_frame(scene, sensor).image_bgr for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != render_frame(replace(scene, frame_index=1), sensor).image_bgr)


def test_exposure_wanders_slowly_and_within_its_bounds() -> None:
    sensor = replace(PERFECT, drift=0.1)
    gains = np.array([drifted(sensor, 5, k).gain for k in range(400)])
    assert np.abs(np.diff(gains)).max() < 0.03
    assert 0.05 < np.ptp(gains) <= 0.2
    assert gains.min() >= 0.9 - 1e-9


def test_worse_cameras_have_more_noise() -> None:
    grey = np.full((200, 200, 3), 120, np.uint8)
    spread = {}
    for quality in ("good", "ordinary", "poor"):
        each = []
        for seed in range(30):
            sensor = replace(sensor_from(np.random.default_rng(seed), quality), jpeg_quality=None)  # type: ignore[arg-type]
            each.append(exposed(grey, sensor, 1.0, np.random.default_rng(seed)).astype(float).std(axis=(0, 1)).mean())
        spread[quality] = np.median(each)
    assert spread["good"] < spread["ordinary"] < spread["poor"]


def test_noise_is_as_strong_as_asked_and_unbiased() -> None:
    grey = np.full((300, 300, 3), 128, np.uint8)
    out = exposed(grey, replace(PERFECT, noise=0.02), 1.0, np.random.default_rng(0)).astype(float)
    assert out.std() == pytest.approx(0.02 * 255, rel=0.05)
    assert out.mean() == pytest.approx(128, abs=0.2)


def test_a_mosaic_keeps_colours_and_frays_fine_detail() -> None:
    mosaic = replace(PERFECT, mosaic=True)
    flat = np.tile(np.array([40, 120, 220], np.uint8), (64, 64, 1))
    out = exposed(flat, mosaic, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(out[4:-4, 4:-4], flat[4:-4, 4:-4])
    lines = np.zeros((64, 64, 3), np.uint8)
    lines[:, ::3] = 255
    coloured = exposed(lines, mosaic, 1.0, np.random.default_rng(0)).astype(int)
    assert np.ptp(coloured[8:-8, 8:-8], axis=2).max() > 40


def _bright_spot_px(image_bgr: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(image_bgr[..., 1] > 200)
    return np.array([columns.mean(), rows.mean()])


def test_a_panorama_stands_in_the_world(tmp_path: Path) -> None:
    """A lamp in the panorama appears where its direction projects, also when the camera turns; HDR values fit."""
    panorama = np.full((512, 1024, 3), 0.05, np.float32)
    cv2.circle(panorama, (512, 220), 5, (40.0, 40.0, 40.0), -1)
    path = tmp_path / "sky.hdr"
    assert cv2.imwrite(str(path), panorama)
    elevation = np.pi / 2 - (220.5 / 512) * np.pi
    azimuth = (512.5 / 1024 - 0.5) * 2 * np.pi
    spot = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)])
    for yaw in (0.0, 0.1):
        R = looking_along(R_from_euler(0.0, 0.2, yaw) @ np.array([1.0, 0.0, 0.0]), 0.15, np.array([0.0, 0.0, 1.0]))
        camera = Camera(K, WIDTH, HEIGHT, R, np.array([0.0, 0.0, -600.0]))
        scene = Scene(camera, (), replace(environment_from_seed(1, "clear"), near_cloud=0.0, veil=0.0), backdrop=path)
        cam = R.T @ spot
        expected = K[:2, :2] @ (cam[:2] / cam[2]) + K[:2, 2]
        np.testing.assert_allclose(_bright_spot_px(render_frame(scene, PERFECT).image_bgr), expected, atol=1.0)


def test_a_photograph_fills_the_view_and_turns_with_the_world(tmp_path: Path) -> None:
    photo = np.random.default_rng(0).integers(0, 255, (60, 100, 3)).astype(np.uint8)
    path = tmp_path / "hills.jpg"
    cv2.imwrite(str(path), cv2.resize(photo, (1200, 720), interpolation=cv2.INTER_CUBIC))
    scene = replace(_scene(up=0.0), targets=(), backdrop=path)
    turned = replace(scene, camera=replace(scene.camera, R_ned_cam=scene.camera.R_ned_cam @ so3_exp([0.02, 0.05, 0.0])))
    a, b = (render_frame(s, PERFECT).image_bgr for s in (scene, turned))
    homography = K @ turned.camera.R_ned_cam.T @ scene.camera.R_ned_cam @ np.linalg.inv(K)
    warped = cv2.warpPerspective(a, homography, (WIDTH, HEIGHT))
    seen = cv2.warpPerspective(np.ones((HEIGHT, WIDTH), np.uint8), homography, (WIDTH, HEIGHT)) > 0
    assert np.corrcoef(warped[seen].ravel(), b[seen].ravel())[0, 1] > 0.95
    assert a.std() > 20


def test_a_photograph_of_16_bits_looks_as_it_does_in_8(tmp_path: Path) -> None:
    image = np.random.default_rng(6).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    image[:20] //= 8  # a dark half, which exposing for the middle would lift
    for name, picture in (("8.png", image), ("16.png", image.astype(np.uint16) * 257)):
        assert cv2.imwrite(str(tmp_path / name), picture)
    np.testing.assert_array_equal(
        load_backdrop(tmp_path / "16.png").image_rgb, load_backdrop(tmp_path / "8.png").image_rgb
    )


def test_a_backdrop_that_is_no_picture_is_named(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("clouds")
    with pytest.raises(BackdropError, match=r"notes\.txt is not a readable picture"):
        render_frame(replace(_scene(), backdrop=path), PERFECT)


def test_rays_invert_the_projection() -> None:
    camera = replace(_scene().camera, distortion=(-0.25, 0.08, 0.001, -0.001, 0.0))
    pixels = np.random.default_rng(0).uniform([0, 0], [WIDTH, HEIGHT], (50, 2))
    cam = rays_ned(pixels, camera) @ camera.R_ned_cam
    back = cv2.projectPoints(cam, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0][:, 0]
    np.testing.assert_allclose(back, pixels, atol=1e-3)
