"""The paper's equations as pure functions of tensors, in its notation. `cam` frame, pixels, metres, radians.

Pixel centres lie at integers, so cell x of a stride-s map is centred at s (x + 0.5) - 0.5.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor
from torch.nn import functional as F

STRIDE = 8
SHARPENING = 2.2

Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]


def constant(values: Numbers, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """These values as a tensor on the device of `like`, of its type unless another is given; copied there only once.

    Each copy from the processor makes a GPU wait, and a CUDA graph cannot contain one.
    """
    return _constant(values, dtype or like.dtype, like.device)


@functools.cache
def _constant(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # the first caller may be evaluating, a later one training
        return torch.tensor(values, dtype=dtype, device=device)


def soft_argmax(log_P: Tensor, peaks_xy: Tensor, sigma_g: Tensor | float) -> tuple[Tensor, Tensor]:
    """Centre anchor around each peak (paper: G, A = P^2.2 G, W = A / sum A, (u, v)).

    log_P [N, H_f, W_f] is log P_hm, peaks_xy [N, M, 2] are cells, sigma_g cells.
    Returns W [N, M, H_f W_f] and the anchor [N, M, 2] in pixels. A softmax of log A is A / sum A without underflow.
    """
    columns = log_P.shape[-1]
    index = torch.arange(log_P.shape[-2] * columns, device=log_P.device)
    cells_xy = _cells_xy(index, columns).to(log_P.dtype)
    away = cells_xy - peaks_xy[:, :, None]
    log_G = (away * away).sum(-1) * (-0.5 / sigma_g**2)
    W = torch.softmax(SHARPENING * log_P.flatten(1)[:, None] + log_G, dim=-1)
    return W, STRIDE * (W @ cells_xy) + (0.5 * STRIDE - 0.5)


def image_plane_point(point_px: Tensor, K: Tensor) -> Tensor:
    """(x/z, y/z) [..., 2] of the ray through point_px [..., 2]; K [..., 3, 3] without skew."""
    return (point_px - K[..., :2, 2]) / _focal_lengths(K)


def _focal_lengths(K: Tensor) -> Tensor:
    """(f_x, f_y) [..., 2] of K [..., 3, 3]; ignores skew."""
    return (K[..., :2, :2] * constant(((1.0, 0.0), (0.0, 1.0)), K)).sum(-1)


def _unit(vector: Tensor) -> Tensor:
    """Vectors [..., 3] normalised to unit length; F.normalize exports twice the nodes."""
    return vector / torch.linalg.vector_norm(vector, dim=-1, keepdim=True).clamp(min=1e-12)


def unit_ray(plane_xy: Tensor) -> Tensor:
    """Unit observation ray d [..., 3] in `cam` through (x/z, y/z) [..., 2] (paper: d = K^-1 [u v 1]^T / norm)."""
    return _unit(F.pad(plane_xy, (0, 1), value=1.0))


def ray_rotation(d: Tensor) -> Tensor:
    """R_ray [..., 3, 3]: the smallest rotation that takes the optical axis z to the unit ray d [..., 3].

    I + [v]x + [v]x^2 / (1 + c) with v = z x d and c = z . d, which is I + 2 d z^T - (d + z) (d + z)^T / (1 + c); needs
    d_z > -1.
    """
    I = constant(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), d)
    z = constant((0.0, 0.0, 1.0), d)
    both = d + z
    return I + d[..., None] * (2.0 * z) - both[..., None] * (both / both[..., 2:])[..., None, :]


def gram_schmidt(r_6d: Tensor) -> Tensor:
    """R [..., 3, 3] from r_6D [..., 6] (paper: GS).

    The two vectors are the body's z and x axes, z first: an aircraft's down axis varies least, so it leads.
    """
    z = _unit(r_6d[..., :3])
    x = _unit(r_6d[..., 3:] - (z * r_6d[..., 3:]).sum(-1, keepdim=True) * z)
    next_axis, last_axis = constant((1, 2, 0), z, torch.int64), constant((2, 0, 1), z, torch.int64)
    y = z.index_select(-1, next_axis) * x.index_select(-1, last_axis)
    y = y - z.index_select(-1, last_axis) * x.index_select(-1, next_axis)
    return torch.stack([x, y, z], dim=-1)


def heading_anchors(count: int) -> Tensor:
    """r_6D [count, 6] of a level aircraft at evenly spaced headings, in the ray's frame: z is image down."""
    heading = 2 * torch.pi * torch.arange(count) / count
    zero = torch.zeros(count)
    return torch.stack([zero, zero + 1, zero, torch.sin(heading), zero, torch.cos(heading)], dim=-1)


def _area(sides: Tensor) -> Tensor:
    """The product [...] of two numbers [..., 2]; the gradient of torch.prod waits for a GPU to count zeros."""
    return sides[..., 0] * sides[..., 1]


def focal_length(K: Tensor, kind: str) -> Tensor:
    """f [...] in pixels: the paper's "mean", or "geometric", which keeps APDD exact under an anisotropic resize."""
    f = _focal_lengths(K)
    return f.mean(-1) if kind == "mean" else torch.sqrt(_area(f))


def seen_scale(extents_m: Tensor, R_allo: Tensor) -> Tensor:
    """S [...] in metres of an ellipsoid with half-axes extents_m [..., 3] along body x, y, z, seen from R_allo.

    sqrt of its projected width times height: half-width_x = sqrt(sum_j (R_1j e_j)^2), half-height_y likewise.
    """
    along = R_allo[..., :2, :] * extents_m[..., None, :]
    return 2.0 * _area((along * along).sum(-1) + 1e-9) ** 0.25


def apdd_depth(f_px: Tensor, S_m: Tensor, size_px: Tensor) -> Tensor:
    """Z = f S / S_img [...] in metres, S_img = sqrt(w h + eps) (paper: APDD); size_px [..., 2]."""
    return f_px * S_m / torch.sqrt(_area(size_px) + 1e-6)


def back_project(plane_xy: Tensor, Z_m: Tensor) -> Tensor:
    """T [..., 3] = (x/z Z, y/z Z, Z) in metres, `cam`."""
    return F.pad(plane_xy, (0, 1), value=1.0) * Z_m[..., None]


def rotation_angle(R_a: Tensor, R_b: Tensor) -> Tensor:
    """Geodesic distance [...] in radians; atan2 keeps its gradient finite at 0, where arccos does not."""
    relative = R_a.transpose(-1, -2) @ R_b
    sine = 0.5 * torch.sqrt(
        (relative[..., 2, 1] - relative[..., 1, 2]) ** 2
        + (relative[..., 0, 2] - relative[..., 2, 0]) ** 2
        + (relative[..., 1, 0] - relative[..., 0, 1]) ** 2
        + 1e-12
    )
    cosine = 0.5 * (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)
    return torch.atan2(sine, cosine)


def heatmap_peaks(P: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Values [N, count], descending, and cells (x, y) [N, count, 2] of the highest local maxima of P [N, H_f, W_f]."""
    highest = F.max_pool2d(P[:, None], 3, stride=1, padding=1)[:, 0]
    kept = torch.where(highest == P, P, torch.zeros_like(P))
    values, index = torch.topk(kept.flatten(1), count, dim=1)
    columns = P.shape[-1]
    return values, _cells_xy(index, columns)


def _cells_xy(index: Tensor, columns: int) -> Tensor:
    """Cells (x, y) [..., 2] of non-negative indices [...] into a flattened map."""
    # Same as floor division for these numbers, which would export as eight nodes.
    return torch.stack([index % columns, torch.div(index, columns, rounding_mode="trunc")], dim=-1)
