"""What `uavpose-ground view` draws, as numbers: ellipses, ellipsoids and boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msgs.ground.view.drawing import SIGMAS, box_edges_m, ellipse, ellipsoid, pixel_covariance, posed, project

from .flight import K


@given(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(50.0, 500.0), st.integers(0, 2**32 - 1))
def test_the_ellipse_on_the_picture_holds_what_two_sigmas_hold(
    right: float, down: float, ahead_m: float, seed: int
) -> None:
    """Against points drawn from the covariance and projected one by one: 86.5 % of a plane lies within two sigmas."""
    t_m = np.array([right * ahead_m, down * ahead_m, ahead_m])
    chance = np.random.default_rng(seed)
    root = chance.normal(size=(3, 3)) * 0.003 * ahead_m
    drawn = project(t_m + chance.normal(size=(4000, 3)) @ root.T, K)
    center = project(t_m, K)
    assert drawn is not None
    assert center is not None
    covariance = pixel_covariance(t_m, root @ root.T, K)
    distance = np.einsum("ni,ij,nj->n", drawn - center, np.linalg.inv(covariance), drawn - center)
    assert (distance < SIGMAS**2).mean() == pytest.approx(1.0 - np.exp(-2.0), abs=0.03)
    line = ellipse(center, covariance) - center
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", line, np.linalg.inv(covariance), line), SIGMAS**2, rtol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_an_ellipsoid_s_axes_give_its_covariance_again(seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    half_m, q_xyzw = ellipsoid(root @ root.T)
    R = Rotation.from_quat(q_xyzw).as_matrix()
    np.testing.assert_allclose(R @ np.diag((half_m / SIGMAS) ** 2) @ R.T, root @ root.T, atol=1e-9)


def test_a_box_has_twelve_edges_of_its_three_lengths_and_what_is_behind_is_not_drawn() -> None:
    edges = box_edges_m((8.0, 12.0, 2.5))
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    assert sorted(lengths) == sorted([8.0, 12.0, 2.5] * 4)
    assert project(posed(edges, np.eye(3), [0.0, 0.0, -50.0]), K) is None
