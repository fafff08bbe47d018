"""The paper's joint loss, and the terms that the edge configuration adds.

Paper: L_total = lambda_1 L_hm + lambda_2 L_wh + lambda_3 L_trans + lambda_4 L_rot.

Terms are means over the windows that contain a target; heatmap and mask are trained on all windows.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from trainer import equations as eq
from trainer.config import LossConfig
from trainer.data import TrainingBatch
from trainer.model import Decoded
from trainer.refinement import RANGE

SMALLEST_SIZE_PX = 2.0
UNJUDGED = 1.0 - 1e-3  # heatmap target where the focal loss shall be close to zero whatever is predicted
HYPOTHESIS_SPREAD_RAD = 0.35


class Labels(NamedTuple):
    """Labels of N images as tensors; see sim_replay.sample.SampleBatch for frames. Dense ones are at stride 4."""

    K: Tensor  # [N, 3, 3]
    present: Tensor  # [N], float 0 or 1
    R_cam_target: Tensor  # [N, 3, 3]
    t_cam_target_m: Tensor  # [N, 3]
    center_px: Tensor  # [N, 2]
    size_px: Tensor  # [N, 2]
    coverage: Tensor  # [N, H/4, W/4], share of visible target pixels
    noc: Tensor  # [N, 3, H/4, W/4]
    others: Tensor  # [N, H/4, W/4], bool: other aircraft, excluded from the loss
    airframe_id: Tensor  # [N], -1: unknown


def to_tensors(batch: TrainingBatch, device: torch.device) -> tuple[Tensor, Labels]:
    """A batch's images [N, H, W, 3] uint8 and its labels on `device`."""
    put = lambda array: torch.from_numpy(np.ascontiguousarray(array)).to(device)  # noqa: E731
    labels = Labels(
        K=put(batch.K),
        present=put(batch.present.astype(np.float32)),
        R_cam_target=put(batch.R_cam_target),
        t_cam_target_m=put(batch.t_cam_target_m),
        center_px=put(batch.center_px),
        size_px=put(batch.size_px),
        coverage=put(batch.coverage),
        noc=put(batch.noc),
        others=put(batch.others),
        airframe_id=put(batch.airframe_id),
    )
    return put(batch.image_bgr), labels


def gaussian_radius(size_cells: Tensor, overlap: float = 0.7) -> Tensor:
    """CenterNet's radius [...]: a box [..., 2] whose corners move by it keeps IoU >= overlap; at least one cell."""
    w, h = size_cells[..., 0], size_cells[..., 1]
    # IoU falls most where both corners move inwards: (w - 2r) (h - 2r) = overlap w h.
    total, area = w + h, w * h
    radius = 0.25 * (total - torch.sqrt(total * total - 4 * (1 - overlap) * area))
    return torch.clamp(radius, min=1.0)


def center_cell(center_px: Tensor, rows: int, columns: int) -> Tensor:
    """The stride-8 cell [..., 2] (x, y) that contains a pixel [..., 2], clamped to the map."""
    cell = torch.floor((center_px + 0.5) / eq.STRIDE)
    return torch.stack([cell[..., 0].clamp(0, columns - 1), cell[..., 1].clamp(0, rows - 1)], dim=-1)


def heatmap_target(labels: Labels, rows: int, columns: int) -> Tensor:
    """P [N, rows, columns]: a Gaussian with a peak of exactly 1 at the centre's cell, zeros without a target.

    On other aircraft it is UNJUDGED, so that a peak there is neither required nor penalised.
    """
    cell = center_cell(labels.center_px, rows, columns)
    sigma = (2 * gaussian_radius(labels.size_px / eq.STRIDE) + 1) / 6
    x = torch.arange(columns, device=cell.device)
    y = torch.arange(rows, device=cell.device)
    squared = (x[None, None] - cell[:, 0, None, None]) ** 2 + (y[None, :, None] - cell[:, 1, None, None]) ** 2
    target = torch.exp(-squared / (2 * sigma[:, None, None] ** 2)) * labels.present[:, None, None]
    unjudged = UNJUDGED * F.max_pool2d(labels.others.to(target.dtype)[:, None], 2)[:, 0]
    return torch.maximum(target, unjudged)


def heatmap_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Penalty-reduced focal loss (paper: L_hm) over all windows, divided by the number of targets."""
    log_p, log_not_p = F.logsigmoid(logits), F.logsigmoid(-logits)
    p = torch.sigmoid(logits)
    positive = (target >= 1.0).to(logits.dtype)
    terms = positive * (1 - p) ** 2 * log_p + (1 - positive) * (1 - target) ** 4 * p**2 * log_not_p
    return -terms.sum() / positive.sum().clamp(min=1.0)


def rotation_residual(R_est: Tensor, R_true: Tensor) -> Tensor:
    """Rotation vector [..., 3] in `cam`, radians, that turns the estimate [..., 3, 3] into the truth."""
    R = R_true @ R_est.transpose(-1, -2)
    axis = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], dim=-1)
    return F.normalize(axis, dim=-1) * eq.rotation_angle(R_est, R_true)[..., None]


@functools.cache
def _hypotheses(count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return eq.gram_schmidt(eq.heading_anchors(count)).to(device, dtype)


def hypothesis_share(R_allo_true: Tensor, count: int) -> Tensor:
    """Soft assignment [N, count] of a true rotation [N, 3, 3] to hypotheses: near 1 for the one of its heading."""
    anchors = _hypotheses(count, R_allo_true.dtype, R_allo_true.device)
    angle = eq.rotation_angle(R_allo_true[:, None], anchors)
    return torch.softmax(-0.5 * (angle / HYPOTHESIS_SPREAD_RAD) ** 2, dim=-1)


def _error_6d(R_allo: Tensor, R_allo_true: Tensor) -> Tensor:
    """L_6D [...]: mean over the two columns that Gram-Schmidt starts from."""
    return F.smooth_l1_loss(R_allo[..., ::2], R_allo_true[..., ::2].expand_as(R_allo[..., ::2]), reduction="none").mean(
        (-1, -2)
    )


def pose_residual(out: Decoded, labels: Labels) -> Tensor:
    """Error of each image's one decoded peak, before correction: [N, 6] in the units of Decoded.log_sigma."""
    side_px = torch.exp(0.5 * out.log_size[:, 0].sum(-1, keepdim=True))
    log_Z = torch.log(torch.clamp(labels.t_cam_target_m[:, 2:], min=1.0))
    off_px = out.origin_px[:, 0] - _origin_px(labels)
    return torch.cat(
        [off_px / side_px, out.log_Z - log_Z, rotation_residual(out.R_ego[:, 0], labels.R_cam_target)], dim=-1
    )


def refinement_nll(residual: Tensor, correction: Tensor, log_sigma: Tensor) -> Tensor:
    """Laplace negative log-likelihood [N, 6], up to a constant, of residuals [N, 6].

    `correction` [N] is added to the residual of log Z.
    """
    left = torch.cat(
        [residual[:, :RANGE], (residual[:, RANGE] + correction)[:, None], residual[:, RANGE + 1 :]], dim=-1
    )
    return left.abs() * torch.exp(-log_sigma) + log_sigma


def _origin_px(labels: Labels) -> Tensor:
    """Projection of the body's origin in each image: [N, 2]."""
    K, t = labels.K, labels.t_cam_target_m
    f_xy, c_xy = torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=-1), K[:, :2, 2]
    return f_xy * t[:, :2] / torch.clamp(t[:, 2:], min=1.0) + c_xy


def pose_terms(out: Decoded, labels: Labels, weights: LossConfig, ray: bool = True) -> dict[str, Tensor]:
    """The terms that need a target, unweighted, each [N]: the one decoded peak of each image against its labels.

    Paper: size is L_wh, on log sizes; depth and planar form L_trans, geodesic (L_geo) and rotation_6d (L_6D) L_rot.
    Without `ray` the network's allocentric rotation is the one in `cam`.
    """
    one = (value[:, 0] for value in out)
    center, log_size, origin, log_Z, logits, R_allo_k, R_ego_k, _, correction, log_sigma = one
    t, K = labels.t_cam_target_m, labels.K
    Z = torch.clamp(t[:, 2], min=1.0)
    true_plane = t[:, :2] / Z[:, None]
    true_origin = _origin_px(labels)
    true_log_size = torch.log(torch.clamp(labels.size_px, min=SMALLEST_SIZE_PX))
    longer = torch.exp(true_log_size).amax(-1, keepdim=True)
    t_xy = eq.back_project(eq.image_plane_point(origin, K), torch.exp(log_Z))[:, :2]
    R_ray = eq.ray_rotation(eq.unit_ray(true_plane if ray else torch.zeros_like(true_plane)))
    R_allo_true = R_ray.transpose(-1, -2) @ labels.R_cam_target

    share = hypothesis_share(R_allo_true, logits.shape[-1])
    terms = {
        "size": F.smooth_l1_loss(log_size, true_log_size, reduction="none", beta=weights.size_beta).sum(-1),
        "depth": F.smooth_l1_loss(log_Z, torch.log(Z), reduction="none", beta=weights.depth_beta),
        "planar": F.smooth_l1_loss(t_xy, t[:, :2], reduction="none").sum(-1) / Z,
        "geodesic": (share * eq.rotation_angle(R_ego_k, labels.R_cam_target[:, None])).sum(-1) / math.pi,
        "rotation_6d": (share * _error_6d(R_allo_k, R_allo_true[:, None])).sum(-1),
        "hypothesis": -(share * F.log_softmax(logits, dim=-1)).sum(-1),
        "center": F.smooth_l1_loss(center, labels.center_px, reduction="none", beta=2.0).sum(-1) / eq.STRIDE,
        "origin": F.smooth_l1_loss(origin / longer, true_origin / longer, reduction="none", beta=0.02).sum(-1),
    }
    if weights.uncertainty > 0:
        # Trains the refinement head alone: the head's inputs are detached, and so is the residual here.
        terms["uncertainty"] = refinement_nll(pose_residual(out, labels).detach(), correction, log_sigma).sum(-1)
    return terms


def dense_terms(dense: Tensor, labels: Labels) -> dict[str, Tensor]:
    """Training-only heads [N, 4, H/4, W/4]: mask in all windows, object coordinates where the target is visible.

    Cells without a label (NaN) are ignored, and so are other aircraft.
    """
    known = labels.coverage.isfinite() & ~labels.others
    coverage = torch.where(known, labels.coverage, 0.0)
    mask = F.binary_cross_entropy_with_logits(dense[:, 0], coverage, reduction="none") * known
    seen = (coverage > 0.3) & labels.noc.isfinite().all(dim=1)
    true_noc = torch.where(seen[:, None], labels.noc, 0.0)
    # Object coordinates lie within half a diameter: a factor of 10 scales their errors to the other terms.
    error = F.smooth_l1_loss(10 * dense[:, 1:], 10 * true_noc, reduction="none").mean(1)
    noc = (error * seen).sum((1, 2)) / seen.sum((1, 2)).clamp(min=1)
    return {"mask": mask.mean((1, 2)), "noc": noc}


def joint_loss(
    heat_logits: Tensor, out: Decoded, dense: Tensor | None, labels: Labels, weights: LossConfig, ray: bool = True
) -> tuple[Tensor, dict[str, Tensor]]:
    """L_total and its unweighted terms, each a scalar."""
    count = labels.present.sum().clamp(min=1.0)
    over_targets = {k: (v * labels.present).sum() / count for k, v in pose_terms(out, labels, weights, ray).items()}
    terms = {"heatmap": heatmap_loss(heat_logits, heatmap_target(labels, *heat_logits.shape[-2:])), **over_targets}
    if dense is not None:
        by_window = dense_terms(dense, labels)
        terms["mask"] = by_window["mask"].mean()
        terms["noc"] = (by_window["noc"] * labels.present).sum() / count
    L_trans = weights.depth * terms["depth"] + weights.planar * terms["planar"]
    L_rot = terms["geodesic"] + weights.rotation_6d * terms["rotation_6d"]
    total = weights.heatmap * terms["heatmap"] + weights.size * terms["size"]
    total = total + weights.translation * L_trans + weights.rotation * L_rot
    for name in ("hypothesis", "center", "origin", "mask", "noc", "uncertainty"):
        if name in terms:
            total = total + getattr(weights, name) * terms[name]
    return total, terms
