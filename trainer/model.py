"""MF-UAVPose6D: one image and its intrinsics to the 6-DoF poses of the aircraft in it.

Read `PoseNet.forward` first: backbone and neck, heatmap peaks, then `decode` takes each peak through the paper's
modules in the paper's order. Training decodes one guided peak per image (trainer.guidance), inference the M highest.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from trainer import equations as eq
from trainer.backbones import build_backbone
from trainer.choice import ChoiceHead, options_of
from trainer.config import Z_RANGE_M, ModelConfig
from trainer.layers import conv_bn_relu, mlp
from trainer.neck import AlignFuseNeck
from trainer.presence import PresenceHead
from trainer.refinement import SIGMAS, Evidence, Refined, RefinementHead, answers_of

OCT_OFFSETS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
ADDED_HEADS = ("head_choice", "head_presence")  # those that `trainer.refine` adds to a trained network
REGION = 7
IMAGENET_MEAN_BGR = (103.53, 116.28, 123.675)
IMAGENET_STD_BGR = (57.375, 57.12, 58.395)


class Decoded(NamedTuple):
    """Predictions for M peaks in each of N images. Pixels of the input image; `cam` frame; metres."""

    center_px: Tensor  # [N, M, 2]
    log_size: Tensor  # [N, M, 2], log (w, h) in log pixels
    origin_px: Tensor  # [N, M, 2]
    log_Z: Tensor  # [N, M], not clamped, without the refinement head's correction
    hypothesis_logits: Tensor  # [N, M, K]
    R_allo_k: Tensor  # [N, M, K, 3, 3], every hypothesis
    R_ego_k: Tensor  # [N, M, K, 3, 3]
    R_ego: Tensor  # [N, M, 3, 3], the most likely hypothesis
    correction: Tensor  # [N, M], to be added to log Z
    log_sigma: Tensor  # [N, M, 6], Laplace scale: (u, v) in box sides sqrt(w h), corrected log Z, rotation x y z in rad


class Perception(NamedTuple):
    """Everything that does not depend on a peak."""

    F_global: Tensor  # [N, C, H/8, W/8]
    heat_logits: Tensor  # [N, H/8, W/8]


class PerspectiveAwareModule(nn.Module):
    """PAM: f_pam = Proj(f_c) * sigmoid(gamma) + beta, [gamma, beta] = MLP_ray(x/z, y/z); without `ray`: Proj(f_c)."""

    def __init__(self, channels: int, hidden: int, ray: bool) -> None:
        super().__init__()
        self.ray_encoder = mlp(2, hidden // 2, 2 * hidden) if ray else None
        self.project = nn.Linear(channels, hidden)

    def forward(self, f_c: Tensor, plane_xy: Tensor) -> Tensor:
        if self.ray_encoder is None:
            return self.project(f_c)
        gamma, beta = self.ray_encoder(plane_xy).split(self.project.out_features, dim=-1)
        return self.project(f_c) * torch.sigmoid(gamma) + beta


class DynamicTopologicalSampling(nn.Module):
    """DTS: eight points on the box's edges and corners (f_oct) and a 7x7 grid over it (f_reg)."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        steps = torch.linspace(-1.0, 1.0, REGION)
        grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
        offsets = torch.cat([torch.tensor(OCT_OFFSETS, dtype=torch.float32), grid])
        self.register_buffer("offsets", offsets, persistent=False)
        self.channels = channels
        narrow = channels // 2
        self.convs = nn.Sequential(conv_bn_relu(channels, narrow, 3), conv_bn_relu(narrow, channels, 3, stride=2))
        self.region = nn.Linear(channels * 16, hidden)

    def forward(
        self, F_global: Tensor, center_px: Tensor, size_px: Tensor, extent_px: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """F_global [N, C, H_f, W_f], centre and size [N, M, 2] px in an image of `extent_px` [2], to f_oct [N M, 8 C],
        f_reg [N M, hidden] and the grid [N M, C, 7, 7] that f_reg is computed from."""
        # align_corners=False puts -1 and 1 on the outer edges of the border pixels.
        center, size = (2.0 * center_px + 1.0) / extent_px - 1.0, size_px / extent_px
        points = center[:, :, None] + size[:, :, None] * self.get_buffer("offsets")
        sampled = F.grid_sample(F_global, points, mode="bilinear", padding_mode="zeros", align_corners=False)
        sampled = sampled.permute(0, 2, 3, 1).reshape(-1, len(OCT_OFFSETS) + REGION**2, self.channels)
        f_oct = sampled[:, : len(OCT_OFFSETS)].reshape(-1, len(OCT_OFFSETS) * self.channels)
        grid = sampled[:, len(OCT_OFFSETS) :].reshape(-1, REGION, REGION, self.channels).permute(0, 3, 1, 2)
        return f_oct, F.relu(self.region(self.convs(grid).flatten(1))), grid


class GatedFusion(nn.Module):
    """Gamma(f_reg, Phi(f_geo)) as gated addition: f_reg + sigmoid(g) * Phi(f_geo), g from both."""

    def __init__(self, geo: int, hidden: int) -> None:
        super().__init__()
        self.context = nn.Sequential(nn.Linear(geo, hidden), nn.ReLU(inplace=True))
        self.gate = nn.Linear(2 * hidden, hidden)

    def forward(self, f_reg: Tensor, f_geo: Tensor) -> Tensor:
        context = self.context(f_geo)
        return f_reg + torch.sigmoid(self.gate(torch.cat([f_reg, context], dim=-1))) * context


class RegionOnly(nn.Module):
    """Replaces GatedFusion when DTS's context is switched off: passes f_reg through."""

    def forward(self, f_reg: Tensor, f_geo: Tensor) -> Tensor:
        return f_reg


class PoseNet(nn.Module):
    """The network. `forward` is the exported graph (see msgs.contract); a training step calls `perceive`, `dense` and
    `decode`."""

    def __init__(self, config: ModelConfig, added: Collection[str] = (), presence_beside: int = 0) -> None:
        """`added`: which of ADDED_HEADS there are; `presence_beside`: presence heads beside the first."""
        super().__init__()
        self.config = config
        C, hidden = config.channels, config.hidden
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN_BGR)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD_BGR)[:, None, None], persistent=False)
        self.backbone = build_backbone(config.backbone, config.pretrained)
        self.neck = AlignFuseNeck(self.backbone.channels, C)
        self.head_hm = nn.Sequential(conv_bn_relu(C, C // 2, 3), nn.Conv2d(C // 2, 1, 1))
        self.head_center = mlp(C, C // 2, 2) if config.center == "regressed" else None
        self.pam = PerspectiveAwareModule(C, hidden, config.ray)
        self.mlp_wh = mlp(hidden, hidden // 2, 2)
        self.dts = DynamicTopologicalSampling(C, hidden)
        geo = C + 8 * C + hidden + 2
        self.fuse_t, self.fuse_r = (GatedFusion(geo, hidden) if config.topology else RegionOnly() for _ in range(2))
        self.mlp_t, self.mlp_r = (nn.Sequential(mlp(hidden, hidden, hidden), nn.ReLU(inplace=True)) for _ in range(2))
        self.head_trans = nn.Linear(hidden, 3)
        self.head_rot = nn.Linear(hidden, 6 * config.hypotheses)
        self.head_hypothesis = nn.Linear(hidden, config.hypotheses) if config.hypotheses > 1 else None
        self.head_extents = nn.Linear(hidden, 3) if config.depth == "rotation_aware" else None
        self.head_refine = RefinementHead(C, hidden, config.hypotheses) if config.uncertainty else None
        of_added = C, hidden, config.hypotheses
        self.head_choice = ChoiceHead(*of_added) if "head_choice" in added else None
        self.head_presence = PresenceHead(*of_added, presence_beside) if "head_presence" in added else None
        # Shallow on purpose, so that F_global itself must encode the object coordinates.
        self.head_dense = nn.Sequential(conv_bn_relu(C, C // 2, 3), nn.Conv2d(C // 2, 16, 1)) if config.dense else None
        self._init_priors()

    @torch.no_grad()
    def _init_priors(self) -> None:
        """Initial outputs near a typical aircraft: heatmap at 0.01, S near 8 m, body down near image down."""
        last = self.head_hm[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        last.bias.fill_(math.log(0.01 / 0.99))
        for head in (self.head_trans, self.head_rot, self.head_extents):
            if head is not None:
                head.weight.mul_(0.1)
                head.bias.zero_()
        if self.head_hypothesis is not None:
            self.head_rot.bias.copy_(eq.heading_anchors(self.config.hypotheses).flatten())
        else:
            self.head_rot.bias.copy_(torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.1]))
        if self.head_extents is not None:
            self.head_extents.bias.copy_(torch.log(torch.tensor([4.5, 5.5, 1.5])))
        else:
            self.head_trans.bias[2] = math.log(250.0 if self.config.depth == "direct" else 8.0)

    def perceive(self, image_bgr: Tensor) -> Perception:
        """uint8 image [N, H, W, 3] to F_global and the heatmap's logits."""
        x = (image_bgr.permute(0, 3, 1, 2).float() - self.get_buffer("mean")) / self.get_buffer("std")
        if image_bgr.device.type == "cuda" or torch.is_autocast_enabled("cpu"):
            x = x.contiguous(memory_format=torch.channels_last)
        F_global = self.neck(self.backbone(x))
        return Perception(F_global, self.head_hm(F_global)[:, 0])

    def dense(self, F_global: Tensor) -> Tensor:
        """Mask logit and object coordinates [N, 4, H/4, W/4]; training only."""
        assert self.head_dense is not None
        return F.pixel_shuffle(self.head_dense(F_global), 2)

    def decode(self, seen: Perception, K: Tensor, peaks_xy: Tensor, guide_size_px: Tensor | None = None) -> Decoded:
        """Each peak [N, M, 2] (cells) to a pose. K [N, 3, 3]; `guide_size_px` [N, M, 2], where positive, replaces the
        predicted box size in DTS."""
        return self.decode_with_evidence(seen, K, peaks_xy, guide_size_px)[0]

    def decode_with_evidence(
        self, seen: Perception, K: Tensor, peaks_xy: Tensor, guide_size_px: Tensor | None = None
    ) -> tuple[Decoded, Evidence]:
        """As `decode`, with what the refinement head reads of the N M peaks.

        Internally the peaks of all images are the rows of one matrix: a linear layer over two dimensions exports as
        one node, over three as several.
        """
        F_global, log_P = seen.F_global, F.logsigmoid(seen.heat_logits)
        M = int(peaks_xy.shape[1])
        K = K[:, None].expand(-1, M, -1, -1).reshape(-1, 3, 3)
        f_c, center_px = self._anchor_of(F_global, log_P, peaks_xy)
        f_pam = self.pam(f_c, eq.image_plane_point(center_px, K))
        log_size = self.mlp_wh(f_pam) + torch.log(self._anchor(log_P))
        size_px = torch.exp(log_size)
        grid_size = size_px.detach()
        if guide_size_px is not None:
            guide_size_px = guide_size_px.reshape(-1, 2)
            grid_size = torch.where(guide_size_px > 0, guide_size_px, grid_size)
        boxes = (center_px.detach().reshape(-1, M, 2), grid_size.reshape(-1, M, 2))
        f_oct, f_reg, grid = self.dts(F_global, *boxes, _extent_px(log_P))
        # The grid is normalised by the box, so its size must be passed separately.
        f_geo = torch.cat([f_c, f_oct, f_pam, torch.log(grid_size / 32.0)], dim=-1)
        f_trans = self.mlp_t(self.fuse_t(f_reg, f_geo))
        f_rot = self.mlp_r(self.fuse_r(f_reg, f_geo))

        count = self.config.hypotheses
        r_6d = self.head_rot(f_rot)
        R_allo_k = eq.gram_schmidt(r_6d.reshape(-1, count, 6))
        o_xy, s = self.head_trans(f_trans).split([2, 1], dim=-1)
        origin_px = center_px + self.config.origin_range * size_px * torch.tanh(o_xy)
        plane_xy = eq.image_plane_point(origin_px, K)
        log_f = torch.log(eq.focal_length(K, self.config.focal))
        logits = own_logits = self._own_logits(f_rot)
        options = options_of(log_size, log_f, plane_xy, r_6d, own_logits)
        if self.head_choice is not None:
            logits = self.head_choice(grid, f_trans, f_rot, options)
        R_allo = _likeliest(logits, r_6d)
        S = torch.exp(s[..., 0])
        if self.head_extents is not None:
            S = S * eq.seen_scale(torch.exp(self.head_extents(f_trans)), R_allo.detach())
        if self.config.depth == "direct":
            log_Z = s[..., 0]
        else:
            log_Z = torch.log(eq.apdd_depth(eq.focal_length(K, self.config.focal), S, size_px))
        R_ray = eq.ray_rotation(eq.unit_ray(plane_xy if self.config.ray else torch.zeros_like(plane_xy)))
        R_ego = R_ray @ R_allo
        # The heads that read these must not depend on how sure the choice head is.
        answers = answers_of(log_size, log_f, log_Z, plane_xy, own_logits, R_ego)
        evidence = Evidence(grid, f_trans, f_rot, answers, options)
        refined = self._refined(evidence)
        decoded = Decoded(
            center_px.reshape(-1, M, 2),
            log_size.reshape(-1, M, 2),
            origin_px.reshape(-1, M, 2),
            log_Z.reshape(-1, M),
            logits.reshape(-1, M, count),
            R_allo_k.reshape(-1, M, count, 3, 3),
            (R_ray[:, None] @ R_allo_k).reshape(-1, M, count, 3, 3),
            R_ego.reshape(-1, M, 3, 3),
            refined.correction.reshape(-1, M),
            refined.log_sigma.reshape(-1, M, SIGMAS),
        )
        return decoded, evidence

    def _anchor_of(self, F_global: Tensor, log_P: Tensor, peaks_xy: Tensor) -> tuple[Tensor, Tensor]:
        """Features [N M, C] and centre [N M, 2] px of each peak, or of the whole image if centres are regressed."""
        channels = self.config.channels
        if self.head_center is None:
            W, center_px = eq.soft_argmax(log_P, peaks_xy.to(log_P.dtype), self._sigma_g(log_P))
            cells = F_global.reshape(peaks_xy.shape[0], channels, -1)
            return (W @ cells.transpose(1, 2)).reshape(-1, channels), center_px.reshape(-1, 2)
        f_c = F_global.mean((2, 3))[:, None].expand(-1, peaks_xy.shape[1], -1).reshape(-1, channels)
        extent_px = _extent_px(log_P)
        return f_c, 0.5 * (extent_px - 1) + 0.5 * extent_px * torch.tanh(self.head_center(f_c))

    def _own_logits(self, f_rot: Tensor) -> Tensor:
        """Logits [P, K] without the choice head."""
        return torch.zeros_like(f_rot[:, :1]) if self.head_hypothesis is None else self.head_hypothesis(f_rot)

    def _refined(self, evidence: Evidence) -> Refined:
        if self.head_refine is None:
            zeros = torch.zeros_like(evidence.f_trans[..., :SIGMAS])
            return Refined(zeros[..., 0], zeros)
        return self.head_refine(evidence)

    def _sigma_g(self, log_P: Tensor) -> Tensor | float:
        cells = self.config.soft_argmax_sigma_cells
        return cells if cells is not None else _float(log_P.shape[-1], log_P) / 32.0

    def _anchor(self, log_P: Tensor) -> Tensor:
        """Sides in pixels, [1] or [2], of the reference box; sizes are predicted as multiples of it."""
        if self.config.box_anchor_px is not None:
            return eq.constant((self.config.box_anchor_px,), log_P)
        return 0.1 * _extent_px(log_P)

    def forward(self, image: Tensor, K: Tensor) -> tuple[Tensor, ...]:
        """The exported graph: the outputs of msgs.contract.OUTPUT_NAMES, in that order."""
        seen = self.perceive(image)
        seen = Perception(seen.F_global.float(), seen.heat_logits.float())
        score, peaks_xy = eq.heatmap_peaks(torch.sigmoid(seen.heat_logits), self.config.max_peaks)
        out, evidence = self.decode_with_evidence(seen, K, peaks_xy)
        if self.head_presence is not None:
            score = self.head_presence(evidence, score.flatten()).reshape(-1, self.config.max_peaks)
        size_px = torch.exp(out.log_size)
        Z = torch.clamp(torch.exp(out.log_Z + out.correction), *Z_RANGE_M)
        t_cam_target_m = eq.back_project(eq.image_plane_point(out.origin_px, K[:, None]), Z)
        side_px = torch.sqrt(size_px.prod(-1, keepdim=True))
        # A Laplace distribution of scale b has the standard deviation sqrt(2) b.
        sigma = math.sqrt(2.0) * torch.exp(out.log_sigma)
        sigma = torch.cat([sigma[..., :2] * side_px, sigma[..., 2:]], dim=-1)
        return score, out.center_px, size_px, out.origin_px, t_cam_target_m, out.R_ego, sigma


def _likeliest(logits: Tensor, r_6d: Tensor) -> Tensor:
    """The rotation [P, 3, 3] with the highest of the logits [P, K]: one mode, never the mean of several."""
    if logits.shape[-1] == 1:
        return eq.gram_schmidt(r_6d)
    of_best = 6 * logits.argmax(-1, keepdim=True) + torch.arange(6, device=r_6d.device)
    return eq.gram_schmidt(torch.gather(r_6d, 1, of_best))


def _extent_px(log_P: Tensor) -> Tensor:
    """Width and height [2] of the image in pixels, from its heatmap [N, H_f, W_f]; stays dynamic on export."""
    return eq.STRIDE * torch.stack([_float(log_P.shape[2], log_P), _float(log_P.shape[1], log_P)])


def _float(length: int | Tensor, like: Tensor) -> Tensor:
    """A dimension as a scalar tensor, so that it stays dynamic on export."""
    return length.to(like) if isinstance(length, Tensor) else like.new_full((), length)
