"""K is exact through every resize and crop: a network that projects a known point with the K it is given."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from edge.estimator.estimator import Estimator
from edge.estimator.model import load_model
from edge.estimator.window import fit_frame
from edge.types import Frame, FrameMeta

from .toy_model import write_toy_model

POINT_M = np.array([3.0, -2.0, 200.0])
SIZE_M = 12.0
EXACT_PX = 0.01

# score 0.9; centre and origin where K projects POINT_M, box as a SIZE_M square shows at that depth.
PROJECTS = """
<ir_version: 8, opset_import: ["" : 17]>
projects (uint8[N, H, W, 3] image, float[N, 3, 3] K) => (
    float[N, M] score, float[N, M, 2] center_px, float[N, M, 2] size_px, float[N, M, 2] origin_px,
    float[N, M, 3] t_cam_target_m, float[N, M, 3, 3] R_cam_target, float[N, M, 6] sigma)
<float[1, 3, 1] point = {3, -2, 200}, float[1, 1, 3] t = {3, -2, 200}, float depth = {200}, float size_m = {12},
 float high = {0.9}, int64[1] none = {0}, int64[1] one = {1}, int64[1] two = {2}, int64[1] last = {2},
 float[1, 1, 3, 3] eye = {1, 0, 0, 0, 1, 0, 0, 0, 1}, float[1, 1, 6] sigmas = {0.5, 0.5, 0.05, 0.1, 0.1, 0.1}>
{
    seen_z = MatMul(K, point)
    seen = Div(seen_z, depth)
    uv1 = Slice(seen, none, two, one)
    uv = Squeeze(uv1, last)
    center_px = Unsqueeze(uv, one)
    origin_px = Identity(center_px)
    no_offset = Slice(K, none, two, last)
    no_offset2 = Slice(no_offset, none, two, one)
    focal = ReduceSum<keepdims = 0>(no_offset2, last)
    wide = Mul(focal, size_m)
    side = Div(wide, depth)
    size_px = Unsqueeze(side, one)
    zero1 = Sub(center_px, center_px)
    zero2 = ReduceSum<keepdims = 1>(zero1, last)
    zero = Squeeze(zero2, last)
    score = Add(zero, high)
    t_cam_target_m = Add(zero2, t)
    zero4 = Unsqueeze(zero2, last)
    R_cam_target = Add(zero4, eye)
    sigma = Add(zero2, sigmas)
}
"""
focals = st.floats(300.0, 8000.0)
frames = st.sampled_from([(1920, 1080), (1280, 1024), (640, 480), (1441, 811), (720, 1280)])


@pytest.fixture(scope="module", params=["letterbox", "squash"])
def estimators(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Estimator, Estimator]:
    """One that tells what the whole frame says, one that refines it in a track window."""
    folder = tmp_path_factory.mktemp(request.param)
    made = []
    for track_size_wh in (None, (224, 224)):
        path = write_toy_model(
            folder / f"{track_size_wh}.onnx",
            graph=PROJECTS,
            acquire_fit=request.param,
            track_size_wh=track_size_wh,
            trained_box_px=(1.0, 10_000.0),
        )
        made.append(Estimator(load_model(path, threads=1)))
    return made[0], made[1]


@settings(max_examples=40)
@given(frames, focals, st.floats(0.97, 1.03), st.floats(0.2, 0.8), st.floats(0.2, 0.8))
@example((1920, 1080), 1662.0, 1.0, 0.5, 0.5)
def test_both_stages_tell_the_point_where_the_frames_own_K_projects_it(
    estimators: tuple[Estimator, Estimator],
    size_wh: tuple[int, int],
    fx: float,
    ratio: float,
    cx_share: float,
    cy_share: float,
) -> None:
    K = np.array([[fx, 0, cx_share * size_wh[0]], [0, fx * ratio, cy_share * size_wh[1]], [0, 0, 1]])
    expected_px = (K @ POINT_M)[:2] / POINT_M[2]
    half = 0.5 * SIZE_M * np.diag(K)[:2] / POINT_M[2]
    assume(np.all(expected_px - half > 0) and np.all(expected_px + half < np.array(size_wh) - 1))
    assume(half.max() > 4.5)
    frame = Frame(FrameMeta(0, 0, 0), np.zeros((size_wh[1], size_wh[0], 3), np.uint8), K)
    for estimator, stage in zip(estimators, ("acquire", "track"), strict=True):
        (found,) = estimator.acquire(frame, thrice=False)  # no mirrored look: its network sees nothing
        assert found.stage == stage
        box = found.box_xyxy_px
        np.testing.assert_allclose(0.5 * (box[:2] + box[2:]), expected_px, atol=EXACT_PX)
        np.testing.assert_allclose(box[2:] - box[:2], 2 * half, atol=EXACT_PX)


@given(
    st.tuples(st.integers(64, 2600), st.integers(64, 2000)),
    st.tuples(st.integers(2, 30), st.integers(2, 30)).map(lambda s: (32 * s[0], 32 * s[1])),
    st.sampled_from(["letterbox", "squash"]),
    st.tuples(st.floats(-0.2, 1.2), st.floats(-0.2, 1.2)),
    focals,
    st.floats(1.0, 2000.0),
)
@settings(max_examples=60, deadline=None)
def test_any_frame_fits_any_network_with_its_rays_kept(
    size_wh: tuple[int, int],
    network_wh: tuple[int, int],
    fit: str,
    at: tuple[float, float],
    focal: float,
    z_m: float,
) -> None:
    K = np.array([[focal, 0, 0.48 * size_wh[0]], [0, 1.01 * focal, 0.53 * size_wh[1]], [0, 0, 1]])
    on_frame = np.array(at) * size_wh
    point_m = z_m * np.linalg.solve(K, [*on_frame, 1.0])
    image, pixel_map = fit_frame(np.zeros((size_wh[1], size_wh[0], 3), np.uint8), network_wh, fit)  # type: ignore[arg-type]
    assert image.shape == (network_wh[1], network_wh[0], 3)
    on_network = (pixel_map.intrinsics(K) @ point_m)[:2] / z_m
    np.testing.assert_allclose(pixel_map.to_frame(on_network), on_frame, atol=EXACT_PX)
    np.testing.assert_allclose(pixel_map.to_network(on_frame), on_network, atol=EXACT_PX)
    # The frame's outer edges lie on the network's where it fills it, and inside it otherwise.
    low, high = pixel_map.to_network([-0.5, -0.5]), pixel_map.to_network(np.array(size_wh) - 0.5)
    assert np.all(low >= -0.5 - EXACT_PX)
    assert np.all(high <= np.array(network_wh) - 0.5 + EXACT_PX)
