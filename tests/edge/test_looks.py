"""Looks at a target, plain and mirrored, and what several say together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.estimator.looks import confirmed, mirrored, of_looks, unmirrored
from edge.estimator.model import Peaks
from edge.types import Estimate

WIDTH_PX, HEIGHT_PX = 224, 160
K = np.array([[900.0, 0.0, 101.3], [0.0, 880.0, 77.7], [0.0, 0.0, 1.0]])
# An aircraft's nose, wing tips, belly and fin, in its body axes: forward, right, down.
POINTS_M = np.array([[9.0, 0, 0], [-1.0, 12.0, 0], [-1.0, -12.0, 0], [0, 0, 1.5], [-8.0, 0, -3.0]])
LEFT_FOR_RIGHT = [0, 2, 1, 3, 4]
places = st.tuples(st.floats(-15, 15), st.floats(-10, 10), st.floats(100, 500)).map(np.array)
turns = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(lambda v: Rotation.from_rotvec(v).as_matrix())


def seen_px(K_px: np.ndarray, R: np.ndarray, t_m: np.ndarray) -> np.ndarray:
    on_plane = (K_px @ (POINTS_M @ R.T + t_m).T).T
    return on_plane[:, :2] / on_plane[:, 2:]


def peaks_of(R: np.ndarray, t_m: np.ndarray, origin_px: np.ndarray) -> Peaks:
    return Peaks(
        score=np.full((1, 1), 0.9, np.float32),
        center_px=origin_px[None, None].astype(np.float32),
        size_px=np.full((1, 1, 2), 40.0, np.float32),
        origin_px=origin_px[None, None].astype(np.float32),
        t_cam_target_m=t_m[None, None].astype(np.float32),
        R_cam_target=R[None, None].astype(np.float32),
        sigma=np.full((1, 1, 6), 0.05, np.float32),
    )


@given(turns, places)
def test_a_mirrored_aircraft_is_seen_where_the_mirrored_picture_has_it(R: np.ndarray, t_m: np.ndarray) -> None:
    """What a perfect network says of the mirrored picture, turned back, is the truth of the picture as it was."""
    image = np.arange(WIDTH_PX * HEIGHT_PX * 3, dtype=np.uint32).astype(np.uint8).reshape(1, HEIGHT_PX, WIDTH_PX, 3)
    flipped, K_flipped = mirrored(image, K[None], np.array([True]))
    np.testing.assert_array_equal(flipped[0, :, 0], image[0, :, -1])
    origin_px = (K @ t_m)[:2] / t_m[2]
    said = unmirrored(
        peaks_of(R, t_m, origin_px), WIDTH_PX, np.array([True])
    )  # of a picture: what is true of its mirrored one
    R_flipped, t_flipped_m = said.R_cam_target[0, 0].astype(float), said.t_cam_target_m[0, 0].astype(float)
    assert np.linalg.det(R_flipped) == pytest.approx(1.0, abs=1e-5)
    there = seen_px(K_flipped[0], R_flipped, t_flipped_m)[LEFT_FOR_RIGHT]
    expected = seen_px(K, R, t_m)
    expected[:, 0] = WIDTH_PX - 1 - expected[:, 0]
    np.testing.assert_allclose(there, expected, atol=0.02)
    np.testing.assert_allclose(said.origin_px[0, 0], (K_flipped[0] @ t_flipped_m)[:2] / t_flipped_m[2], atol=0.02)
    back = unmirrored(said, WIDTH_PX, np.array([True]))
    np.testing.assert_allclose(back.R_cam_target[0, 0], R, atol=1e-6)
    np.testing.assert_allclose(back.center_px[0, 0], origin_px, atol=1e-3)


def test_only_what_is_turned_is_mirrored_and_turned_back() -> None:
    images = np.random.default_rng(0).integers(0, 256, (3, HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    turned = np.array([False, True, False])
    flipped, K_flipped = mirrored(images, np.stack([K] * 3), turned)
    np.testing.assert_array_equal(flipped[1], images[1, :, ::-1])
    np.testing.assert_array_equal(flipped[[0, 2]], images[[0, 2]])
    np.testing.assert_array_equal(K_flipped[[0, 2]], [K, K])
    one = peaks_of(np.eye(3), np.array([10.0, 5.0, 200.0]), np.array([30.0, 40.0]))
    several = Peaks(*(np.concatenate([value] * 3) for value in vars(one).values()))
    said = unmirrored(several, WIDTH_PX, turned)
    for name, value in vars(said).items():
        np.testing.assert_array_equal(value[[0, 2]], getattr(several, name)[[0, 2]], err_msg=name)
    assert said.t_cam_target_m[1, 0, 0] == -10.0
    assert said.center_px[1, 0, 0] == WIDTH_PX - 1 - 30.0


def look(
    range_m: float, heading_rad: float, rotation_std_rad: float = 0.1, score: float = 0.8, aside_rad: float = 0.0
) -> Estimate:
    t_m = range_m * np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    t_m = Rotation.from_rotvec([0.0, aside_rad, 0.0]).apply(t_m)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) + 0.01 * np.outer(t_m, t_m)
    covariance[3:, 3:] = rotation_std_rad**2 * np.eye(3)
    R = Rotation.from_rotvec([0.0, heading_rad, 0.0]).as_matrix()
    return Estimate(score, np.array([10.0, 10.0, 50.0, 30.0]) + range_m / 100.0, R, t_m, covariance, "track")


def heading_rad(estimate: Estimate) -> float:
    return float(Rotation.from_matrix(estimate.R_cam_target).as_rotvec()[1])


def range_share(estimate: Estimate) -> float:
    """1-sigma of range, in ranges."""
    range_m = np.linalg.norm(estimate.t_cam_target_m)
    along = estimate.t_cam_target_m / range_m
    return float(np.sqrt(along @ estimate.covariance[:3, :3] @ along) / range_m)


def test_looks_that_agree_are_averaged_and_what_parts_them_is_told() -> None:
    both = of_looks([look(100.0, 0.1, score=0.9), look(144.0, 0.3, score=0.7)])
    assert both.score == pytest.approx(0.8)
    assert np.linalg.norm(both.t_cam_target_m) == pytest.approx(120.0)
    np.testing.assert_allclose(both.box_xyxy_px, [11.22, 11.22, 51.22, 31.22])
    assert heading_rad(both) == pytest.approx(0.2)
    alike = of_looks([look(120.0, 0.2), look(120.0, 0.2)])
    assert range_share(alike) == pytest.approx(range_share(look(120.0, 0.2)))
    assert range_share(both) ** 2 == pytest.approx(range_share(alike) ** 2 + np.log(1.2) ** 2, rel=1e-3)
    assert both.covariance[4, 4] == pytest.approx(alike.covariance[4, 4] + 0.1**2)


def test_looks_in_two_directions_are_told_as_the_one_between_and_less_sure_across() -> None:
    both, alike = (of_looks([look(120.0, 0.2, aside_rad=a), look(120.0, 0.2, aside_rad=-a)]) for a in (0.01, 0.0))
    np.testing.assert_allclose(both.t_cam_target_m, alike.t_cam_target_m, atol=1e-3)
    across = np.cross(alike.t_cam_target_m, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    variances = [across @ one.covariance[:3, :3] @ across for one in (both, alike)]
    assert variances[0] == pytest.approx(variances[1] + (120.0 * 0.01) ** 2, rel=0.01)


def test_of_rotations_that_agree_the_middle_one_counts_and_the_surer_tells_how_sure() -> None:
    three = of_looks([look(120.0, np.radians(deg)) for deg in (0.0, 35.0, 50.0)])
    assert np.degrees(heading_rad(three)) == pytest.approx(28.3, abs=0.5), "the mean of all three"
    surer = of_looks([look(120.0, 0.2, 0.1), look(120.0, 0.2, 0.4)])
    assert surer.covariance[4, 4] == pytest.approx(2.0 / (1 / 0.1**2 + 1 / 0.4**2))


def test_of_looks_that_contradict_the_surer_counts_and_the_doubt_is_told() -> None:
    both = of_looks([look(120.0, 0.0, 0.1), look(120.0, np.radians(170.0), 0.4)])
    assert heading_rad(both) == pytest.approx(0.0, abs=1e-6)
    assert np.sqrt(both.covariance[4, 4]) > 0.5


def test_two_that_agree_outvote_a_surer_third_and_a_coarser_look_tells_no_range() -> None:
    three = of_looks([look(120.0, 0.0), look(120.0, 0.1)], [look(300.0, np.radians(170.0), 0.07)])
    assert heading_rad(three) == pytest.approx(0.05, abs=1e-6)
    assert np.linalg.norm(three.t_cam_target_m) == pytest.approx(120.0)


def test_one_look_is_what_it_says() -> None:
    one = look(120.0, 0.4)
    assert of_looks([one]) is one


def test_odds_of_the_whole_frame_and_of_its_windows_multiply() -> None:
    assert confirmed(0.5, [0.8]) == pytest.approx(0.8)
    assert confirmed(0.8, [0.8]) == pytest.approx(16 / 17)
    assert confirmed(0.8, [0.2]) == pytest.approx(0.5)
    assert confirmed(0.8, [0.8, 0.2]) == pytest.approx(0.8)
    assert confirmed(0.0, [1.0]) < 0.7, "a place that the whole frame does not see is not sure"
    assert confirmed(1.0, [0.0]) == pytest.approx(0.995 * 0.01 / (0.995 * 0.01 + 0.005 * 0.99))


@given(st.floats(0, 1), st.lists(st.floats(0, 1), min_size=1, max_size=3), st.floats(0, 1))
def test_a_stronger_witness_never_makes_a_target_less_likely(place: float, looks: list[float], other: float) -> None:
    weaker, stronger = sorted((looks[0], other))
    assert confirmed(place, [stronger, *looks[1:]]) >= confirmed(place, [weaker, *looks[1:]]) - 1e-12
    assert 0.0 < confirmed(place, looks) < 1.0
