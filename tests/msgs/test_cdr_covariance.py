"""Which matrices are taken for covariances: symmetric and positive semi-definite ones, up to rounding."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from msgs import cdr
from msgs.wire import PayloadError, Refusal

from .test_cdr import _covariance, _with, covariances, same, u32


@settings(max_examples=25, deadline=None)
@given(covariances())
def test_covariances_rounded_to_float32_are_still_taken(covariance: np.ndarray) -> None:
    rounded = covariance.astype(np.float32).astype(np.float64)
    assert same(cdr.PoseWithCovarianceStamped.decode(_with(covariance=rounded)).covariance, rounded)


@settings(max_examples=200, deadline=None)
@given(u32, st.sampled_from([-1e-2, -1e-5, -1e-7, 0.0, 1e-9, 1e-3]), st.floats(-6, 6), st.booleans())
def test_a_covariance_is_taken_by_the_sign_of_its_least_eigenvalue_whatever_its_units(
    seed: int, least: float, decades: float, mirrored: bool
) -> None:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    eigenvalues = np.r_[least, rng.uniform(0.2, 2.0, 5)]
    matrix = axes @ np.diag(eigenvalues) @ axes.T
    units = 10.0 ** (decades * rng.uniform(-1, 1, 6)) / np.sqrt(np.maximum(np.diagonal(matrix), 1e-3))
    matrix = matrix * units[:, None] * units[None, :]
    matrix = (matrix + matrix.T) / 2 if mirrored else matrix
    correlation = matrix / np.sqrt(np.outer(np.diagonal(matrix), np.diagonal(matrix)))
    least_of_correlation = np.linalg.eigvalsh((correlation + correlation.T) / 2)[0]
    assume(abs(least_of_correlation + 1e-6) > 1e-8)
    if least_of_correlation < -1e-6:
        with pytest.raises(PayloadError, match="positive semi-definite"):
            cdr.PoseWithCovarianceStamped.decode(_with(covariance=matrix))
    else:
        decoded = cdr.PoseWithCovarianceStamped.decode(_with(covariance=matrix))
        assert np.array_equal(decoded.covariance, matrix)


@pytest.mark.parametrize("last", range(2, 6))
def test_axes_of_which_each_excludes_the_others_are_refused_wherever_they_stand(last: int) -> None:
    """Three that are anticorrelated by 0.9 each: any two may be, of three the sum would have a negative variance."""
    axes = range(last - 2, last + 1)
    for correlation, taken in ((-0.4, True), (-0.9, False)):
        entries = [(i, j, correlation) for i in axes for j in axes if i != j]
        payload = _with(covariance=_covariance(*entries))
        if taken:
            assert cdr.PoseWithCovarianceStamped.decode(payload).covariance[last, last - 1] == correlation
        else:
            with pytest.raises(PayloadError) as caught:
                cdr.PoseWithCovarianceStamped.decode(payload)
            assert caught.value.reason is Refusal.COVARIANCE


@pytest.mark.parametrize(("row", "column"), [(i, j) for i in range(6) for j in range(6) if i != j])
def test_a_number_that_differs_from_its_mirror_image_is_refused_wherever_it_stands(row: int, column: int) -> None:
    with pytest.raises(PayloadError) as caught:
        cdr.PoseWithCovarianceStamped.decode(_with(covariance=_covariance((row, column, 0.5))))
    assert caught.value.reason is Refusal.COVARIANCE


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize(("variance", "covariance"), [(0.0, 0.1), (-1.0, 0.0), (1e-3, 0.1)])
def test_a_variance_too_small_for_what_is_said_beside_it_is_refused(
    axis: int, variance: float, covariance: float
) -> None:
    other = (axis + 2) % 6
    matrix = _covariance((axis, axis, variance), (axis, other, covariance), (other, axis, covariance))
    with pytest.raises(PayloadError) as caught:
        cdr.PoseWithCovarianceStamped.decode(_with(covariance=matrix))
    assert caught.value.reason is Refusal.COVARIANCE
