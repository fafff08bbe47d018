"""Cameras upside down, on their side or on a banking aircraft: the network sees the picture upright."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.config import MountSettings
from edge.estimator.estimator import Estimator
from edge.estimator.model import load_model
from edge.estimator.upright import quarter_turns, turned, turned_back, up_in_cam
from edge.types import Frame, FrameMeta, OwnShip
from msgs.geometry import R_from_euler

from .looping import HELD, Gated, frame, looping
from .test_looks import HEIGHT_PX, WIDTH_PX, K, peaks_of, places, seen_px, turns
from .toy_scene import TARGET_WH
from .toy_scene import K as K_SCENE

FROM_BEHIND = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # what the toy model says of a picture


def rolled(clockwise_deg: float) -> np.ndarray:
    """R_cam_upright [3, 3]: from a camera that is upright to one rolled clockwise, as seen from behind it."""
    c, s = np.cos(np.deg2rad(clockwise_deg)), np.sin(np.deg2rad(clockwise_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@given(turns, places, st.integers(1, 3))
def test_an_aircraft_is_seen_where_the_turned_picture_has_it(R: np.ndarray, t_m: np.ndarray, quarters: int) -> None:
    """What a perfect network says of the turned picture, turned back, is the truth of the picture as it was."""
    image = np.arange(WIDTH_PX * HEIGHT_PX * 3, dtype=np.uint32).astype(np.uint8).reshape(1, HEIGHT_PX, WIDTH_PX, 3)
    upright, K_upright = turned(image, K[None], quarters)
    np.testing.assert_array_equal(upright[0], np.rot90(image[0], quarters))
    R_upright_cam = rolled(90.0 * quarters)  # a picture turned to the left is that of a camera rolled to the right
    t_upright_m = R_upright_cam @ t_m
    origin_px = (K_upright[0] @ t_upright_m)[:2] / t_upright_m[2]
    said = peaks_of(R_upright_cam @ R, t_upright_m, origin_px)
    width, height = (20.0, 40.0) if quarters % 2 else (40.0, 20.0)
    sigma = [0.2, 0.1, 0.3, 0.5, 0.4, 0.6] if quarters % 2 else [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    size_px, sigmas = np.array([[[width, height]]], np.float32), np.array([[sigma]], np.float32)
    said = replace(said, size_px=size_px, sigma=sigmas)
    told = turned_back(said, (WIDTH_PX, HEIGHT_PX), quarters)
    np.testing.assert_allclose(told.R_cam_target[0, 0], R, atol=1e-6)
    np.testing.assert_allclose(told.t_cam_target_m[0, 0], t_m, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(told.origin_px[0, 0], (K @ t_m)[:2] / t_m[2], atol=0.02)
    np.testing.assert_allclose(told.center_px, told.origin_px)
    np.testing.assert_allclose(told.size_px[0, 0], [40.0, 20.0])
    np.testing.assert_allclose(told.sigma[0, 0], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    # The nose and wings lie in the turned picture where its own K projects them.
    there = seen_px(K_upright[0], R_upright_cam @ R, t_upright_m)
    c, s = np.cos(0.5 * np.pi * quarters), np.sin(0.5 * np.pi * quarters)
    middle, middle_upright = (0.5 * (np.array(one.shape[2:0:-1]) - 1.0) for one in (image, upright))
    expected = (seen_px(K, R, t_m) - middle) @ np.array([[c, s], [-s, c]]).T + middle_upright
    np.testing.assert_allclose(there, expected, atol=0.02)


@pytest.mark.parametrize(("bank_deg", "quarters"), [(0.0, 0), (40.0, 0), (60.0, 1), (180.0, 2), (-60.0, 3)])
@pytest.mark.parametrize("mount_deg", [0.0, 90.0, 180.0, -90.0])
def test_up_is_where_mount_and_attitude_have_it(bank_deg: float, quarters: int, mount_deg: float) -> None:
    mount = MountSettings(roll_deg=mount_deg).mount()
    banked = OwnShip(1, R_from_euler(np.deg2rad(bank_deg), 0.1, 2.0), None, None, None)
    # With its right side down, up lies at the left of its picture: three quarters to the left bring it to the top.
    assert quarter_turns(up_in_cam(banked, mount)) == (-quarters - round(mount_deg / 90.0)) % 4
    assert quarter_turns(up_in_cam(None, mount)) == (-round(mount_deg / 90.0)) % 4


def test_a_picture_without_up_is_left_as_it_is() -> None:
    for roll_deg in (0.0, 90.0, 180.0):
        for pitch_deg in (-90.0, -80.0, 80.0):
            assert quarter_turns(up_in_cam(None, MountSettings(roll_deg=roll_deg, pitch_deg=pitch_deg).mount())) == 0
    assert quarter_turns(None) == 0


@pytest.mark.parametrize("roll_deg", [90.0, 180.0, 270.0])
def test_the_network_is_shown_an_upright_picture_whatever_the_camera_s_roll(toy_model: Path, roll_deg: float) -> None:
    """Both stages, plain and mirrored, tell in the rolled camera what an upright one tells."""
    estimator = Estimator(load_model(toy_model, 1))
    upright = frame(0, HELD)
    (expected,) = estimator.acquire(upright)
    quarters = round(roll_deg / 90.0)
    picture, K_rolled = turned(upright.image_bgr[None], K_SCENE[None], quarters)
    R = rolled(roll_deg)
    seen = Frame(FrameMeta(0, 0, 0), picture[0], K_rolled[0], up_cam=R @ [0.0, -1.0, 0.0])
    (found,) = estimator.acquire(seen)
    estimates = [found, *estimator.track(seen, [found.box_xyxy_px]), *estimator.track(seen, [found.box_xyxy_px])]
    for one in estimates:
        assert one is not None
        np.testing.assert_allclose(one.R_cam_target, R @ FROM_BEHIND, atol=1e-5)
        np.testing.assert_allclose(one.t_cam_target_m, R @ expected.t_cam_target_m, rtol=2e-3, atol=0.1)
        size_wh = one.box_xyxy_px[2:] - one.box_xyxy_px[:2]
        np.testing.assert_allclose(size_wh, TARGET_WH[::-1] if quarters % 2 else TARGET_WH, atol=1.0)


def test_a_camera_that_is_mounted_upside_down_needs_no_more_than_to_be_told_so(toy_model: Path) -> None:
    gated = Gated(load_model(toy_model, 1))
    with looping(gated, mount={"roll_deg": 180.0}) as (loop, ear, _):
        for index in range(5):
            seen = frame(index, HELD)
            picture, K_rolled = turned(seen.image_bgr[None], K_SCENE[None], 2)
            loop._process(replace(seen, image_bgr=picture[0], K=K_rolled[0]))
        (track,) = ear.reports[-1].tracks
    np.testing.assert_allclose(track.R_cam_target, rolled(180.0) @ FROM_BEHIND, atol=1e-3)
