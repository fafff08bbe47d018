"""What of the own aircraft is in the picture is no target, and is not taken for part of one."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from edge.cameras.own_ship_mask import load_own_parts
from edge.config_camera import FolderCamera
from edge.errors import InputError
from edge.estimator.decode import decode
from edge.estimator.model import load_model
from edge.estimator.own_parts import OwnParts
from edge.types import Estimate
from msgs.contract import ModelContract

from .looping import HELD, OTHER, Gated, box_around, frame, looping
from .test_decode import CONTRACT, WHOLE, peaks_of
from .toy_scene import SIZE_WH

SIDES = st.integers(30, 200)


def mask_of(size_wh: tuple[int, int], *boxes_xyxy: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    mask = np.zeros((size_wh[1], size_wh[0]), np.uint8)
    for x0, y0, x1, y1 in boxes_xyxy:
        mask[y0:y1, x0:x1] = 255
    return mask


def test_a_wing_tip_takes_the_colours_of_the_sky_around_it() -> None:
    rows = np.linspace(230.0, 120.0, 720)[:, None, None] * np.array([1.0, 0.9, 0.7])
    sky = np.broadcast_to(rows, (720, 1280, 3)).astype(np.uint8)
    mask = np.zeros((720, 1280), np.uint8)
    cv2.fillPoly(mask, [np.array([[1279, 300], [1000, 420], [990, 300], [1020, 300], [1040, 380]])], 255)
    picture = np.where(mask[..., None] > 0, np.uint8(255), sky)
    before = picture.copy()
    painted = OwnParts.of(mask, (1280, 720)).hide(picture)
    assert np.abs(painted.astype(int) - sky).max() < 20
    np.testing.assert_array_equal(painted[mask == 0], sky[mask == 0])
    np.testing.assert_array_equal(picture, before)


@given(SIDES, SIDES, st.tuples(st.integers(0, 150), st.integers(0, 150), SIDES, SIDES), st.integers(0, 10**6))
def test_only_what_is_covered_is_painted_whatever_the_picture_s_size(
    width: int, height: int, part_xywh: tuple[int, int, int, int], seed: int
) -> None:
    x, y, w, h = part_xywh
    mask = mask_of((width, height), (x, y, x + w, y + h))
    image = np.random.default_rng(seed).integers(40, 200, (height, width, 3)).astype(np.uint8)
    painted = OwnParts.of(mask, (width, height)).hide(image)
    np.testing.assert_array_equal(painted[mask == 0], image[mask == 0])
    samples = mask[8::16, 8::16] == 0
    if samples.any():  # otherwise there is no colour to take
        assert painted.min() >= 39
        assert painted.max() <= 200


@given(
    st.tuples(st.integers(0, 60), st.integers(0, 40), st.integers(1, 30), st.integers(1, 30)),
    st.tuples(*[st.floats(-30.0, 100.0)] * 2),
    st.tuples(*[st.floats(0.0, 60.0)] * 2),
)
def test_a_box_touches_what_any_of_its_pixels_shows(
    part_xywh: tuple[int, int, int, int], corner: tuple[float, float], size: tuple[float, float]
) -> None:
    x, y, w, h = part_xywh
    mask = mask_of((64, 48), (x, y, x + w, y + h))
    box = np.array([*corner, *(np.array(corner) + size)])
    rows, columns = np.nonzero(mask)
    inside = (columns + 0.5 >= box[0]) & (columns - 0.5 <= box[2]) & (rows + 0.5 >= box[1]) & (rows - 0.5 <= box[3])
    on_a_border = np.any(np.abs((box + 0.5) - np.round(box + 0.5)) < 1e-9)
    assert OwnParts.of(mask, (64, 48)).touches(box) == bool(inside.any()) or on_a_border


def seen_beside(own_xyxy: tuple[int, int, int, int]) -> tuple[list[Estimate], Counter[str]]:
    """What is made of a sure target at columns 640 to 720 and rows 480 to 520."""
    peaks, refused, contract = peaks_of(score=1.0), Counter[str](), ModelContract(**CONTRACT)
    peaks.center_px[:] = peaks.origin_px[:] = [680.0, 500.0]
    peaks.size_px[:] = [80.0, 40.0]
    shown = WHOLE._replace(own_parts=OwnParts.of(mask_of(WHOLE.frame_wh, own_xyxy), WHOLE.frame_wh))
    return decode(peaks, 0, shown, contract, "track", contract.track_score_min, refused), refused


def test_a_target_behind_the_own_wing_is_told_with_the_doubts_of_one_that_is_cut() -> None:
    ((beside,), _), ((behind,), _) = seen_beside((760, 300, 1900, 900)), seen_beside((710, 300, 1900, 900))
    sigma = [e.covariance[2, 2] ** 0.5 / e.t_cam_target_m[2] for e in (beside, behind)]
    assert sigma == pytest.approx([0.05, np.hypot(0.05, 0.4)], rel=1e-3)
    assert seen_beside((670, 300, 1900, 900)) == ([], Counter(cut_off=1)), "its middle is hidden"


def test_the_loop_tracks_nothing_of_the_own_aircraft_and_shows_the_picture_as_it_is(toy_model: Path) -> None:
    x0, y0, x1, y1 = (int(side) for side in box_around(HELD) + np.array([-20, -20, 20, 20]))
    half_size = (SIZE_WH[0] // 2, SIZE_WH[1] // 2)  # as after a change of the camera's mode
    mask = mask_of(half_size, (x0 // 2, y0 // 2, x1 // 2, y1 // 2))
    with looping(Gated(load_model(toy_model, 1)), own_parts=OwnParts.of(mask, half_size)) as (loop, ear, _):
        for index in range(5):
            loop._process(frame(index, HELD))
            assert ear.reports[-1].tracks == ()
        for index in range(5, 12):
            loop._process(frame(index, HELD, OTHER))
    (track,) = ear.reports[-1].tracks
    np.testing.assert_allclose(track.box_xyxy_px, box_around(OTHER), atol=3.0)
    np.testing.assert_array_equal(ear.shown[-1].image_bgr, frame(0, HELD, OTHER).image_bgr)


def test_a_wire_is_hidden_again_after_pictures_too_small_to_show_it(toy_model: Path) -> None:
    mask = mask_of(SIZE_WH, (300, 0, 302, SIZE_WH[1]))
    usual = frame(0, HELD)
    small = replace(usual, image_bgr=cv2.resize(usual.image_bgr, (320, 180)), K=usual.K * [[1 / 6], [1 / 6], [1]])
    with looping(Gated(load_model(toy_model, 1)), own_parts=OwnParts.of(mask, SIZE_WH)) as (loop, _, _):
        for one in (usual, small, usual):
            seen = loop._without_own_parts(one)
    assert seen.own_parts is not None
    np.testing.assert_array_equal(seen.own_parts.covered, mask)


def parts_from(mask: Path) -> OwnParts | None:
    intrinsics = {"fx": 900.0, "fy": 900.0, "cx": 479.5, "cy": 269.5, "width": 960, "height": 540}
    camera = FolderCamera.model_validate(
        {"type": "folder", "path": mask.parent, "intrinsics": intrinsics, "own_ship_mask": mask}
    )
    return load_own_parts(camera, (960, 540))


def test_a_mask_is_scaled_to_the_picture(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "own.png"), mask_of((1920, 1080), (0, 0, 480, 540)))
    parts = parts_from(tmp_path / "own.png")
    assert parts is not None
    assert parts.share == pytest.approx(0.125)
    assert parts.touches([100.0, 100.0, 110.0, 110.0])
    assert not parts.touches([250.0, 100.0, 260.0, 110.0])


def test_a_mask_that_does_not_fit_or_hides_most_of_the_picture_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "crop.png"), mask_of((960, 480), (0, 0, 100, 100)))
    cv2.imwrite(str(tmp_path / "inverse.png"), 255 - mask_of((960, 540), (0, 0, 480, 270)))
    cv2.imwrite(str(tmp_path / "black.png"), mask_of((960, 540)))
    (tmp_path / "text.png").write_text("no picture")
    for name, reason in (
        ("crop.png", "is for 960x480 pixels, but the camera gives 960x540"),
        ("inverse.png", "is white over 75 % of the picture"),
        ("black.png", "is white over 0 % of the picture"),
        ("text.png", "is not a readable picture"),
        ("absent.png", "cannot be read: No such file"),
    ):
        with pytest.raises(InputError, match=reason) as refused:
            parts_from(tmp_path / name)
        assert refused.value.key == ("camera", "own_ship_mask")
