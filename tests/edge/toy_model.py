"""A network small enough to reason about: it sees the bright rectangle in a dark picture.

Its centre and size are the rectangle's, its depth Z = f S / sqrt(w h) with S = 10 m (paper: APDD), its rotation that
of an aircraft seen from behind, which mirrored is the same. It has the interface of msgs.contract, so everything around
it can be held to exact truth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import onnx
import onnx.parser

from msgs.contract import METADATA_KEY, ModelContract

SIZE_M = 10.0
SIGMA = (0.5, 0.5, 0.05, 0.1, 0.1, 0.1)

GRAPH = """
<ir_version: 8, opset_import: ["" : 17]>
toy (uint8[N, H, W, 3] image, float[N, 3, 3] K) => (
    float[N, M] score, float[N, M, 2] center_px, float[N, M, 2] size_px, float[N, M, 2] origin_px,
    float[N, M, 3] t_cam_target_m, float[N, M, 3, 3] R_cam_target, float[N, M, 6] sigma)
<float threshold = {128.0}, float one = {1.0}, float size_m = {10.0}, int64 zero = {0},
 int64 step = {1}, int64[1] first = {0}, int64[1] second = {1}, int64[1] third = {2},
 int64[1] end2 = {3}, int64[1] axis_m = {1}, int64[1] axes_last = {1},
 float[1, 1, 3, 3] from_behind = {0, 1, 0, 0, 0, 1, 1, 0, 0},
 float[1, 1, 6] sigmas = {0.5, 0.5, 0.05, 0.1, 0.1, 0.1}>
{
    pixels = Cast<to = 1>(image)
    grey = ReduceMean<axes = [3], keepdims = 0>(pixels)
    bright_b = Greater(grey, threshold)
    bright = Cast<to = 1>(bright_b)
    shape = Shape(grey)
    h1 = Gather(shape, step)
    two = Add(step, step)
    w1 = Gather(shape, two)
    columns_i = Range(zero, w1, step)
    rows_i = Range(zero, h1, step)
    columns = Cast<to = 1>(columns_i)
    rows = Cast<to = 1>(rows_i)
    any_column = ReduceMax<axes = [1], keepdims = 0>(bright)
    any_row = ReduceMax<axes = [2], keepdims = 0>(bright)
    w = ReduceSum<keepdims = 1>(any_column, axes_last)
    h = ReduceSum<keepdims = 1>(any_row, axes_last)
    w_safe = Max(w, one)
    h_safe = Max(h, one)
    x_sum_c = Mul(any_column, columns)
    y_sum_c = Mul(any_row, rows)
    x_sum = ReduceSum<keepdims = 1>(x_sum_c, axes_last)
    y_sum = ReduceSum<keepdims = 1>(y_sum_c, axes_last)
    u = Div(x_sum, w_safe)
    v = Div(y_sum, h_safe)
    score = Min(w, one)
    center = Concat<axis = 1>(u, v)
    size = Concat<axis = 1>(w_safe, h_safe)
    center_px = Unsqueeze(center, axis_m)
    origin_px = Identity(center_px)
    size_px = Unsqueeze(size, axis_m)
    row0 = Slice(K, first, second, axis_m)
    row1 = Slice(K, second, third, axis_m)
    K0 = Squeeze(row0, axis_m)
    K1 = Squeeze(row1, axis_m)
    fx = Slice(K0, first, second, axis_m)
    cx = Slice(K0, third, end2, axis_m)
    fy = Slice(K1, second, third, axis_m)
    cy = Slice(K1, third, end2, axis_m)
    ff = Mul(fx, fy)
    f = Sqrt(ff)
    wh = Mul(w_safe, h_safe)
    side = Sqrt(wh)
    fs = Mul(f, size_m)
    Z = Div(fs, side)
    du = Sub(u, cx)
    dv = Sub(v, cy)
    ray_x = Div(du, fx)
    ray_y = Div(dv, fy)
    X = Mul(ray_x, Z)
    Y = Mul(ray_y, Z)
    t = Concat<axis = 1>(X, Y, Z)
    t_cam_target_m = Unsqueeze(t, axis_m)
    zero_n = Sub(score, score)
    zero_n3 = Unsqueeze(zero_n, axis_m)
    zero_n4 = Unsqueeze(zero_n3, axis_m)
    R_cam_target = Add(zero_n4, from_behind)
    sigma = Add(zero_n3, sigmas)
}
"""

# The same, exported for one picture at a time.
ONE_PICTURE_GRAPH = GRAPH.replace(
    "uint8[N, H, W, 3] image, float[N, 3, 3] K", "uint8[1, H, W, 3] image, float[1, 3, 3] K"
)

# The same, broken: a score that is no number, as of weights that are none.
NO_NUMBER_GRAPH = GRAPH.replace(
    "score = Min(w, one)", "nothing = Sub(w, w)\n    no_number = Div(nothing, nothing)\n    score = Identity(no_number)"
)

CONTRACT: dict[str, Any] = {
    "version": 1,
    "name": "toy",
    "configuration": "edge",
    "backbone": "none",
    "precision": "fp32",
    "max_peaks": 1,
    "acquire_size_wh": (640, 384),
    "acquire_fit": "letterbox",
    "track_size_wh": (256, 256),
    "track_window_scale": 2.0,
    "acquire_score_min": 0.5,
    "track_score_min": 0.5,
    "trained_range_m": (50.0, 600.0),
    "trained_focal_px": (1000.0, 8000.0),
    "trained_box_px": (10.0, 200.0),
    "airframes": [],
    "training": {},
    "metrics": {},
    "weights_sha256": "0" * 64,
}


def write_toy_model(path: Path, metadata: str | None = None, graph: str = GRAPH, **changes: Any) -> Path:
    """The model with a valid contract, or with another one: raw `metadata`, or the contract with `changes`."""
    model = onnx.parser.parse_model(graph)
    onnx.checker.check_model(model)
    text = metadata if metadata is not None else ModelContract(**{**CONTRACT, **changes}).model_dump_json()
    onnx.helper.set_model_props(model, {METADATA_KEY: text})
    onnx.save(model, str(path))
    return path
