"""Rotations against scipy's, over random rotations and the corners: zero, half turns, gimbal lock."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msgs import geometry

angles = st.floats(-np.pi, np.pi)
axes = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).normal(size=3))
# Turns from the smallest representable to just short of a half turn, where the axis' sign is still defined.
turns = st.one_of(
    st.floats(0.0, np.pi - 1e-6), st.floats(0.0, 1e-6), st.sampled_from([0.0, 1e-300, 1e-12, np.pi - 1e-6])
)
seeds = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=150, deadline=None)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    axis = draw(axes)
    return axis / np.linalg.norm(axis) * draw(turns)


def random_rotations(seed: int, *shape: int) -> np.ndarray:
    count = int(np.prod(shape, dtype=int))
    return Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix().reshape(*shape, 3, 3)


@SOME
@given(rotation_vectors())
def test_exp_is_scipys(vector: np.ndarray) -> None:
    R = geometry.so3_exp(vector)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


@SOME
@given(rotation_vectors())
def test_log_undoes_exp(vector: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(vector)), vector, atol=5e-15, rtol=1e-9)


@SOME
@given(axes)
def test_log_of_a_half_turn_is_its_axis_either_way(axis: np.ndarray) -> None:
    axis = axis / np.linalg.norm(axis)
    vector = geometry.so3_log(2.0 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-7)
    assert abs(vector @ axis) == pytest.approx(np.pi, abs=1e-7)


@SOME
@given(seeds)
def test_quaternions_are_scipys(seed: int) -> None:
    R = random_rotations(seed, 2, 3)
    q = geometry.q_wxyz_from_R(R)
    theirs = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True).reshape(2, 3, 4)
    np.testing.assert_allclose(q, theirs, atol=1e-12)
    np.testing.assert_allclose(geometry.R_from_q_wxyz(q), R, atol=1e-12)
    np.testing.assert_allclose(geometry.R_from_q_wxyz(-3.0 * q), R, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("turn", [np.pi, np.pi / 2, -np.pi / 2])
def test_quaternions_of_turns_about_the_axes(axis: int, turn: float) -> None:
    R = Rotation.from_rotvec(turn * np.eye(3)[axis]).as_matrix()
    np.testing.assert_allclose(geometry.R_from_q_wxyz(geometry.q_wxyz_from_R(R)), R, atol=1e-12)


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (1e-10, 0, 0, 0)])
def test_what_is_no_rotation_is_refused(q: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        geometry.R_from_q_wxyz(q)


@SOME
@given(seeds, rotation_vectors())
def test_rotation_angle_is_the_length_of_the_turn_between(seed: int, vector: np.ndarray) -> None:
    R_a = random_rotations(seed, 1)[0]
    angle = geometry.rotation_angle(R_a, R_a @ Rotation.from_rotvec(vector).as_matrix())
    assert angle == pytest.approx(np.linalg.norm(vector), abs=1e-9)


@SOME
@given(angles, st.floats(-np.pi / 2, np.pi / 2), angles)
def test_euler_angles_are_yaw_then_pitch_then_roll(roll: float, pitch: float, yaw: float) -> None:
    R = geometry.R_from_euler(roll, pitch, yaw)
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(geometry.R_from_euler(*geometry.euler_from_R(R)), R, atol=1e-7)


@SOME
@given(angles, st.sampled_from([-np.pi / 2, np.pi / 2]), angles)
def test_euler_angles_of_a_vertical_aircraft_give_its_rotation_with_no_roll(
    roll: float, pitch: float, yaw: float
) -> None:
    R = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    for exact in (R, np.round(R * [[0, 1, 1], [0, 1, 1], [1, 0, 0]], 15)):  # with rounding errors, and without
        told = geometry.euler_from_R(exact)
        assert told[0] == 0.0
        np.testing.assert_allclose(geometry.R_from_euler(*told), R, atol=2e-8)


def test_euler_angles_of_known_attitudes() -> None:
    # Nose up 30°: the nose points north and up, that is -z in ned.
    R = geometry.R_from_euler(0.0, np.radians(30.0), 0.0)
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [np.cos(np.pi / 6), 0.0, -0.5], atol=1e-15)
    # Heading east, the right wing points south.
    np.testing.assert_allclose(
        geometry.R_from_euler(0.0, 0.0, np.pi / 2) @ [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], atol=1e-15
    )


@SOME
@given(seeds)
def test_everything_broadcasts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vectors, others = rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 3, 3))
    np.testing.assert_allclose(
        np.einsum("...ij,...j->...i", geometry.skew(vectors), others), np.cross(vectors, others), atol=1e-12
    )
    stacked = geometry.so3_exp(vectors)
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(stacked[index], geometry.so3_exp(vectors[index]))
        np.testing.assert_array_equal(geometry.so3_log(stacked)[index], geometry.so3_log(stacked[index]))
    roll = rng.uniform(-1, 1, size=(4, 1))
    assert geometry.R_from_euler(roll, 0.1, np.zeros(5)).shape == (4, 5, 3, 3)
    assert geometry.rotation_angle(stacked, np.eye(3)).shape == (2, 3)


@given(seeds)
@SOME
def test_the_nearest_rotation_to_a_matrix_is_nearer_than_any_other_also_to_a_reflection(seed: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    nearest = geometry.nearest_rotation(matrix)
    np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(nearest) == pytest.approx(1.0)
    off = [np.linalg.norm(R - matrix) for R in random_rotations(seed, 20)]
    assert np.linalg.norm(nearest - matrix) <= min(off) + 1e-12
