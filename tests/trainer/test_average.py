"""The mean of runs: every weight halfway, ready to be used like a run, and only of networks that are alike."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny
import torch

from trainer.average import average
from trainer.checkpoint import deployed_weights, load_file, load_model, save_weights, write_atomic
from trainer.cli import main
from trainer.config import ConfigError, parse_config
from trainer.model import PoseNet


def write_run(folder: Path, seed: int, config: str = tiny.TOML, *, began_as: int = 0) -> Path:
    """A run on the windows of `seed` that began with the random weights of seed `began_as`, and has come half as far
    from them as they are long."""
    config = config.replace("\nseed = 3\n", f"\nseed = {10 + seed}\n")
    torch.manual_seed(began_as)
    network = PoseNet(parse_config(config, "tiny.toml").model)
    torch.manual_seed(seed)
    with torch.no_grad():
        for weight in network.parameters():
            step = torch.randn_like(weight)
            weight += 0.5 * step * weight.norm() / step.norm()
    save_weights(folder / "weights.pt", network, config, {"samples": seed})
    return folder


def test_weights_are_halfway_and_the_origin_is_told(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, seed) for seed, name in enumerate("ab", start=1)]
    assert main(["average", *map(str, runs), "--out", str(tmp_path / "mean")]) == 0
    one, other, mean = (load_file(folder)["weights"] for folder in (*runs, tmp_path / "mean"))
    kernel = next(name for name, value in one.items() if value.ndim == 4)
    assert torch.allclose(mean[kernel].float(), (one[kernel].float() + other[kernel].float()) / 2, atol=1e-3)
    assert not torch.equal(one[kernel], other[kernel])
    _, _, training, _ = load_model(tmp_path / "mean")
    assert training["samples"] == 2
    assert training["mean_of"] == ", ".join(load_model(run)[3][:16] for run in runs)


def test_training_only_heads_that_one_run_lacks_are_the_other_s(tmp_path: Path) -> None:
    one, other = (write_run(tmp_path / name, seed) for seed, name in enumerate("ab", start=1))
    content = load_file(one)
    write_atomic(one / "weights.pt", content | {"weights": deployed_weights(content["weights"])})
    average([one, other], tmp_path / "mean")
    mean, kept = (load_file(folder)["weights"] for folder in (tmp_path / "mean", other))
    only_training = [name for name in kept if name.startswith("head_dense.")]
    assert len(only_training) > 2
    assert all(torch.equal(mean[name], kept[name]) for name in only_training)


def test_images_that_only_an_earlier_run_was_trained_on_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The mean's file would not tell of them, and `refine` would take windows from them."""
    own = tiny.TOML.replace("[schedule]", '[[data.datasets]]\npath = "/data/hawks"\nshare = 0.5\n[schedule]')
    rendered, hawks = write_run(tmp_path / "a", 1), write_run(tmp_path / "b", 2, own)
    average([rendered, hawks], tmp_path / "mean")
    assert caplog.text == ""
    average([hawks, rendered], tmp_path / "other")
    assert f"{hawks}: was trained on /data/hawks (train), of which the mean, with the last run's" in caplog.text


def test_runs_on_the_same_windows_are_told_to_gain_little(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Such as a run and its continuation with the same configuration file."""
    first, again, other = (write_run(tmp_path / name, seed) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    average([first, other], tmp_path / "mean")
    assert caplog.text == ""
    average([first, other, again], tmp_path / "mean")
    assert f"{first} and {again} were trained with the same [data] seed, 11, so on much the same" in caplog.text
    assert str(other) not in caplog.text


def test_a_run_that_may_go_on_keeps_its_own_weights(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, seed) for seed, name in enumerate("ab", start=1)]
    write_atomic(runs[1] / "resume.pt", {})
    before = (runs[1] / "weights.pt").read_bytes()
    with pytest.raises(ConfigError, match="a run that can be resumed"):
        average(runs, runs[1])
    assert (runs[1] / "weights.pt").read_bytes() == before


def test_other_networks_and_single_runs_are_refused(tmp_path: Path) -> None:
    one = write_run(tmp_path / "a", 1)
    other = write_run(tmp_path / "b", 2, tiny.TOML.replace("origin_range = 0.5", "origin_range = 0.7"))
    with pytest.raises(ConfigError, match=r"a: its \[model\] differs from that of"):
        average([one, other], tmp_path / "mean")
    with pytest.raises(ConfigError, match="at least two runs"):
        average([one], tmp_path / "mean")
    assert not (tmp_path / "mean").exists()


def test_runs_that_began_with_other_weights_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [write_run(tmp_path / "a", 1), write_run(tmp_path / "b", 2, began_as=5)]
    assert main(["average", *map(str, runs), "--out", str(tmp_path / "mean")]) == 2
    told = capsys.readouterr().err
    assert f"{runs[0]}: has nothing in common with {runs[1]} in backbone, " in told
    assert not (tmp_path / "mean").exists()


def test_heads_that_each_run_was_refined_with_are_refused_and_training_only_ones_are_not(tmp_path: Path) -> None:
    """`refine` begins with random heads, so two refined runs have unrelated ones on top of related networks."""
    runs = [write_run(tmp_path / name, seed) for seed, name in enumerate("ab", start=1)]
    other = load_file(write_run(tmp_path / "c", 3, began_as=5))["weights"]

    def with_parts_of_another(part: str) -> None:
        content = load_file(runs[0])
        theirs = {name: value for name, value in other.items() if name.startswith(f"{part}.")}
        write_atomic(runs[0] / "weights.pt", content | {"weights": content["weights"] | theirs})

    with_parts_of_another("head_dense")
    average(runs, tmp_path / "mean")
    with_parts_of_another("head_refine")
    with pytest.raises(
        ConfigError, match=r"a: has nothing in common with \S+b in head_refine: .* refine only their mean"
    ):
        average(runs, tmp_path / "other")
