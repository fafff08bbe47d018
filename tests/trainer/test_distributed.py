"""Two processes under torchrun train one network: both hold the same weights, learned from both their samples, and a
run that was broken off goes on as if it had not been."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import synthetic_sampler
import tiny
import torch

from trainer.checkpoint import load_file, load_model, weights_sha256
from trainer.config import parse_config
from trainer.train import run_training

STEPS = 3
TEXT = tiny.TOML.replace(", { from_progress = 0.7, size_px = 96 }", "").replace("samples = 16\nw", "samples = 64\nw")
# Its rendering processes import it too, and need no torch.
WORKER = """
import os, sys
from pathlib import Path
sys.path.insert(0, {here!r})
import synthetic_sampler

if __name__ == "__main__":
    from trainer.checkpoint import weights_sha256
    from trainer.config import parse_config
    from trainer.train import run_training

    out, text, steps, begin = Path(sys.argv[1]), Path(sys.argv[2]).read_text(), int(sys.argv[3]), sys.argv[4]
    trainer = run_training(
        parse_config(text, "tiny.toml"), text, out,
        max_steps=steps, resume=begin == "resume", open_sampler=synthetic_sampler.opener,
    )
    Path(out, "hash" + os.environ["RANK"]).write_text(weights_sha256(trainer.model.state_dict()))
"""


def torchrun(folder: Path, steps: int, begin: str = "anew") -> tuple[Path, str]:
    """Run folder and what was printed, after so many steps of two processes from now."""
    script, config, out = folder / "worker.py", folder / "tiny.toml", folder / "run"
    script.write_text(WORKER.format(here=str(Path(__file__).parent)))
    config.write_text(TEXT)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [str(script), str(out), str(config), str(steps), begin]
    done = subprocess.run(command, capture_output=True, text=True, timeout=220)
    assert done.returncode == 0, done.stderr[-3000:]
    return out, done.stdout


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    return torchrun(tmp_path_factory.mktemp("two"), STEPS)


def test_both_processes_hold_the_same_weights(two: tuple[Path, str]) -> None:
    out, _ = two
    assert (out / "hash0").read_text() == (out / "hash1").read_text()


def test_the_second_process_adds_samples_of_its_own(two: tuple[Path, str], tmp_path: Path) -> None:
    out, _ = two
    assert load_model(out)[2]["samples"] == 2 * STEPS * 4
    config = parse_config(TEXT, "tiny.toml")
    alone = run_training(config, TEXT, tmp_path, max_steps=STEPS, open_sampler=synthetic_sampler.opener)
    assert weights_sha256(alone.model.state_dict()) != (out / "hash0").read_text()


def test_one_process_keeps_the_record(two: tuple[Path, str]) -> None:
    out, said = two
    assert said.count("windows of 64 px") == 1
    assert load_model(out)[2]["processes"] == 2
    state = load_file(out / "resume.pt")["trainer"]
    assert state["steps"] == STEPS
    assert all(torch.isfinite(value).all() for value in state["model"].values())


def test_a_run_broken_off_goes_on_to_the_same_weights(two: tuple[Path, str], tmp_path: Path) -> None:
    unbroken, _ = two
    torchrun(tmp_path, 1)
    out, _ = torchrun(tmp_path, STEPS - 1, "resume")
    assert load_model(out)[2]["samples"] == 2 * STEPS * 4
    assert {(out / f"hash{rank}").read_text() for rank in (0, 1)} == {(unbroken / "hash0").read_text()}
