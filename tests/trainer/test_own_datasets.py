"""Training on one's own datasets: odd files, cameras and splits that must change neither windows nor weights."""

from __future__ import annotations

from pathlib import Path

from tests.trainer.test_trained_on import discs, on_dataset
from trainer.checkpoint import load_model
from trainer.cli import main


def test_a_configuration_with_a_byte_order_mark_gives_weights_that_can_be_used_and_trained_on(tmp_path: Path) -> None:
    """Some editors put one before UTF-8; it had gone into the checkpoint, which then was not valid TOML."""
    for split in ("train", "val"):
        discs(tmp_path / "own" / split / "000001", 1500.0, (200.0, 260.0))
    config, run = tmp_path / "own.toml", tmp_path / "run"
    config.write_text("\ufeff" + on_dataset(tmp_path / "own"), encoding="utf-8")
    command = ["train", "--config", str(config), "--out", str(run)]
    assert main([*command, "--samples", "4"]) == 0
    assert load_model(run)[2]["samples"] == 4
    assert main([*command, "--samples", "8", "--resume"]) == 0
    assert load_model(run)[2]["samples"] == 8
