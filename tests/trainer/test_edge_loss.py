"""The terms that the edge configuration adds to the paper's, worked by hand as those are."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from test_losses import labels_at, perfect

from trainer.config import LossConfig
from trainer.losses import Labels, dense_terms, hypothesis_share, joint_loss, pose_terms

# The longer side of the box is 30 px; (40, 25) is where the body's origin and the box's centre are projected.
LABELS = labels_at((40.0, 25.0), (30.0, 12.0))


def terms_of(hypotheses: int = 4, loss: LossConfig | None = None, **changed: torch.Tensor) -> dict[str, float]:
    out = perfect(LABELS, hypotheses)._replace(**changed)
    return {name: value.item() for name, value in pose_terms(out, LABELS, loss or LossConfig()).items()}


def test_the_centre_costs_in_cells_its_square_below_two_pixels() -> None:
    """1 px: 1^2 / 2 / 2 px; 4 px: 4 - 2 / 2 px; cells of 8 px."""
    terms = terms_of(center_px=torch.tensor([[[41.0, 21.0]]]))
    assert terms["center"] == pytest.approx((0.25 + 3.0) / 8, rel=1e-5)


def test_the_origin_costs_in_longer_sides_of_the_box() -> None:
    """3 px of 30 are 0.1, of which 0.02 / 2 is off; 0.3 px are 0.01: 0.01^2 / 2 / 0.02."""
    terms = terms_of(origin_px=torch.tensor([[[43.0, 24.7]]]))
    assert terms["origin"] == pytest.approx(0.09 + 0.0025, rel=1e-3)


@pytest.mark.parametrize(("beta", "cost"), [(1.0, 0.2**2 / 2), (0.1, 0.2 - 0.1 / 2)])
def test_depth_costs_its_square_below_beta_and_itself_above(beta: float, cost: float) -> None:
    log_Z = torch.log(torch.tensor([[200.0]])) + 0.2
    assert terms_of(loss=LossConfig(depth_beta=beta), log_Z=log_Z)["depth"] == pytest.approx(cost, rel=1e-4)


def test_hypotheses_cost_the_cross_entropy_of_their_shares() -> None:
    """Equal logits: ln 4, however the truth is shared; a wrong one, one right: 5 and ln(1 + 3 e^-5) less or more."""
    assert terms_of(hypothesis_logits=torch.zeros(1, 1, 4))["hypothesis"] == pytest.approx(math.log(4), rel=1e-5)
    truth = perfect(LABELS, 4)
    share = hypothesis_share(truth.R_allo_k[:, 0, 0], 4)[0]
    for k in range(4):
        logits = torch.zeros(1, 1, 4)
        logits[..., k] = 5.0
        by_hand = math.log(math.exp(5.0) + 3) - 5.0 * share[k].item()
        assert terms_of(hypothesis_logits=logits)["hypothesis"] == pytest.approx(by_hand, rel=1e-5)


def test_each_hypothesis_pays_for_its_rotation_by_its_share() -> None:
    """All turned alike cost what one alone does; one alone turned, its share of that."""
    turn = torch.from_numpy(Rotation.from_rotvec([0.5, 0.2, -0.4]).as_matrix()).float()
    one, truth = perfect(LABELS, 1), perfect(LABELS, 4)
    share = hypothesis_share(truth.R_allo_k[:, 0, 0], 4)[0]
    alone = terms_of(1, R_allo_k=one.R_allo_k @ turn, R_ego_k=one.R_ego_k @ turn)
    together = terms_of(R_allo_k=truth.R_allo_k @ turn, R_ego_k=truth.R_ego_k @ turn)
    best = int(share.argmax())
    R_allo_k, R_ego_k = truth.R_allo_k.clone(), truth.R_ego_k.clone()
    R_allo_k[..., best, :, :] @= turn
    R_ego_k[..., best, :, :] @= turn
    of_the_best = terms_of(R_allo_k=R_allo_k, R_ego_k=R_ego_k)
    for name in ("rotation_6d", "geodesic"):
        assert alone[name] > 0.02
        assert together[name] == pytest.approx(alone[name], rel=1e-3)
        assert of_the_best[name] == pytest.approx(share[best].item() * alone[name], rel=1e-3, abs=1e-5)


def test_without_the_ray_the_allocentric_rotation_is_the_one_in_the_camera() -> None:
    away = labels_at((400.0, 25.0), (30.0, 12.0))
    out = perfect(away, 1)
    assert pose_terms(out, away, LossConfig(), ray=False)["rotation_6d"].item() > 1e-3
    plain = out._replace(R_allo_k=out.R_ego_k)
    assert pose_terms(plain, away, LossConfig(), ray=False)["rotation_6d"].item() == pytest.approx(0.0, abs=1e-9)


def dense_labels() -> Labels:
    """Four cells that matter, the rest without target: seen, seen by a fifth, of another aircraft, unknown."""
    coverage, noc, others = torch.zeros(1, 4, 4), torch.full((1, 3, 4, 4), 0.2), torch.zeros(1, 4, 4, dtype=torch.bool)
    coverage[0, 0] = torch.tensor([0.9, 0.2, 0.8, torch.nan])
    others[0, 0, 2] = True
    return LABELS._replace(coverage=coverage, noc=noc, others=others)


def test_the_mask_costs_its_cross_entropy_where_it_is_known() -> None:
    """Logit 1.5 everywhere, p = 1 / (1 + e^-1.5); two of the sixteen cells are not judged and cost nothing."""
    p = 1 / (1 + math.exp(-1.5))
    by_hand = -sum(c * math.log(p) + (1 - c) * math.log(1 - p) for c in (0.9, 0.2, *[0.0] * 12)) / 16
    terms = dense_terms(torch.full((1, 4, 4, 4), 1.5), dense_labels())
    assert terms["mask"].item() == pytest.approx(by_hand, rel=1e-5)


def test_object_coordinates_cost_where_the_target_is_seen_and_they_are_known() -> None:
    """One cell is: errors 0.05 and 0.3, ten times over 0.5^2 / 2 and 3 - 1/2, third one right, so a third of it."""
    labels = dense_labels()
    dense = torch.full((1, 4, 4, 4), 7.0)
    dense[0, 1:, 0, 0] = torch.tensor([0.25, 0.5, 0.2])
    by_hand = (0.125 + 2.5) / 3
    assert dense_terms(dense, labels)["noc"].item() == pytest.approx(by_hand, rel=1e-5)
    labels.coverage[0, 1, 1] = 0.9
    labels.noc[0, 1, 1, 1] = torch.nan  # one coordinate unknown
    assert dense_terms(dense, labels)["noc"].item() == pytest.approx(by_hand, rel=1e-5)
    labels.coverage[0, 2, 2] = 0.4
    dense[0, 1:, 2, 2] = 0.2
    assert dense_terms(dense, labels)["noc"].item() == pytest.approx(by_hand / 2, rel=1e-5)


def test_a_window_without_a_target_has_labels_of_zeros_and_trains_heatmap_and_mask_alone() -> None:
    """As the sampler gives them: their logarithms and quotients must not reach the batch as NaN."""
    seen = LABELS._replace(coverage=torch.ones(1, 16, 16))
    empty = Labels(*(torch.zeros_like(value) for value in seen))._replace(K=seen.K, R_cam_target=torch.eye(3)[None])
    labels = Labels(*(torch.cat([one, other, one]) for one, other in zip(seen, empty, strict=True)))
    out = perfect(LABELS, 4)
    off = out._replace(center_px=out.center_px + 3.0, origin_px=out.origin_px + 3.0, log_Z=out.log_Z + 0.1)
    three = type(out)(*(torch.cat([value] * 3).requires_grad_() for value in off))
    heat, dense = torch.zeros(3, 8, 8), torch.full((3, 4, 16, 16), 0.3)
    weights = LossConfig(hypothesis=1.0, center=1.0, origin=1.0, mask=2.0, noc=1.0, uncertainty=1.0)
    _, alone = joint_loss(heat[:1], off, dense[:1], seen, weights)
    total, terms = joint_loss(heat, three, dense, labels, weights)
    assert alone["noc"] > 0.1
    for name in terms.keys() - {"heatmap", "mask"}:
        torch.testing.assert_close(terms[name], alone[name], msg=name)
    p = 1 / (1 + math.exp(-0.3))
    assert terms["mask"].item() == pytest.approx(-(2 * math.log(p) + math.log(1 - p)) / 3, rel=1e-5)
    total.backward()
    for name, value in three._asdict().items():
        if value.grad is not None:
            assert value.grad[1].abs().sum() == 0, name


def test_each_added_term_counts_by_its_weight() -> None:
    out = perfect(LABELS, 4)
    off = out._replace(center_px=out.center_px + 3.0, origin_px=out.origin_px + 3.0)
    heat, dense = torch.zeros(1, 8, 8), torch.full((1, 4, 16, 16), 0.3)
    labels = LABELS._replace(coverage=torch.ones(1, 16, 16))
    plain, _ = joint_loss(heat, off, dense, labels, LossConfig())
    for name in ("hypothesis", "center", "origin", "mask", "noc"):
        weighed, terms = joint_loss(heat, off, dense, labels, LossConfig(**{name: 3.0}))
        assert terms[name].item() > 0.01, name
        assert (weighed - plain).item() == pytest.approx(3.0 * terms[name].item(), rel=1e-3), name
