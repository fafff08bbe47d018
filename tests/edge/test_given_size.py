"""Depth of aircraft whose wingspan and length are given."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.estimator.decode import decode
from edge.estimator.given_size import Depth, TargetSize, combined, depth_by_size
from edge.tracking.tracker import Tracker
from edge.types import Estimate
from msgs.contract import ModelContract
from sim_replay.airframes import AIRFRAMES
from sim_replay.airframes.mesh import Mesh

from .noisy_flights import BEARING_STD_PX, FORWARD, Instant, flight, update
from .test_decode import WHOLE, peaks_of
from .toy_model import CONTRACT
from .toy_scene import FOCAL_PX, SIZE_WH, K

SIZE = TargetSize(wingspan_m=11.0, length_m=8.0)
FROM_BEHIND = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
FROM_ABOVE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
AHEAD = np.zeros(2)
SURE = np.zeros(3)

rotations = st.integers(0, 10**6).map(lambda seed: Rotation.random(random_state=seed).as_matrix())
sides = st.tuples(st.floats(1e-3, 0.3), st.floats(1e-3, 0.3)).map(np.array)
planes = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)).map(np.array)


def depth_m(
    size: TargetSize, R: np.ndarray, box: np.ndarray, at: np.ndarray = AHEAD, sigma_rad: np.ndarray = SURE
) -> float:
    return float(np.exp(depth_by_size(size, R, at, box, sigma_rad).log_z))


SLANTED = FROM_BEHIND @ Rotation.from_euler("z", 45, degrees=True).as_matrix()


@pytest.mark.parametrize(
    ("R", "across_m", "along_m"),
    [
        (FROM_ABOVE, 0.98 * 11.0, 1.02 * 8.0),
        (FROM_BEHIND, 0.98 * 11.0, 0.25 * 8.0),
        (SLANTED, np.sqrt(0.5) * ((0.98 * 11.0) ** 2.5 + (1.02 * 8.0) ** 2.5) ** 0.4, 0.25 * 8.0),
    ],
    ids=["above", "behind", "slanted"],
)
def test_worked_out_by_hand(R: np.ndarray, across_m: float, along_m: float) -> None:
    """0.98 of the wingspan, 1.02 of the length and a height of a quarter of it are seen; the logarithms of the two
    depths that the sides tell count as the squares of these."""
    box = np.array([110.0, 80.0]) / FOCAL_PX
    log_z = np.log([across_m / box[0], along_m / box[1]])
    expected = np.average(log_z, weights=[across_m**2, along_m**2])
    assert depth_m(SIZE, R, box) == pytest.approx(np.exp(expected), rel=1e-9)


@given(rotations, sides, planes, st.floats(0.2, 5.0))
def test_twice_the_size_or_half_the_image_is_twice_the_depth(
    R: np.ndarray, box: np.ndarray, at: np.ndarray, factor: float
) -> None:
    once = depth_m(SIZE, R, box, at)
    larger = TargetSize(factor * SIZE.wingspan_m, factor * SIZE.length_m)
    assert depth_m(larger, R, box, at) == pytest.approx(factor * once, rel=1e-9)
    assert depth_m(SIZE, R, box / factor, at) == pytest.approx(factor * once, rel=1e-9)


@given(rotations, sides, planes)
def test_a_camera_on_its_side_and_a_mirror_tell_the_same(R: np.ndarray, box: np.ndarray, at: np.ndarray) -> None:
    sigma_rad, mirror = np.array([0.3, 0.2, 0.1]), np.diag([-1.0, 1.0, 1.0])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    once = depth_by_size(SIZE, R, at, box, sigma_rad)
    turned = depth_by_size(SIZE, quarter @ R, np.array([-at[1], at[0]]), box[::-1], sigma_rad[[1, 0, 2]])
    mirrored = depth_by_size(SIZE, mirror @ R @ np.diag([1.0, -1.0, 1.0]), at * [-1.0, 1.0], box, sigma_rad)
    assert turned == pytest.approx(once, rel=1e-9)
    assert mirrored == pytest.approx(once, rel=1e-9)


@given(rotations, sides)
def test_nose_for_tail_is_no_matter(R: np.ndarray, box: np.ndarray) -> None:
    """The rotation with the same outline is what a network confuses most: the depth is the same."""
    reversed_in_depth = np.diag([1.0, 1.0, -1.0]) @ R @ np.diag([1.0, -1.0, 1.0])
    assert depth_m(SIZE, reversed_in_depth, box) == pytest.approx(depth_m(SIZE, R, box), rel=1e-9)


def shown(mesh: Mesh, R: np.ndarray, t_m: np.ndarray) -> np.ndarray:
    """Sides [2] of the mesh's box, in units of Z, as OpenCV projects it."""
    points, _ = cv2.projectPoints(mesh.vertices_m.astype(np.float64), cv2.Rodrigues(R)[0], t_m, np.eye(3), None)
    return np.ptp(points[:, 0], axis=0)


def test_the_fleet_s_outlines_tell_their_depth_as_surely_as_is_told() -> None:
    """All twenty-one in any attitude, also those that the extents were not fitted to, off the middle of the image."""
    rng = np.random.default_rng(7)
    off = []
    for airframe in AIRFRAMES:
        mesh = airframe.mesh()
        size = TargetSize(airframe.span_m, airframe.length_m)
        for R in Rotation.random(60, random_state=int(rng.integers(10**6))).as_matrix():
            at = rng.uniform(-0.3, 0.3, 2)
            t_m = rng.uniform(100.0, 500.0) * np.array([*at, 1.0])
            by_size = depth_by_size(size, R, at, shown(mesh, R, t_m), SURE)
            off.append((by_size.log_z - np.log(t_m[2])) / np.sqrt(by_size.variance))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.abs(off) < 2.0) > 0.94
    assert np.abs(np.mean(off)) < 0.5, "3 % near, as the network's boxes are small"


def test_an_unsure_rotation_makes_the_depth_unsure_by_what_it_changes() -> None:
    """Turned by s about the vertical, the wings of an aircraft seen from behind shrink by its cosine, to second order;
    one that is seen at 45 degrees changes in the first."""
    box = np.array([0.05, 0.01])
    yaw = np.array([0.0, 0.1, 0.0])
    level, aslant, sure = (
        depth_by_size(TargetSize(11.0, 1.0), R, AHEAD, box, sigma).variance
        for R, sigma in ((FROM_BEHIND, yaw), (SLANTED, yaw), (SLANTED, SURE))
    )
    assert sure == pytest.approx(0.07**2)
    assert np.sqrt(aslant - sure) == pytest.approx(0.1, rel=0.15)
    assert level - sure < 0.1 * (aslant - sure)


@given(rotations, planes)
def test_what_the_rotation_is_unsure_of_about_each_axis_adds_up(R: np.ndarray, at: np.ndarray) -> None:
    box, sigma_rad = np.array([0.05, 0.02]), np.array([0.1, 0.2, 0.3])
    sure, *alone, all_three = (
        depth_by_size(SIZE, R, at, box, sigma_rad * about).variance
        for about in np.vstack([np.zeros(3), np.eye(3), np.ones(3)])
    )
    assert all_three - sure == pytest.approx(sum(alone) - 3.0 * sure)


@given(st.floats(-1.5, 1.5), st.floats(0.02, 1.0), st.floats(0.07, 0.4))
def test_combined_is_the_mean_over_what_may_be_the_case(apart: float, sigma: float, by_size_sigma: float) -> None:
    """By summing the densities of the three cases on a grid, independently of any formula for products of normals."""
    log_z = np.linspace(-8.0, 8.0, 64_001)
    step = log_z[1] - log_z[0]

    def normal(mean: float, std: float) -> np.ndarray:
        return np.exp(-0.5 * ((log_z - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi))

    knows = 1.0 / (1.0 + (sigma / 0.18) ** 2.7)
    network = knows * normal(apart, max(0.25 * sigma, 0.02)) + (1.0 - knows) * normal(apart, max(sigma, 0.45))
    given_right = 0.97 * network * normal(0.0, by_size_sigma)
    given_wrong = 0.03 / 3.0 * normal(apart, sigma)
    share_wrong = given_wrong.sum() / (given_right + given_wrong).sum()
    density = given_right + given_wrong
    density /= density.sum() * step
    mean = float((log_z * density).sum() * step)
    variance = float(((log_z - mean) ** 2 * density).sum() * step)
    (told, told_variance), contradicted = combined(Depth(apart, sigma**2), Depth(0.0, by_size_sigma**2))
    assert (told, told_variance) == pytest.approx((mean, variance), rel=1e-4, abs=1e-6)
    assert contradicted == (share_wrong > 0.3) or share_wrong == pytest.approx(0.3, abs=1e-6)


def test_a_known_aircraft_is_told_by_appearance_and_a_strange_one_by_size() -> None:
    by_size = Depth(0.0, 0.08**2)
    (known, known_variance), _ = combined(Depth(0.06, 0.09**2), by_size)
    (strange, _), contradicted = combined(Depth(-0.6, 0.4**2), by_size)
    assert known == pytest.approx(0.06, abs=0.012)
    assert np.sqrt(known_variance) < 0.05, "they agree: surer than either"
    assert strange == pytest.approx(0.0, abs=0.05)
    assert not contradicted


def test_a_size_in_feet_for_a_known_aircraft_is_not_believed() -> None:
    """But it leaves its mark: for all that is known, it might be an aircraft that only looks like the known one."""
    (log_z, variance), contradicted = combined(Depth(0.0, 0.07**2), Depth(np.log(3.28), 0.08**2))
    assert contradicted
    assert 0.0 < log_z < np.sqrt(variance)
    assert np.sqrt(variance) > 0.3


def told(
    size: TargetSize | None, *, box_px: tuple[float, float] = (110.0, 40.0), at_px: float = 300.0, high: float = 1.0
) -> Estimate:
    """Of an aircraft seen from behind that the network takes to be at 300 m, and of which it is not sure, by pixels so
    many times as high as wide."""
    peaks, flat = peaks_of(score=1.0), np.diag([1.0, 1.0 / high, 1.0])
    peaks.size_px[0, 0] = np.array(box_px) / [1.0, high]
    peaks.center_px[0, 0] = peaks.origin_px[0, 0] = [at_px, 400.0 / high]
    peaks.t_cam_target_m[0, 0] = 300.0 * np.linalg.solve(K, [at_px, 400.0, 1.0])
    peaks.R_cam_target[0, 0] = FROM_BEHIND
    peaks.sigma[0, 0, 2] = 0.4
    contract = ModelContract(**CONTRACT)
    where = WHOLE._replace(K=flat @ K, frame_wh=(SIZE_WH[0], round(SIZE_WH[1] / high)))
    (estimate,) = decode(peaks, 0, where, contract, "track", contract.track_score_min, Counter(), size)
    return estimate


@pytest.mark.parametrize("high", [1.0, 0.5])
def test_the_depth_is_that_of_the_rays_through_the_box_s_sides(high: float) -> None:
    """At the right of the picture a long aircraft flying straight ahead shows its flank."""
    size, at_px = TargetSize(wingspan_m=6.0, length_m=16.0), 1700.0
    at = (np.array([at_px, 400.0]) - K[:2, 2]) / FOCAL_PX
    by_size = depth_by_size(size, FROM_BEHIND, at, np.array([110.0, 40.0]) / FOCAL_PX, np.full(3, 0.05))
    expected = combined(Depth(np.log(300.0), 0.4**2), by_size).depth
    found = told(size, at_px=at_px, high=high)
    assert np.log(found.t_cam_target_m[2]) == pytest.approx(expected.log_z, abs=1e-3)
    assert np.sqrt(found.covariance[2, 2]) / found.t_cam_target_m[2] == pytest.approx(np.sqrt(expected.variance), 1e-2)


def test_a_given_size_moves_the_target_along_its_ray_and_makes_it_surer() -> None:
    without, sized = told(None), told(SIZE)
    factor = sized.t_cam_target_m[2] / without.t_cam_target_m[2]
    np.testing.assert_allclose(sized.t_cam_target_m, factor * without.t_cam_target_m, rtol=1e-9)
    assert sized.t_cam_target_m[2] == pytest.approx(FOCAL_PX * 0.98 * 11.0 / 110.0, rel=0.05)
    np.testing.assert_array_equal(sized.R_cam_target, without.R_cam_target)
    np.testing.assert_array_equal(sized.covariance[3:, 3:], without.covariance[3:, 3:])
    relative = [np.sqrt(e.covariance[2, 2]) / e.t_cam_target_m[2] for e in (without, sized)]
    assert relative[0] == pytest.approx(0.4, rel=1e-3)
    assert relative[1] < 0.12
    assert sized.oversize is None


def test_the_part_of_a_cut_target_that_is_seen_has_no_size() -> None:
    np.testing.assert_array_equal(told(SIZE, at_px=40.0).t_cam_target_m, told(None, at_px=40.0).t_cam_target_m)


def test_a_score_that_may_be_of_none_makes_its_size_doubtful_too() -> None:
    peaks, contract = peaks_of(score=0.6), ModelContract(**(CONTRACT | {"track_score_min": 0.5}))
    peaks.R_cam_target[0, 0], peaks.sigma[0, 0, 2] = FROM_BEHIND, 0.4
    (e,) = decode(peaks, 0, WHOLE, contract, "track", 0.5, Counter(), SIZE)
    assert np.sqrt(e.covariance[2, 2]) / e.t_cam_target_m[2] > 0.2


def ranged(now: Instant, log_factor: float, variance: float) -> Estimate:
    """The flight's estimate at that many times the true range, and with this variance of its logarithm."""
    t_m = now.t_cam_target_m * np.exp(log_factor)
    along = np.outer(t_m, t_m)
    covariance = now.estimate.covariance.copy()
    covariance[:3, :3] = (BEARING_STD_PX / K[0, 0]) ** 2 * (t_m @ t_m * np.eye(3) - along) + variance * along
    return replace(now.estimate, t_cam_target_m=t_m, covariance=covariance)


@pytest.mark.parametrize("kind", ["ned", "ned_relative", "cam"])
@pytest.mark.parametrize("given_first", [False, True], ids=["given", "taken back"])
def test_a_track_outlives_a_size_that_is_given_or_taken_back_in_flight(kind: str, given_first: bool) -> None:
    """Its range is then another, by a factor of 1.6; nobody flies that far in the second that this takes."""
    rng, tracker = np.random.default_rng(1), Tracker(4, FORWARD)
    by_size = Depth(0.04, 0.08**2)
    for index, now in enumerate(flight(3, frames=180)):
        told = Depth(-0.5 + 0.04 * rng.normal(), 0.3**2)
        if (index < 90) == given_first:
            told = combined(told, by_size).depth
        (track,) = update(tracker, now, kind, [ranged(now, *told)])
        off_m = track.t_cam_target_m - now.t_cam_target_m
        if kind == "ned" and index > 30:
            assert track.v_ned_target_mps is not None
            assert np.linalg.norm(track.v_ned_target_mps - now.v_ned_target_mps) < 30.0
        if index in (89, 179):
            log_off = np.log(np.linalg.norm(track.t_cam_target_m) / np.linalg.norm(now.t_cam_target_m))
            assert log_off == pytest.approx(0.0 if (index < 90) == given_first else -0.5, abs=0.1)
        if given_first == (index < 90) and index % 90 > 60:
            assert off_m @ np.linalg.solve(track.covariance[:3, :3], off_m) < 16.3
    assert track.born_ns == 1
