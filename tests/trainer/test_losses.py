"""Loss terms against hand-worked numbers, and what each of them trains."""

from __future__ import annotations

import math

import numpy as np
import pytest
import tiny
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from trainer import equations as eq
from trainer.evaluate import box_iou
from trainer.guidance import drawn_guide, guided_peaks
from trainer.losses import (
    Labels,
    gaussian_radius,
    heatmap_loss,
    heatmap_target,
    hypothesis_share,
    joint_loss,
    pose_terms,
    rotation_residual,
)
from trainer.model import Decoded


def labels_at(
    center_px: tuple[float, float],
    size_px: tuple[float, float],
    present: float = 1.0,
    cells: tuple[int, int] = (8, 8),
) -> Labels:
    """Of one window with a map of so many rows and columns of stride-8 cells."""
    K = torch.tensor([[[900.0, 0, 32], [0, 900, 32], [0, 0, 1]]])
    t = torch.tensor([[(center_px[0] - 32) / 900 * 200, (center_px[1] - 32) / 900 * 200, 200.0]])
    R = torch.from_numpy(Rotation.from_euler("xyz", [90, 20, 40], degrees=True).as_matrix()).float()[None]
    empty = torch.zeros(1, 2 * cells[0], 2 * cells[1])
    sizes = torch.tensor([center_px]), torch.tensor([size_px])
    dense = empty, empty[:, None].repeat(1, 3, 1, 1), empty > 0
    return Labels(K, torch.tensor([present]), R, t, *sizes, *dense, torch.tensor([2]))


def test_focal_loss_by_hand() -> None:
    logits = torch.logit(torch.tensor([[[0.8, 0.3], [0.1, 0.1]]]))
    target = torch.tensor([[[1.0, 0.5], [0.0, 0.0]]])
    by_hand = -((0.2**2) * math.log(0.8) + 0.5**4 * 0.3**2 * math.log(0.7) + 2 * 0.1**2 * math.log(0.9))
    assert heatmap_loss(logits, target).item() == pytest.approx(by_hand, rel=1e-5)


def test_heatmap_target_peaks_at_the_centres_cell_and_is_empty_without_a_target() -> None:
    target = heatmap_target(labels_at((43.4, 20.0), (40.0, 20.0)), 8, 8)
    assert target[0, 2, 5].item() == 1.0
    assert (target == 1.0).sum() == 1
    assert heatmap_target(labels_at((43.4, 20.0), (40.0, 20.0), present=0.0), 8, 8).abs().sum() == 0


def test_the_peak_falls_off_as_the_box_is_large() -> None:
    """A box of 30 x 20 cells keeps 0.7 of itself if (30 - 2r)(20 - 2r) = 420; sigma is a sixth of 2r + 1 cells."""
    r = (50 - math.sqrt(50**2 - 4 * 180)) / 4
    target = heatmap_target(labels_at((100.0, 60.0), (240.0, 160.0), cells=(16, 32)), 16, 32)
    for dx, dy in ((0, 0), (1, 0), (0, -1), (-2, 1)):
        expected = math.exp(-(dx**2 + dy**2) / 2 / ((2 * r + 1) / 6) ** 2)
        assert target[0, 7 + dy, 12 + dx].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("center_px", "cell_xy"),
    [((39.4, 23.6), (4, 3)), ((39.6, 23.4), (5, 2)), ((-9.0, 300.0), (0, 5)), ((300.0, -9.0), (8, 0))],
)
def test_a_centre_belongs_to_the_cell_whose_pixels_it_lies_on_or_to_the_nearest(
    center_px: tuple[float, float], cell_xy: tuple[int, int]
) -> None:
    """Cell 5 is pixels 40 to 47, from the edge at 39.5 on; the map has 9 x 6 cells."""
    target = heatmap_target(labels_at(center_px, (20.0, 20.0), cells=(6, 9)), 6, 9)
    assert (target[0] == 1.0).nonzero().tolist() == [list(cell_xy[::-1])]


def test_the_focal_loss_is_a_mean_over_targets() -> None:
    logits = torch.randn(1, 8, 8, generator=torch.Generator().manual_seed(1))
    target = heatmap_target(labels_at((43.4, 20.0), (40.0, 20.0)), 8, 8)
    twice = heatmap_loss(torch.cat([logits, logits]), torch.cat([target, target]))
    torch.testing.assert_close(twice, heatmap_loss(logits, target))


def test_empty_windows_train_the_heatmap() -> None:
    logits = torch.zeros(1, 8, 8, requires_grad=True)
    heatmap_loss(logits, torch.zeros(1, 8, 8)).backward()
    assert logits.grad is not None
    assert (logits.grad > 0).all()


@given(st.floats(4, 60), st.floats(4, 60))
def test_corners_moved_by_the_radius_keep_the_overlap_and_no_larger_one_does(w: float, h: float) -> None:
    radius = gaussian_radius(torch.tensor([w, h], dtype=torch.double)).item()
    box = np.array([[w, h]])
    center = np.zeros((1, 2))
    moves = (([radius, radius], 0.0), ([0, 0], 2 * radius), ([0, 0], -2 * radius))
    least = min(box_iou(center + shift, np.maximum(box + grow, 0), center, box)[0] for shift, grow in moves)
    if radius > 1.0:
        assert least == pytest.approx(0.7, abs=1e-6)
    else:
        assert radius == 1.0
        assert least <= 0.7 + 1e-6


@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_rotation_residual_is_scipys_rotation_vector(w: list[float]) -> None:
    est, truth = Rotation.from_rotvec(w[:3]), Rotation.from_rotvec(w[3:])
    expected = (truth * est.inv()).as_rotvec()
    if np.linalg.norm(expected) > 3.0:
        return
    got = rotation_residual(torch.from_numpy(est.as_matrix()), torch.from_numpy(truth.as_matrix()))
    np.testing.assert_allclose(got.numpy(), expected, atol=2e-5)


def perfect(labels: Labels, hypotheses: int = 4) -> Decoded:
    """The decoded truth, in the first hypothesis and in all of them."""
    t = labels.t_cam_target_m
    plane = t[:, :2] / t[:, 2:]
    origin = plane * labels.K[:, 0, 0, None] + labels.K[:, :2, 2]
    R_allo = eq.ray_rotation(eq.unit_ray(plane)).transpose(-1, -2) @ labels.R_cam_target
    every = (len(t), 1, hypotheses, 3, 3)
    return Decoded(
        labels.center_px[:, None],
        torch.log(labels.size_px)[:, None],
        origin[:, None],
        torch.log(t[:, 2])[:, None],
        20.0 * hypothesis_share(R_allo, hypotheses)[:, None],
        R_allo[:, None, None].expand(every),
        labels.R_cam_target[:, None, None].expand(every),
        labels.R_cam_target[:, None],
        torch.zeros(len(t), 1),
        torch.zeros(len(t), 1, 6),
    )


def test_the_truth_costs_nothing() -> None:
    labels = labels_at((40.0, 25.0), (30.0, 12.0))
    terms = pose_terms(perfect(labels), labels, tiny.config().loss)
    for name in ("size", "depth", "planar", "geodesic", "rotation_6d", "center", "origin", "uncertainty"):
        assert terms[name].item() == pytest.approx(0.0, abs=2e-3), name


def test_geodesic_term_is_the_angle_over_pi() -> None:
    labels = labels_at((40.0, 25.0), (30.0, 12.0))
    out = perfect(labels)
    turn = torch.from_numpy(Rotation.from_rotvec([0, 0, 0.6]).as_matrix()).float()
    terms = pose_terms(out._replace(R_ego_k=turn @ out.R_ego_k), labels, tiny.config().loss)
    assert terms["geodesic"].item() == pytest.approx(0.6 / math.pi, rel=1e-4)


@pytest.mark.parametrize(("beta", "cost"), [(0.1, 2 * 0.5 * 0.04**2 / 0.1), (0.02, 2 * (0.04 - 0.01))])
def test_size_costs_its_square_below_beta_and_itself_above(beta: float, cost: float) -> None:
    labels = labels_at((40.0, 25.0), (30.0, 12.0))
    out = perfect(labels)
    loss = tiny.config().loss.model_copy(update={"size_beta": beta})
    terms = pose_terms(out._replace(log_size=out.log_size + 0.04), labels, loss)
    assert terms["size"].item() == pytest.approx(cost, rel=1e-4)


def test_each_hypothesis_answers_for_its_own_heading() -> None:
    anchors = eq.gram_schmidt(eq.heading_anchors(8))
    share = hypothesis_share(anchors, 8)
    assert share.argmax(-1).tolist() == list(range(8))
    torch.testing.assert_close(share.sum(-1), torch.ones(8))


def test_a_heading_between_two_hypotheses_is_shared_by_its_angles_to_them() -> None:
    """Of four headings 90 degrees apart, 40 and 50 degrees off the nearest two; Gaussian weights of sigma 0.35 rad."""
    level = eq.gram_schmidt(eq.heading_anchors(4))
    between = level[:1] @ torch.from_numpy(Rotation.from_euler("z", 40, degrees=True).as_matrix()).float()
    angles = [math.radians(degrees) for degrees in (40, 50, 140, 130)]
    weights = sorted((math.exp(-0.5 * (angle / 0.35) ** 2) for angle in angles), reverse=True)
    share = hypothesis_share(between, 4)[0].sort(descending=True).values
    np.testing.assert_allclose(share.numpy(), np.array(weights) / sum(weights), rtol=1e-3, atol=1e-6)


def run_once(**replaced: float) -> tuple[torch.nn.Module, torch.Tensor, dict[str, torch.Tensor]]:
    model = tiny.network().train()
    image, labels = tiny.batch()
    seen = model.perceive(image)
    guide = drawn_guide(len(labels.present), 1.0, torch.Generator().manual_seed(0))
    peaks, size = guided_peaks(seen.heat_logits, labels, guide)
    out = model.decode(seen, labels.K, peaks, size)
    weights = tiny.config().loss.model_copy(update=replaced)
    total, terms = joint_loss(seen.heat_logits, out, model.dense(seen.F_global), labels, weights)
    return model, total, terms


def test_the_joint_loss_reaches_every_parameter() -> None:
    model, total, _ = run_once()
    total.backward()
    # RepViT's residual branches start at zero, so what feeds them learns from the second step on.
    waiting = {f"{name}.bn.weight" for name, module in model.named_modules() if name.endswith("channel_mixer.conv2")}
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        if not name.startswith("backbone.") or name in waiting:
            assert parameter.grad.abs().sum() > 0, name


def test_what_is_told_beside_the_pose_teaches_its_own_head_and_nothing_else() -> None:
    model, _, terms = run_once()
    terms["uncertainty"].backward()
    moved = {
        name.split(".")[0] for name, p in model.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0
    }
    assert moved == {"head_refine"}
