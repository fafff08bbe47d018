"""The paper's equations against hand-worked numbers and independent libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from trainer import equations as eq

angles = st.floats(-math.pi, math.pi, allow_nan=False)
plane = st.floats(-1.5, 1.5, allow_nan=False)
lengths = st.floats(0.3, 30.0, allow_nan=False)


def log_map(rows: int, columns: int, cells: dict[tuple[int, int], float]) -> torch.Tensor:
    P = torch.full((1, rows, columns), 1e-6, dtype=torch.double)
    for (x, y), value in cells.items():
        P[0, y, x] = value
    return torch.log(P)


def test_soft_argmax_of_one_cell_is_that_cells_centre_in_pixels() -> None:
    _, center_px = eq.soft_argmax(log_map(8, 12, {(5, 2): 0.9}), torch.tensor([[[5.0, 2.0]]], dtype=torch.double), 1.0)
    # Cell 5 of stride 8 covers pixels 40..47, whose centre is 43.5.
    np.testing.assert_allclose(center_px[0, 0].numpy(), [43.5, 19.5], atol=1e-3)


def test_soft_argmax_weighs_sharpened_probability_by_the_window() -> None:
    W, center_px = eq.soft_argmax(
        log_map(8, 8, {(3, 3): 0.8, (4, 3): 0.4}), torch.tensor([[[3.0, 3.0]]], dtype=torch.double), 1.5
    )
    a, b = 0.8**2.2, 0.4**2.2 * math.exp(-1 / (2 * 1.5**2))
    expected = 8 * ((3 * a + 4 * b) / (a + b) + 0.5) - 0.5
    assert center_px[0, 0, 0].item() == pytest.approx(expected, abs=1e-3)
    assert W.sum().item() == pytest.approx(1.0)


@given(plane, plane)
def test_a_skew_is_no_focal_length(x: float, y: float) -> None:
    K = torch.tensor([[1000.0, 5.0, 320.0], [0.0, 1100.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.double)
    point = torch.tensor([320.0 + 1000.0 * x, 240.0 + 1100.0 * y], dtype=torch.double)
    torch.testing.assert_close(eq.image_plane_point(point, K), torch.tensor([x, y], dtype=torch.double))
    assert eq.focal_length(K, "mean").item() == pytest.approx(1050.0)
    assert eq.focal_length(K, "geometric").item() == pytest.approx(math.sqrt(1.1e6))


@given(plane, plane)
def test_ray_rotation_takes_the_axis_to_the_ray_by_the_smallest_angle(x: float, y: float) -> None:
    d = eq.unit_ray(torch.tensor([x, y], dtype=torch.double))
    R = eq.ray_rotation(d)
    torch.testing.assert_close(R[:, 2], d)
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.double))
    assert Rotation.from_matrix(R.numpy()).magnitude() == pytest.approx(math.acos(min(1.0, d[2].item())), abs=1e-6)


vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(vectors, vectors)
def test_gram_schmidt_is_a_rotation_that_keeps_the_down_axis(down: list[float], nose: list[float]) -> None:
    assume(np.linalg.norm(np.cross(down, nose)) > 0.05)
    r = torch.tensor([*down, *nose], dtype=torch.double)
    R = eq.gram_schmidt(r)
    torch.testing.assert_close(R.T @ R, torch.eye(3, dtype=torch.double))
    assert torch.linalg.det(R).item() == pytest.approx(1.0)
    torch.testing.assert_close(R[:, 2], r[:3] / r[:3].norm())
    assert (R[:, 0] @ r[3:]).item() > 0


@given(angles, angles, angles, angles, angles, angles)
def test_rotation_angle_equals_scipys(a: float, b: float, c: float, d: float, e: float, f: float) -> None:
    one, other = Rotation.from_rotvec([a, b, c]), Rotation.from_rotvec([d, e, f])
    expected = (one.inv() * other).magnitude()
    got = eq.rotation_angle(torch.from_numpy(one.as_matrix()), torch.from_numpy(other.as_matrix()))
    assert got.item() == pytest.approx(expected, abs=2e-6)


def test_rotation_angle_has_a_gradient_at_zero() -> None:
    R = torch.eye(3, requires_grad=True)
    eq.rotation_angle(R, torch.eye(3)).backward()
    assert R.grad is not None
    assert torch.isfinite(R.grad).all()


@given(st.floats(1000, 8000), st.floats(0.3, 3.0), st.floats(0.3, 3.0), st.floats(3, 30), st.floats(60, 550))
def test_geometric_focal_depth_survives_anisotropic_resizing(
    f: float, sx: float, sy: float, S: float, Z: float
) -> None:
    def depth(scale_x: float, scale_y: float) -> float:
        K = torch.diag(torch.tensor([f * scale_x, f * scale_y, 1.0], dtype=torch.double))
        size = torch.tensor([f * S / Z * scale_x, f * S / Z * scale_y], dtype=torch.double)
        return eq.apdd_depth(eq.focal_length(K, "geometric"), torch.tensor(S, dtype=torch.double), size).item()

    assert depth(1.0, 1.0) == pytest.approx(Z, rel=1e-4)
    assert depth(sx, sy) == pytest.approx(Z, rel=1e-4)


def test_mean_focal_is_the_papers() -> None:
    K = torch.diag(torch.tensor([1000.0, 1200.0, 1.0]))
    assert eq.focal_length(K, "mean").item() == pytest.approx(1100.0)


@settings(max_examples=25)
@given(lengths, lengths, lengths, angles, angles, angles)
def test_seen_scale_is_the_projected_ellipsoid(a: float, b: float, c: float, x: float, y: float, z: float) -> None:
    R = Rotation.from_rotvec([x, y, z]).as_matrix()
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    surface = directions / np.linalg.norm(directions, axis=1, keepdims=True) * [a, b, c]
    width, height = np.ptp((surface @ R.T)[:, :2], axis=0)
    S = eq.seen_scale(torch.tensor([a, b, c], dtype=torch.double), torch.from_numpy(R)).item()
    assert math.sqrt(width * height) == pytest.approx(S, rel=0.03)


def test_back_projection_and_plane_point_are_inverse_to_projection() -> None:
    K = torch.tensor([[900.0, 0, 60], [0, 950, 70], [0, 0, 1]])
    point_m = torch.tensor([12.0, -7.0, 240.0])
    pixel = (K @ point_m)[:2] / point_m[2]
    torch.testing.assert_close(eq.back_project(eq.image_plane_point(pixel, K), point_m[2]), point_m)


def test_peaks_are_local_maxima_in_falling_order() -> None:
    P = torch.zeros(1, 6, 9)
    P[0, 1, 2], P[0, 1, 3], P[0, 4, 7] = 0.9, 0.8, 0.6
    values, cells = eq.heatmap_peaks(P, 2)
    torch.testing.assert_close(values, torch.tensor([[0.9, 0.6]]))
    assert cells.tolist() == [[[2, 1], [7, 4]]]


def test_heading_anchors_are_level_aircraft_at_even_headings() -> None:
    R = eq.gram_schmidt(eq.heading_anchors(8))
    torch.testing.assert_close(R[:, :, 2], torch.tensor([[0.0, 1.0, 0.0]]).expand(8, 3))
    step = eq.rotation_angle(R, R.roll(1, dims=0))
    torch.testing.assert_close(step, torch.full((8,), math.pi / 4), atol=1e-5, rtol=0)
