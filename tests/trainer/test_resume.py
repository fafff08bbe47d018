"""A stopped and resumed run is the unbroken run, bit for bit; other ways to begin are refused or recorded."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path

import pytest
import synthetic_sampler
import tiny
import torch

from trainer.checkpoint import load_model
from trainer.config import ConfigError, parse_config
from trainer.train import run_training
from trainer.trainer import Trainer


def train(out: Path, steps: int | None, text: str = tiny.TOML, **options: object) -> Trainer:
    config = parse_config(text, "tiny.toml")
    return run_training(config, text, out, max_steps=steps, open_sampler=synthetic_sampler.opener, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trainer]:
    out = tmp_path_factory.mktemp("whole")
    return out, train(out, None)


def test_two_and_two_steps_equal_four(whole: tuple[Path, Trainer], tmp_path: Path) -> None:
    _, unbroken = whole
    train(tmp_path, 2)
    parts = train(tmp_path, None, resume=True)
    assert unbroken.steps == parts.steps == 4
    assert unbroken.samples == parts.samples == 16
    for ours, theirs in ((unbroken.model, parts.model), (unbroken.average, parts.average)):
        for (name, a), b in zip(ours.state_dict().items(), theirs.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records if record["kind"] == "train"] == [1, 2, 3, 4]
    assert [record["size_px"] for record in records if record["kind"] == "validation"] == [64, 96]


def test_a_run_is_neither_overwritten_nor_resumed_with_other_losses(whole: tuple[Path, Trainer]) -> None:
    out, _ = whole
    with pytest.raises(ConfigError, match="--resume"):
        train(out, 1)
    with pytest.raises(ConfigError, match=r"resume\.pt: \[loss\] differs"):
        train(out, 1, tiny.TOML.replace("mask = 1.0", "mask = 2.0"), resume=True)
    with pytest.raises(ConfigError, match=r"resume\.pt: \[run\] bf16 differs"):
        train(out, 1, tiny.TOML.replace("[run]", "[run]\nbf16 = false"), resume=True)


@pytest.mark.parametrize("content", [[1], {"config": tiny.TOML}])
def test_a_file_that_is_no_run_is_not_gone_on_with(tmp_path: Path, content: object) -> None:
    torch.save(content, tmp_path / "resume.pt")
    with pytest.raises(ConfigError, match=r"resume\.pt: (not a checkpoint|contains no run)"):
        train(tmp_path, 1, resume=True)


def test_a_run_resumed_at_its_end_stays_what_it_was(tmp_path: Path) -> None:
    train(tmp_path, None)
    before, log = load_model(tmp_path), (tmp_path / "log.jsonl").read_text()
    train(tmp_path, None, resume=True)
    after = load_model(tmp_path)
    assert (tmp_path / "log.jsonl").read_text() == log  # with no second validation
    assert after[2]["resolution_px"] == before[2]["resolution_px"] == 96
    assert after[3] == before[3]


def test_the_weights_file_is_the_averaged_network_in_half_precision(whole: tuple[Path, Trainer]) -> None:
    out, trainer = whole
    model, config, training, sha256 = load_model(out)
    assert config.contract.name == "tiny"
    assert (training["samples"], training["samples_before"]) == (16, 0)
    assert len(sha256) == 64
    averaged = trainer.average.state_dict()
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, averaged[name], rtol=1e-3, atol=1e-4)


def test_weights_of_another_run_start_a_network_with_another_head(
    whole: tuple[Path, Trainer], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out, earlier = whole
    text = tiny.TOML.replace("hypotheses = 4", "hypotheses = 2")
    started = Trainer(parse_config(text, "two.toml"), torch.device("cpu"))
    untouched = started.model.head_rot.weight.clone()
    started.start_from(out / "weights.pt")
    assert caplog.messages[0].endswith("weights, which begin untrained: head_rot, head_hypothesis, head_refine")
    caplog.clear()
    Trainer(tiny.config(), torch.device("cpu")).start_from(out / "weights.pt")
    assert caplog.messages == []  # all fit
    kept, given = started.model.state_dict(), earlier.average.state_dict()
    # The last is of a head that only training has, and that a run which goes on must not learn anew.
    for name in ("neck.fuse.0.weight", "head_dense.1.weight"):
        torch.testing.assert_close(kept[name], given[name], rtol=1e-3, atol=1e-4, check_dtype=False)
    assert torch.equal(started.model.head_rot.weight, untouched)
    assert started.started_from.startswith("weights ")
    assert started.samples_before == 16
    again = Trainer(parse_config(text, "two.toml"), torch.device("cpu"))
    again.restore(started.state())
    assert (again.samples, again.samples_before) == (0, 16)

    content = torch.load(out / "weights.pt", weights_only=True)
    del content["training"]["samples_before"]  # as files were written before it was kept
    content["training"]["started_from"] = "weights 0123456789abcdef"
    torch.save(content, tmp_path / "older.pt")
    started.start_from(tmp_path / "older.pt")
    assert started.samples_before is None
    content["training"]["started_from"] = "public ImageNet weights"
    torch.save(content, tmp_path / "first.pt")
    started.start_from(tmp_path / "first.pt")
    assert started.samples_before == 16

    torch.save({"weights": {"elsewhere": torch.zeros(1)}}, tmp_path / "other.pt")
    with pytest.raises(ConfigError, match="no weights that fit"):
        started.start_from(tmp_path / "other.pt")


def test_sigterm_ends_a_run_between_steps_with_a_checkpoint(tmp_path: Path) -> None:
    text = tiny.TOML.replace("[schedule]\nsamples = 16", "[schedule]\nsamples = 1000000")
    log = tmp_path / "log.jsonl"
    ended = threading.Event()

    def terminate_after_the_first_step() -> None:
        while not (log.exists() and '"train"' in log.read_text()) and not ended.wait(0.05):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    watcher = threading.Thread(target=terminate_after_the_first_step)
    watcher.start()
    try:
        trainer = train(tmp_path, 500, text)
    finally:
        ended.set()
        watcher.join()
    assert 1 <= trainer.steps < 500
    assert load_model(tmp_path)[2]["steps"] == trainer.steps


def test_frozen_blocks_stay_as_another_run_left_them_and_the_rest_learns(
    whole: tuple[Path, Trainer], tmp_path: Path
) -> None:
    out, _ = whole
    text = tiny.TOML.replace("[schedule]", "[schedule]\nfrozen_blocks = 1")
    trained = train(tmp_path, 2, text, start_from=out / "weights.pt").model.state_dict()
    begun = Trainer(parse_config(text, "frozen.toml"), torch.device("cpu"))
    begun.start_from(out / "weights.pt")
    same = {name for name, value in begun.model.state_dict().items() if torch.equal(value, trained[name])}
    early = {name for name in trained if name.startswith(("backbone.stem.", "backbone.stages.0."))}
    assert early
    assert early <= same
    learning = {name for name in trained if name.startswith(("backbone.stages.1.", "neck.")) and ".c.weight" in name}
    assert learning
    assert not learning & same

    with pytest.raises(ConfigError, match="frozen_blocks = 9: the backbone has 4 blocks"):
        Trainer(
            parse_config(tiny.TOML.replace("[schedule]", "[schedule]\nfrozen_blocks = 9"), "f.toml"),
            torch.device("cpu"),
        )
