"""The paper's equations as pure functions of tensors, in its notation. `cam` frame, pixels, metres, radians.

Pixel centres lie at integers, so cell x of a stride-s map is centred at s (x + 0.5) - 0.5.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

STRIDE = 8
SHARPENING = 2.2


def soft_argmax(log_P: Tensor, peaks_xy: Tensor, sigma_g: Tensor | float) -> tuple[Tensor, Tensor]:
    """Centre anchor around each peak (paper: G, A = P^2.2 G, W = A / sum A, (u, v)).

    log_P [N, H_f, W_f] is log P_hm, peaks_xy [N, M, 2] are cells, sigma_g cells.
    Returns W [N, M, H_f W_f] and the anchor [N, M, 2] in pixels. A softmax of log A is A / sum A without underflow.
    """
    rows, columns = log_P.shape[-2], log_P.shape[-1]
    x = torch.arange(columns, device=log_P.device, dtype=log_P.dtype)
    y = torch.arange(rows, device=log_P.device, dtype=log_P.dtype)
    log_Gx = -((x - peaks_xy[..., 0:1]) ** 2) / (2 * sigma_g**2)
    log_Gy = -((y - peaks_xy[..., 1:2]) ** 2) / (2 * sigma_g**2)
    log_A = SHARPENING * log_P[:, None] + log_Gy[..., :, None] + log_Gx[..., None, :]
    W = torch.softmax(log_A.flatten(2), dim=-1)
    W_map = W.reshape(log_A.shape)
    cell = torch.stack([(W_map.sum(-2) * x).sum(-1), (W_map.sum(-1) * y).sum(-1)], dim=-1)
    return W, STRIDE * (cell + 0.5) - 0.5


def image_plane_point(point_px: Tensor, K: Tensor) -> Tensor:
    """(x/z, y/z) [..., 2] of the ray through point_px [..., 2]; K [..., 3, 3] without skew."""
    f = torch.stack([K[..., 0, 0], K[..., 1, 1]], dim=-1)
    c = torch.stack([K[..., 0, 2], K[..., 1, 2]], dim=-1)
    return (point_px - c) / f


def unit_ray(plane_xy: Tensor) -> Tensor:
    """Unit observation ray d [..., 3] in `cam` through (x/z, y/z) [..., 2] (paper: d = K^-1 [u v 1]^T / norm)."""
    return F.normalize(torch.cat([plane_xy, torch.ones_like(plane_xy[..., :1])], dim=-1), dim=-1)


def ray_rotation(d: Tensor) -> Tensor:
    """R_ray [..., 3, 3]: the smallest rotation that takes the optical axis z to the unit ray d [..., 3].

    I + [v]x + [v]x^2 / (1 + c) with v = z x d and c = z . d, written out; needs d_z > -1.
    """
    dx, dy, c = d.unbind(-1)
    k = 1.0 / (1.0 + c)
    rows = [
        torch.stack([1 - k * dx * dx, -k * dx * dy, dx], dim=-1),
        torch.stack([-k * dx * dy, 1 - k * dy * dy, dy], dim=-1),
        torch.stack([-dx, -dy, c], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def gram_schmidt(r_6d: Tensor) -> Tensor:
    """R [..., 3, 3] from r_6D [..., 6] (paper: GS).

    The two vectors are the body's z and x axes, z first: an aircraft's down axis varies least, so it leads.
    """
    z = F.normalize(r_6d[..., :3], dim=-1)
    x = r_6d[..., 3:] - (z * r_6d[..., 3:]).sum(-1, keepdim=True) * z
    x = F.normalize(x, dim=-1)
    y = torch.stack(
        [
            z[..., 1] * x[..., 2] - z[..., 2] * x[..., 1],
            z[..., 2] * x[..., 0] - z[..., 0] * x[..., 2],
            z[..., 0] * x[..., 1] - z[..., 1] * x[..., 0],
        ],
        dim=-1,
    )
    return torch.stack([x, y, z], dim=-1)


def heading_anchors(count: int) -> Tensor:
    """r_6D [count, 6] of a level aircraft at evenly spaced headings, as seen along the ray: z is image down."""
    heading = 2 * torch.pi * torch.arange(count) / count
    zero = torch.zeros(count)
    return torch.stack([zero, zero + 1, zero, torch.sin(heading), zero, torch.cos(heading)], dim=-1)


def focal_length(K: Tensor, kind: str) -> Tensor:
    """f [...] in pixels: the paper's "mean", or "geometric", with which APDD survives an anisotropic resize."""
    fx, fy = K[..., 0, 0], K[..., 1, 1]
    return 0.5 * (fx + fy) if kind == "mean" else torch.sqrt(fx * fy)


def seen_scale(extents_m: Tensor, R_allo: Tensor) -> Tensor:
    """S [...] in metres of an ellipsoid with half-axes extents_m [..., 3] along body x, y, z, seen from R_allo.

    sqrt of its projected width times height: half-width_x = sqrt(sum_j (R_1j e_j)^2), half-height_y likewise.
    """
    half = torch.sqrt(((R_allo[..., :2, :] * extents_m[..., None, :]) ** 2).sum(-1) + 1e-9)
    return 2.0 * torch.sqrt(half[..., 0] * half[..., 1])


def apdd_depth(f_px: Tensor, S_m: Tensor, size_px: Tensor) -> Tensor:
    """Z = f S / S_img [...] in metres, S_img = sqrt(w h + eps) (paper: APDD); size_px [..., 2]."""
    return f_px * S_m / torch.sqrt(size_px[..., 0] * size_px[..., 1] + 1e-6)


def back_project(plane_xy: Tensor, Z_m: Tensor) -> Tensor:
    """T [..., 3] = (x/z Z, y/z Z, Z) in metres, `cam`."""
    return torch.cat([plane_xy * Z_m[..., None], Z_m[..., None]], dim=-1)


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
    """The `count` highest local maxima of P [N, H_f, W_f]: falling values [N, count], cells (x, y) [N, count, 2]."""
    highest = F.max_pool2d(P[:, None], 3, stride=1, padding=1)[:, 0]
    kept = torch.where(highest == P, P, torch.zeros_like(P))
    values, index = torch.topk(kept.flatten(1), count, dim=1)
    columns = P.shape[-1]
    row = torch.div(index, columns, rounding_mode="floor")
    return values, torch.stack([index - row * columns, row], dim=-1)
