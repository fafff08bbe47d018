"""The picture of a score: lines where OpenCV's own projection puts them, and a video that plays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sim_replay.overlay import (
    ESTIMATE_BGR,
    TRUTH_BGR,
    Extents,
    FrameView,
    Overlay,
    draw_pose,
    project,
    showcase_index,
    window_camera,
)
from sim_replay.report.film import write_video
from sim_replay.score import Match, TargetPose, Truth

K = np.array([[900.0, 0.0, 319.5], [0.0, 900.0, 179.5], [0.0, 0.0, 1.0]])
SIZE_WH = (640, 360)
EXTENTS = Extents((-3.0, -6.0, -1.0), (6.0, 12.0, 2.0))


def truth(frame: int = 0, t_cam_target_m: tuple[float, float, float] = (0.0, 0.0, 60.0)) -> Truth:
    R = Rotation.from_euler("xyz", [80, 20, 30], degrees=True).as_matrix()
    return Truth(frame, R, np.array(t_cam_target_m), object_id=1, diameter_m=12.0)


def view(frame: int, turned_deg: float | None, t_cam_target_m: tuple[float, float, float] = (0, 0, 60)) -> FrameView:
    target = truth(frame, t_cam_target_m)
    if turned_deg is None:
        return FrameView(K, Match(target, None), EXTENTS, None)
    R = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix() @ target.R_cam_target
    return FrameView(K, Match(target, TargetPose(frame, R, target.t_cam_target_m)), EXTENTS, 12.5)


def black() -> np.ndarray:
    return np.zeros((360, 640, 3), np.uint8)


def drawn(image: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return np.asarray((image == np.array(color)).all(axis=-1))


def test_the_box_lies_where_opencv_projects_its_corners() -> None:
    canvas = np.zeros((360, 640, 3), np.uint8)
    pose = truth()
    draw_pose(canvas, K, pose, EXTENTS, TRUTH_BGR, 2)
    rvec = Rotation.from_matrix(pose.R_cam_target).as_rotvec()
    corners, _ = cv2.projectPoints(EXTENTS.corners_m(), rvec, pose.t_cam_target_m, K, np.zeros(4))
    near = cv2.dilate(drawn(canvas, TRUTH_BGR).astype(np.uint8), np.ones((3, 3), np.uint8))
    for u, v in corners.reshape(-1, 2):
        assert near[round(v), round(u)]


def test_of_a_rotation_that_is_not_known_nothing_is_drawn_but_the_place() -> None:
    canvas = np.zeros((360, 640, 3), np.uint8)
    pose = replace(truth(t_cam_target_m=(8.0, 2.0, 60.0)), rotation_known=False)
    draw_pose(canvas, K, pose, EXTENTS, ESTIMATE_BGR, 2)
    rows, columns = np.nonzero(canvas.any(axis=-1))
    u, v = (K @ pose.t_cam_target_m)[:2] / 60.0
    assert (rows.mean(), columns.mean()) == pytest.approx((v, u), abs=1.0)
    assert rows.max() - rows.min() < 30
    assert columns.max() - columns.min() < 30


def test_a_target_that_reaches_behind_the_camera_is_not_drawn() -> None:
    canvas = np.zeros((360, 640, 3), np.uint8)
    draw_pose(canvas, K, truth(t_cam_target_m=(0.0, 0.0, 2.0)), EXTENTS, TRUTH_BGR, 2)
    assert not canvas.any()


@given(
    left=st.integers(0, 500), top=st.integers(0, 200), scale=st.floats(0.2, 12.0),
    x=st.floats(-20, 20), y=st.floats(-10, 10), z=st.floats(50, 500),
)  # fmt: skip
def test_projecting_into_a_window_is_cropping_and_resizing_the_projection(
    left: int, top: int, scale: float, x: float, y: float, z: float
) -> None:
    whole = project([[x, y, z]], K)
    window = project([[x, y, z]], window_camera(K, (left, top), scale))
    assert whole is not None
    assert window is not None
    np.testing.assert_allclose(window, (whole - [left, top] + 0.5) * scale - 0.5, atol=1e-9)


def test_truth_is_cyan_and_estimate_magenta_on_the_frame_and_in_the_inset() -> None:
    overlay = Overlay([view(0, 25.0)], SIZE_WH)
    image = overlay.draw(0, np.zeros((360, 640, 3), np.uint8))
    centre, inset = np.s_[120:240, 220:420], np.s_[10:170, 470:630]
    for color in (TRUTH_BGR, ESTIMATE_BGR):
        assert drawn(image[centre], color).sum() > 50
        assert drawn(image[inset], color).sum() > 100


def test_every_target_of_a_frame_is_boxed() -> None:
    other = view(0, 25.0, (-15.0, 5.0, 60.0)).match
    assert other is not None
    both = replace(view(0, 25.0), others=((other, EXTENTS),))
    images = (Overlay([one], SIZE_WH).draw(0, np.zeros((360, 640, 3), np.uint8)) for one in (view(0, 25.0), both))
    alone, together = (image[215:300, 40:150] for image in images)
    for color in (TRUTH_BGR, ESTIMATE_BGR):
        assert not drawn(alone, color).any()
        assert drawn(together, color).sum() > 50


def test_a_missed_target_shows_its_truth_alone() -> None:
    image = Overlay([view(0, None)], SIZE_WH).draw(0, np.zeros((360, 640, 3), np.uint8))
    centre = image[120:240, 220:420]
    assert drawn(centre, TRUTH_BGR).any()
    assert not drawn(centre, ESTIMATE_BGR).any()


@pytest.mark.parametrize("of", ["no target", "a target"])
def test_a_target_of_unknown_range_is_ringed_where_it_is_seen(of: str) -> None:
    beside = truth(t_cam_target_m=(-10.0, 0.0, 60.0))
    match, extents = (None, None) if of == "no target" else (Match(beside, None), EXTENTS)
    seen = TargetPose(0, np.eye(3), np.array([0.8, 0.5, 6.0]), track="t1", rotation_known=False)
    image = Overlay([FrameView(K, match, extents, None, directions=(seen,))], SIZE_WH).draw(0, black())
    below_inset = image[180:290]
    rows, columns = np.nonzero((below_inset[..., 1] < 64) & (below_inset[..., 2] > 64))  # thin, so not of full colour
    u, v = (K @ seen.t_cam_target_m)[:2] / 6.0
    away_px = np.hypot(columns - u, rows + 180 - v)
    ring = away_px < 11.0
    assert ring.sum() > 30
    np.testing.assert_allclose(away_px[ring], 9.0, atol=2.0)
    assert columns[ring].mean() == pytest.approx(u, abs=1.0)
    assert (~ring).sum() > 10
    assert columns[~ring].mean() == pytest.approx(u, abs=5.0)
    assert rows[~ring].min() + 180 > v


def test_a_direction_that_points_behind_the_camera_is_not_drawn() -> None:
    behind = TargetPose(0, np.eye(3), np.array([0.0, 0.1, -6.0]), track="t1", rotation_known=False)
    without, with_it = (Overlay([FrameView(K, None, None, None, directions=d)], SIZE_WH) for d in ((), (behind,)))
    np.testing.assert_array_equal(without.draw(0, black()), with_it.draw(0, black()))


def test_the_inset_stands_aside_when_targets_fly_there() -> None:
    up_right = [view(k, 5.0, (15.0, -8.0, 60.0)) for k in range(3)]
    image = Overlay(up_right, SIZE_WH).draw(0, np.zeros((360, 640, 3), np.uint8))
    assert drawn(image[10:170, 10:170], TRUTH_BGR).sum() > 100


def test_the_frame_to_show_is_the_typical_one() -> None:
    assert showcase_index([view(0, 40.0), view(1, 2.0), view(2, 9.0), view(3, None)]) == 2
    assert showcase_index([view(k, None) for k in range(5)]) == 2


def test_the_video_plays_back_every_frame_at_its_rate(tmp_path: Path) -> None:
    overlay = Overlay([view(k, 3.0 * k) for k in range(6)], SIZE_WH)
    background = np.full((360, 640, 3), 90, np.uint8)
    write_video(tmp_path / "overlay.mp4", (overlay.draw(k, background) for k in range(6)), 30.0, SIZE_WH)
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 6
    assert frames[0].shape == (360, 640, 3)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0)
    assert np.abs(frames[5].astype(int) - overlay.draw(5, background)).mean() < 6


@pytest.mark.parametrize("size_wh", [(480, 1280), (720, 1680), (64, 64)])
def test_a_tall_or_small_picture_is_drawn_on_too(size_wh: tuple[int, int]) -> None:
    width, height = size_wh
    tall = np.array([[900.0, 0.0, width / 2], [0.0, 900.0, height / 2], [0.0, 0.0, 1.0]])
    views = [replace(view(frame, 5.0), K=tall) for frame in range(2)]
    image = Overlay(views, size_wh).draw(1, np.zeros((height, width, 3), np.uint8))
    assert image.shape == (height, width, 3)
    assert image.any()
