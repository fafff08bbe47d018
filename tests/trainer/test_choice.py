"""The choice head: among hypotheses it hears the network's own probabilities and what shows in the features."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
import torch
from torch.nn import functional as F

from trainer import equations as eq
from trainer.choice import SPREAD_RAD, ChoiceHead, choice_nll, option_count, options_of
from trainer.config import load_config
from trainer.graph import write_graph
from trainer.model import PoseNet
from trainer.refine import Heads, Kept, chosen_by, fit
from trainer.refinement import Evidence, answer_count

K = 4
EDGE = Path(__file__).parents[2] / "trainer" / "configs" / "edge.toml"


def test_the_loss_is_the_mixture_s_likelihood_worked_out_by_hand() -> None:
    logits = torch.log(torch.tensor([[0.5, 0.25, 0.125, 0.125]])) + 3.0
    angle_rad = torch.tensor([[0.0, 0.2, 3.0, 3.0]])
    expected = -math.log(0.5 + 0.25 * math.exp(-0.2 / SPREAD_RAD) + 0.25 * math.exp(-3.0 / SPREAD_RAD))
    assert choice_nll(logits, angle_rad).item() == pytest.approx(expected, abs=1e-6)


def test_untrained_it_chooses_as_the_network_does() -> None:
    network = tiny.network(3).eval()
    chosen = PoseNet(network.config, ("head_choice",)).eval()
    assert chosen.load_state_dict(network.state_dict(), strict=False).unexpected_keys == []
    image, labels = tiny.batch(8)
    with torch.no_grad():
        for own, other in zip(network(image, labels.K), chosen(image, labels.K), strict=True):
            torch.testing.assert_close(own, other)


def test_half_the_way_is_the_geometric_mean_of_both_probabilities() -> None:
    torch.manual_seed(0)
    head = ChoiceHead(16, 32, K).eval()
    torch.nn.init.normal_(head.choose.weight)
    torch.nn.init.normal_(head.choose.bias)
    own = torch.randn(5, K)
    options = options_of(torch.zeros(5, 2), torch.zeros(5), torch.zeros(5, 2), torch.randn(5, 6 * K), own)
    seen = torch.randn(5, 16, 7, 7), torch.randn(5, 32), torch.randn(5, 32), options
    with torch.no_grad():
        learnt = F.softmax(head(*seen), dim=-1)
        head.lean(0.5)
        geometric = torch.sqrt(learnt * F.softmax(own, dim=-1))
        torch.testing.assert_close(F.softmax(head(*seen), dim=-1), geometric / geometric.sum(-1, keepdim=True))


def test_what_it_prefers_is_the_rotation_that_is_told_and_the_scale_that_the_depth_follows_from() -> None:
    """Asked for the hypothesis that is least likely by the network's own logits, everything told is of that one; the
    other heads hear the network's own probabilities."""
    network = PoseNet(tiny.network(3).config, ("head_choice",)).eval()
    image, labels = tiny.batch(8)
    assert network.head_choice is not None
    with torch.no_grad():
        network.head_choice.choose.weight.neg_()
        seen = network.perceive(image)
        peaks = eq.heatmap_peaks(torch.sigmoid(seen.heat_logits), 1)[1]
        told, evidence = network.decode_with_evidence(seen, labels.K, peaks)
        own = PoseNet(network.config).eval()
        own.load_state_dict(network.state_dict(), strict=False)
        before = own.decode(seen, labels.K, peaks)
        least = before.hypothesis_logits[:, 0].argmin(-1)
        rows = torch.arange(8)
        torch.testing.assert_close(told.R_ego[:, 0], before.R_ego_k[rows, 0, least])
        angle = eq.rotation_angle(told.R_ego[:, 0], before.R_ego[:, 0])
        assert (angle > 0.1).all()
        assert not torch.allclose(told.log_Z, before.log_Z, atol=1e-5)
        torch.testing.assert_close(told.center_px, before.center_px)
        own_probabilities = F.softmax(before.hypothesis_logits[:, 0], dim=-1)
        torch.testing.assert_close(evidence.answers[:, 7 : 7 + own_probabilities.shape[1]], own_probabilities)


IN_OPENVINO = """
import sys, numpy as np, openvino
given = {"image": np.zeros((1, 64, 64, 3), np.uint8), "K": np.diag([900.0, 900.0, 1.0]).astype(np.float32)[None]}
network = openvino.Core().read_model(sys.argv[1])
network.reshape({name: list(value.shape) for name, value in given.items()})
run = openvino.Core().compile_model(network, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
assert all(np.isfinite(told).all() for told in run(given).values())
"""


def test_its_graph_runs_in_openvino_too(tmp_path: Path) -> None:
    """In a process of its own: OpenVINO does not raise, it crashes, and only on a network of full size."""
    torch.manual_seed(0)
    network = PoseNet(load_config(EDGE).model.deployed(), ("head_choice",)).eval()
    assert network.head_choice is not None
    with torch.no_grad():
        for parameter in network.head_choice.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    write_graph(network, tmp_path / "chosen.onnx")
    asked = [sys.executable, "-c", IN_OPENVINO, tmp_path / "chosen.onnx"]
    told = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr


def test_a_hint_in_the_features_is_learnt_and_the_network_s_own_choice_is_heard_where_there_is_none() -> None:
    """Made up: the network wavers between two headings, one of them likelier; in half of the windows a bright channel
    tells which of the two is right, in the others the likelier one is in three of four."""
    generator = torch.Generator().manual_seed(3)
    count = 6000
    draw = torch.rand(3, count, generator=generator)
    likelier, hinted = (draw[0] < 0.5).long(), draw[1] < 0.5
    right = torch.where(draw[2] < 0.75, likelier, 1 - likelier)
    grid = torch.randn(count, 16, 7, 7, generator=generator)
    grid[:, 5] += 2.0 * (hinted * (2 * right - 1))[:, None, None]
    logits = torch.full((count, K), -6.0)
    logits[:, :2] = 0.0
    logits[torch.arange(count), likelier] = math.log(3.0)
    angle_rad = torch.full((count, K), 2.0)
    angle_rad[torch.arange(count), right] = 0.02
    noise = [torch.randn(count, width, generator=generator) for width in (32, 32, answer_count(K))]
    r_6d = eq.heading_anchors(K).flatten().expand(count, -1)
    options = options_of(torch.full((count, 2), 3.5), torch.full((count,), 7.0), torch.zeros(count, 2), r_6d, logits)
    assert options.shape == (count, option_count(K))
    evidence = Evidence(*(part.half() for part in (grid, *noise, options)))
    target = torch.ones(count, dtype=torch.bool)
    kept = Kept(evidence, torch.zeros(count, 6), target, torch.ones(count), target, angle_rad)
    torch.manual_seed(0)
    head, said = ChoiceHead(16, 32, K), list[str]()
    fit(Heads(None, None, head), kept, 5000, 6, said.append)
    held_out = slice(5000, None)
    with torch.no_grad():
        chosen = F.softmax(chosen_by(head, kept.rows(held_out).evidence), dim=-1)
    correct = chosen.argmax(-1) == right[held_out]
    assert correct[hinted[held_out]].float().mean() > 0.85
    assert (chosen.argmax(-1) == likelier[held_out])[~hinted[held_out]].float().mean() > 0.95
    before, after = (of.float().mean().item() for of in (likelier[held_out] == right[held_out], correct))
    assert said[-1].endswith(f"rotations within 10 degrees: {before:.1%} before, {after:.1%} after")
    assert before < 0.8 < after
