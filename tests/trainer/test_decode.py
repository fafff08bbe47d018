"""From features to a pose: where DTS looks, what APDD makes of a focal length, how the ray turns a rotation."""

from __future__ import annotations

import numpy as np
import pytest
import tiny
import torch
from scipy.spatial.transform import Rotation

from trainer import equations as eq
from trainer.model import DynamicTopologicalSampling, Perception, PoseNet

# The paper's Delta P, as it is printed: edge midpoints, then corners, of a box w x h.
PRINTED = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]]) / 2


def ramp(rows: int, columns: int) -> torch.Tensor:
    """Features [1, 2, rows, columns] that say where in the picture their cell's centre lies, pixels."""
    x, y = (eq.STRIDE * (torch.arange(n) + 0.5) - 0.5 for n in (columns, rows))
    return torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)])[None]


def test_dts_samples_the_eight_points_of_the_box_where_they_lie() -> None:
    dts = DynamicTopologicalSampling(2, 8)
    center, size = torch.tensor([[[61.3, 50.2], [70.0, 40.0]]]), torch.tensor([[[44.0, 18.5], [30.0, 60.0]]])
    f_oct, f_reg, grid = dts(ramp(12, 16), center, size, torch.tensor([128.0, 96.0]))
    for k in range(2):
        expected = center[0, k].numpy() + PRINTED * size[0, k].numpy()
        np.testing.assert_allclose(f_oct[k].detach().reshape(8, 2), expected, atol=1e-3)
    assert f_reg.shape == (2, 8)
    corner = center[0, 0].numpy() - size[0, 0].numpy() / 2
    np.testing.assert_allclose(grid[0, :, 0, 0].detach(), corner, atol=1e-3)


def test_features_off_the_picture_are_zero() -> None:
    f_oct, *_ = DynamicTopologicalSampling(2, 8)(
        ramp(8, 8), torch.tensor([[[32.0, 32.0]]]), torch.full((1, 1, 2), 200.0), torch.tensor([64.0, 64.0])
    )
    assert f_oct.abs().max() == 0


def decoded(K: torch.Tensor, **changes: object) -> tuple:
    torch.manual_seed(2)
    network = PoseNet(tiny.config().model.model_copy(update=changes)).eval()
    with torch.no_grad():
        for parameter in network.parameters():  # priors alone would hardly differ from peak to peak
            parameter.add_(0.05 * torch.randn(parameter.shape))
        F_global = torch.randn(1, 16, 8, 8)
        seen = Perception(F_global, torch.randn(1, 8, 8))
        return network.decode(seen, K, torch.tensor([[[2.0, 3.0], [6.0, 5.0]]]))


@pytest.mark.parametrize(
    "changes", [{}, {"center": "regressed", "hypotheses": 1, "depth": "direct", "uncertainty": False}]
)
def test_every_peak_of_every_image_is_decoded_as_if_it_were_alone(changes: dict) -> None:
    torch.manual_seed(4)
    network = PoseNet(tiny.config().model.model_copy(update=changes)).eval()
    F_global, heat_logits = torch.randn(2, 16, 8, 8), torch.randn(2, 8, 8)
    K = torch.cat([intrinsics(900.0), intrinsics(1300.0, 20.0, 44.0)])
    K[1, 0, 0] = 1100.0
    peaks_xy = torch.tensor([[[2.0, 3.0], [6.0, 5.0], [1.0, 1.0]], [[4.0, 4.0], [0.0, 7.0], [5.0, 2.0]]])
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
        together = network.decode(Perception(F_global, heat_logits), K, peaks_xy)
        for n in range(2):
            for m in range(3):
                own = slice(n, n + 1)
                seen = Perception(F_global[own], heat_logits[own])
                alone = network.decode(seen, K[own], peaks_xy[own, m : m + 1])
                for name, one, all_of_them in zip(alone._fields, alone, together, strict=True):
                    torch.testing.assert_close(one[0, 0], all_of_them[n, m], rtol=1e-4, atol=1e-4, msg=name)


def intrinsics(f: float, cx: float = 31.5, cy: float = 31.5) -> torch.Tensor:
    return torch.tensor([[[f, 0, cx], [0, f, cy], [0, 0, 1]]])


@pytest.mark.parametrize("depth", ["plain", "rotation_aware"])
def test_apdd_takes_twice_the_focal_length_for_twice_the_depth(depth: str) -> None:
    near, far = (decoded(intrinsics(f), depth=depth, ray=False) for f in (1000.0, 2000.0))
    torch.testing.assert_close(far.log_Z - near.log_Z, torch.full((1, 2), np.log(2.0)), check_dtype=False)
    torch.testing.assert_close(far.log_size, near.log_size)
    torch.testing.assert_close(far.R_ego, near.R_ego)


def test_a_depth_told_directly_ignores_the_focal_length() -> None:
    near, far = (decoded(intrinsics(f), depth="direct", ray=False) for f in (1000.0, 2000.0))
    torch.testing.assert_close(far.log_Z, near.log_Z)


def test_the_ray_of_the_refined_origin_turns_the_allocentric_rotation() -> None:
    """By scipy: the shortest turn from the optical axis to the ray, applied from the left."""
    K = intrinsics(150.0, 10.0, 80.0)  # a window far off the axis
    out = decoded(K)
    for k in range(2):
        ray = np.linalg.solve(K[0].numpy(), [*out.origin_px[0, k].numpy(), 1.0])
        ray /= np.linalg.norm(ray)
        axis = np.cross([0, 0, 1], ray)
        R_ray = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(ray[2])).as_matrix()
        for j in range(out.R_allo_k.shape[2]):
            np.testing.assert_allclose(out.R_ego_k[0, k, j], R_ray @ out.R_allo_k[0, k, j].numpy(), atol=1e-5)
        best = int(out.hypothesis_logits[0, k].argmax())
        np.testing.assert_allclose(out.R_ego[0, k], out.R_ego_k[0, k, best], atol=1e-6)


def test_the_origin_lies_within_its_range_of_the_centre() -> None:
    out = decoded(intrinsics(900.0))
    limit = tiny.config().model.origin_range * torch.exp(out.log_size)
    assert ((out.origin_px - out.center_px).abs() <= limit).all()


def test_the_graph_tells_the_point_that_its_own_origin_and_depth_make() -> None:
    network = tiny.network().eval()
    image, labels = tiny.batch()
    with torch.no_grad():
        _, _, _, origin_px, t, R, sigma = network(image, labels.K)
    for n in range(len(image)):
        for m in range(origin_px.shape[1]):
            ray = np.linalg.solve(labels.K[n].double().numpy(), [*origin_px[n, m].numpy(), 1.0])
            np.testing.assert_allclose(t[n, m], ray * t[n, m, 2].item(), rtol=1e-3, atol=1e-2)
    assert t[..., 2].min() >= 50
    assert t[..., 2].max() <= 600
    assert sigma.min() > 0
    np.testing.assert_allclose(torch.linalg.det(R), np.ones(R.shape[:2]), atol=1e-4)


def test_the_correction_is_a_factor_of_depth_and_leaves_the_rest() -> None:
    network = tiny.network().eval()
    image, labels = tiny.batch()
    with torch.no_grad():
        *before, t, _, sigma = network(image, labels.K)
        assert network.head_refine is not None
        network.head_refine.range.bias.fill_(0.1)
        *after, moved_t, _, moved_sigma = network(image, labels.K)
    for one, other in zip([*before, sigma], [*after, moved_sigma], strict=True):
        torch.testing.assert_close(one, other)
    inside = (t[..., 2] > 51) & (moved_t[..., 2] < 599)
    assert inside.any()
    farther = np.exp(0.1) * t[inside]
    torch.testing.assert_close(moved_t[inside], farther)


def test_what_is_read_of_a_picture_like_none_before_cannot_throw_the_range() -> None:
    network = tiny.network().eval()
    image, labels = tiny.batch()
    with torch.no_grad():
        assert network.head_refine is not None
        network.head_refine.range.bias.fill_(40.0)
        seen = network.perceive(image)
        correction = network.decode(seen, labels.K, torch.ones(len(image), 1, 2)).correction
    assert correction.tolist() == [[pytest.approx(0.7)]] * len(image)
