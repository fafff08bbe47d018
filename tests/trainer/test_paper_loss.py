"""The paper's loss term by term, worked by hand: SmoothL1(d) is d^2 / 2 below 1 and |d| - 1/2 above (beta 1)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import tiny
import torch
from scipy.spatial.transform import Rotation
from test_losses import labels_at, perfect

from trainer.cli import EDGE_CONFIG
from trainer.config import LossConfig, load_config
from trainer.losses import heatmap_loss, heatmap_target, joint_loss, pose_terms

PAPER = load_config(EDGE_CONFIG.with_name("paper.toml")).loss
# Origin projected at (40, 25), 200 m away, f = 900 px, c = (32, 32): t = (16/9, -14/9, 200) m.
LABELS = labels_at((40.0, 25.0), (30.0, 12.0))


def terms_of(**changed: torch.Tensor) -> dict[str, float]:
    out = perfect(LABELS, 1)._replace(**changed)
    return {name: value.item() for name, value in pose_terms(out, LABELS, PAPER).items()}


def test_box_sizes_cost_in_logarithms() -> None:
    """Twice too wide: |ln 2| - 0.05 with beta 0.1; height right."""
    log_size = torch.log(LABELS.size_px * torch.tensor([2.0, 1.0]))[:, None]
    assert terms_of(log_size=log_size)["size"] == pytest.approx(math.log(2) - 0.05, rel=1e-5)


def test_depth_costs_in_logarithms_and_drags_the_plane_along() -> None:
    """Depth e^0.2 times too far: 0.2^2 / 2; T_xy off by (16/9, 14/9) (e^0.2 - 1), over 200 m."""
    terms = terms_of(log_Z=torch.log(torch.tensor([[200.0]])) + 0.2)
    assert terms["depth"] == pytest.approx(0.02, rel=1e-4)
    off_m = [a / 9 * (math.exp(0.2) - 1) for a in (16, 14)]
    assert terms["planar"] == pytest.approx(sum(d * d / 2 for d in off_m) / 200, rel=1e-3)


def test_a_sideways_error_costs_metres_over_depth() -> None:
    """9 px of 900 at 200 m are 2 m: (2 - 1/2) / 200."""
    terms = terms_of(origin_px=torch.tensor([[[49.0, 25.0]]]))
    assert terms["planar"] == pytest.approx(1.5 / 200, rel=1e-4)
    assert terms["depth"] == pytest.approx(0.0, abs=1e-9)


def test_rotation_costs_its_angle_over_pi_and_its_columns() -> None:
    """A half turn about the allocentric y axis reverses x and z: each of their six numbers c errs by 2c."""
    half_turn = torch.from_numpy(Rotation.from_euler("y", 180, degrees=True).as_matrix()).float()
    truth = perfect(LABELS, 1)
    R_allo_k, R_ego_k = truth.R_allo_k @ half_turn, truth.R_ego_k @ half_turn
    terms = terms_of(R_allo_k=R_allo_k, R_ego_k=R_ego_k)
    assert terms["geodesic"] == pytest.approx(1.0, abs=1e-5)
    errors = 2 * truth.R_allo_k[0, 0, 0].numpy()[:, [0, 2]].ravel()
    by_hand = np.mean([d * d / 2 if abs(d) < 1 else abs(d) - 0.5 for d in errors])
    assert terms["rotation_6d"] == pytest.approx(by_hand, rel=1e-4)


def test_the_weights_are_the_papers() -> None:
    out = perfect(LABELS, 1)._replace(
        log_size=torch.log(LABELS.size_px * 1.3)[:, None],
        log_Z=torch.log(torch.tensor([[230.0]])),
        origin_px=torch.tensor([[[44.0, 20.0]]]),
        R_allo_k=perfect(LABELS, 1).R_allo_k.flip(-1),
        R_ego_k=perfect(LABELS, 1).R_ego_k.flip(-1),
    )
    logits = torch.randn(1, 8, 8, generator=torch.Generator().manual_seed(1))
    total, terms = joint_loss(logits, out, None, LABELS, PAPER)
    L_trans = 20 * terms["depth"] + 50 * terms["planar"]
    L_rot = terms["geodesic"] + 5 * terms["rotation_6d"]
    L_total = 50 * terms["heatmap"] + 4 * terms["size"] + 4 * L_trans + 25 * L_rot
    torch.testing.assert_close(total, L_total)
    torch.testing.assert_close(terms["heatmap"], heatmap_loss(logits, heatmap_target(LABELS, 8, 8)))
    assert all(terms[name] > 0 for name in ("size", "depth", "planar", "geodesic", "rotation_6d"))


def test_windows_without_a_target_count_in_the_heatmap_alone() -> None:
    empty = labels_at((40.0, 25.0), (30.0, 12.0), present=0.0)
    logits = torch.zeros(1, 8, 8)
    total, terms = joint_loss(logits, perfect(LABELS, 1), None, empty, PAPER)
    # 64 cells at probability 1/2, no positive: 64 * 0.5^2 * ln 2.
    assert terms["heatmap"].item() == pytest.approx(64 * 0.25 * math.log(2), rel=1e-5)
    assert total.item() == pytest.approx(50 * terms["heatmap"].item(), rel=1e-5)
    assert heatmap_target(empty, 8, 8).max() == 0


def test_sigma_is_a_laplace_scale() -> None:
    """Depth e^0.2 times too far: 0.2 / b + ln b, least where b = 0.2; the five other residuals are zero, ln 1."""
    weights = LossConfig(uncertainty=1.0)
    log_Z = torch.log(torch.tensor([[200.0]])) + 0.2

    def cost(scale: float) -> float:
        log_sigma = torch.zeros(1, 1, 6)
        log_sigma[..., 2] = math.log(scale)
        out = perfect(LABELS, 1)._replace(log_Z=log_Z, log_sigma=log_sigma)
        return pose_terms(out, LABELS, weights)["uncertainty"].item()

    for scale in (0.1, 0.2, 0.4):
        assert cost(scale) == pytest.approx(0.2 / scale + math.log(scale), abs=5e-3)
    assert cost(0.2) < min(cost(0.1), cost(0.4))


def test_what_is_corrected_is_no_error_of_sigma_s_law() -> None:
    """Depth e^0.2 times too far and corrected by it: (b = 0.1) 6 ln b alone; off by 0.1 either way 0.1 / b more."""
    log_Z = torch.log(torch.tensor([[200.0]])) + 0.2

    def cost(correction: float) -> float:
        out = perfect(LABELS, 1)._replace(
            log_Z=log_Z,
            correction=torch.tensor([[correction]]),
            log_sigma=torch.full((1, 1, 6), math.log(0.1)),
        )
        return pose_terms(out, LABELS, LossConfig(uncertainty=1.0))["uncertainty"].item()

    assert cost(-0.2) == pytest.approx(6 * math.log(0.1), abs=5e-3)
    for correction in (-0.1, -0.3):
        assert cost(correction) == pytest.approx(6 * math.log(0.1) + 1.0, abs=5e-3)


def test_the_batch_counts_targets_and_not_windows() -> None:
    """Of three windows two hold a target: the mean is over those."""
    three = type(LABELS)(*(torch.cat([a, a, a]) for a in LABELS))._replace(present=torch.tensor([1.0, 0.0, 1.0]))
    out = perfect(three, tiny.config().model.hypotheses)
    out = out._replace(log_Z=out.log_Z + torch.tensor([[0.2], [0.5], [0.4]]))
    _, terms = joint_loss(torch.zeros(3, 8, 8), out, None, three, PAPER)
    assert terms["depth"].item() == pytest.approx((0.02 + 0.08) / 2, rel=1e-4)
