"""What a run leaves behind: enough to make it again, and what a person looks at while it goes on."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import synthetic_sampler
import tiny
import torch
from odd_samplers import NoTargets
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.waiting import until
from trainer.checkpoint import load_file, save_weights, write_atomic
from trainer.cli import main
from trainer.config import ConfigError, parse_config
from trainer.data import training_batch
from trainer.plan import Plan
from trainer.runlog import RunLog, commit_of
from trainer.train import run_training
from trainer.trainer import Trainer

# The command and the same with --resume; of two processes each would import torch.
TWICE = "import sys; from trainer.cli import main; print(main(sys.argv[1:]), main([*sys.argv[1:], '--resume']))"
LONG = tiny.TOML.replace("samples = 16\nw", "samples = 1000000\nw")


def train(out: Path, text: str = tiny.TOML, **options: object) -> Trainer:
    config = parse_config(text, "tiny.toml")
    return run_training(config, text, out, open_sampler=synthetic_sampler.opener, **options)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two starts: three steps of eight samples, then to their end."""
    out = tmp_path_factory.mktemp("run")
    with (out / "said.txt").open("w") as said, contextlib.redirect_stdout(said):
        train(out, samples=20, max_steps=3)
        train(out, resume=True)
    return out


def test_the_folder_tells_how_each_start_was_asked_for(run: Path) -> None:
    first, second = json.loads((run / "run.json").read_text())["starts"]
    assert (first["from_samples"], second["from_samples"]) == (0, 12)
    assert first["planned_samples"] == second["planned_samples"] == 20
    for start in (first, second):
        assert start["seed"] == 3
        assert start["budget_s"] is None
        assert start["started_from"] == "scratch"
        assert {"commit", "torch", "numpy", "python", "device", "processes", "config_sha256"} <= start.keys()
    assert (run / "config.toml").read_text() == tiny.TOML


def test_a_commit_is_marked_where_what_makes_or_learns_the_windows_was_changed(tmp_path: Path) -> None:
    assert commit_of(tmp_path) == "unknown"
    for name in ("trainer/train.py", "sim_replay/sampler.py", "msgs/contract.py", "docs/page.md"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("as committed\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"]):
        subprocess.run([*git, *words], check=True)
    head = subprocess.check_output([*git, "rev-parse", "HEAD"], text=True).strip()
    (tmp_path / "docs/page.md").write_text("changed\n")
    assert commit_of(tmp_path) == head
    (tmp_path / "sim_replay/sampler.py").write_text("changed\n")
    assert commit_of(tmp_path) == head + "+"
    subprocess.run([*git, "checkout", "-q", "sim_replay"], check=True)
    (tmp_path / "msgs/new.py").write_text("not committed\n")
    assert commit_of(tmp_path) == head + "+"


def test_what_a_crashed_start_told_beyond_its_checkpoint_is_not_told_twice(tmp_path: Path) -> None:
    def told(from_samples: int, *samples: int) -> list[int]:
        log = RunLog(tmp_path, tiny.TOML, {"from_samples": from_samples})
        for count in samples:
            log.add(1.0, {"geodesic": 0.1}, 5.0, 0.1)
            log.report(count // 4, count, 0.5, 1e-3)
        log.close()
        return [json.loads(line)["samples"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]

    assert told(0, 4, 8, 12) == [4, 8, 12]
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"kind": "tr')  # the power went
    # TensorBoard reads event files by name: the second they were opened in, and within one a counter as text.
    began = int(time.time())
    until(lambda: int(time.time()) > began, what="the next second")
    assert told(8, 12, 16) == [4, 8, 12, 16]
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in board.Scalars("train/loss")] == [4, 8, 12, 16]


def test_a_step_without_a_target_has_no_error_and_does_not_better_the_curve(tmp_path: Path) -> None:
    trainer = Trainer(tiny.config(), torch.device("cpu"))
    samplers = synthetic_sampler.PlateSampler(5, 64), NoTargets(5, 64)
    steps = [trainer.step(training_batch(sampler.batch(0, 4)), 0.0) for sampler in samplers]
    log = RunLog(tmp_path, tiny.TOML, {"from_samples": 0})
    for step in steps:
        log.add(step.loss, step.terms, step.rotation_deg, step.depth_rel)
    log.report(2, 8, 0.5, 1e-3)
    log.close()
    told = json.loads((tmp_path / "log.jsonl").read_text())
    assert (told["rotation_deg"], told["depth_rel"]) == (steps[0].rotation_deg, steps[0].depth_rel)
    assert told["rotation_deg"] > 0.0
    assert told["loss"] == pytest.approx((steps[0].loss + steps[1].loss) / 2)


@pytest.mark.parametrize(("written", "told"), [('{"starts": [', "not JSON"), ("{}", "has no list of starts")])
def test_a_record_of_starts_that_was_damaged_is_named(tmp_path: Path, written: str, told: str) -> None:
    (tmp_path / "run.json").write_text(written)
    with pytest.raises(ConfigError, match=rf"run\.json: {told}"):
        RunLog(tmp_path, tiny.TOML, {"from_samples": 0})


def test_a_second_run_in_the_folder_is_refused_while_the_first_is_at_work(tmp_path: Path) -> None:
    """Their curves would be told as one, and the weights be of whichever saved last."""
    out, other = tmp_path / "run", tmp_path / "other.toml"
    other.write_text(tiny.TOML.replace("seed = 3", "seed = 7"))
    tries: list[subprocess.CompletedProcess[str]] = []

    def opener(seed: int, size_px: int) -> object:
        if not tries:
            command = [sys.executable, "-c", TWICE, "train", "--config", str(other), "--out", str(out)]
            tries.append(subprocess.run(command, capture_output=True, text=True, check=False, timeout=200))
        return synthetic_sampler.opener(seed, size_px)

    config = parse_config(tiny.TOML, "tiny.toml")
    run_training(config, tiny.TOML, out, open_sampler=opener, max_steps=1)
    (tried,) = tries
    assert tried.stdout.split() == ["2", "2"]
    assert tried.stderr == 2 * f"uavpose-trainer: {out}: is in use by another run; give another --out\n"
    assert (out / "config.toml").read_text() == tiny.TOML
    assert [start["seed"] for start in json.loads((out / "run.json").read_text())["starts"]] == [3]
    assert train(out, resume=True).samples == 16


def test_a_run_whose_end_is_a_time_to_validate_does_so_once(tmp_path: Path) -> None:
    train(tmp_path, tiny.TOML.replace("threads = 1", "threads = 1\nvalidate_every_samples = 8"))
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [record["samples"] for record in records if record["kind"] == "validation"] == [8, 16]


def test_a_resumed_run_keeps_its_plan(run: Path) -> None:
    assert load_file(run / "resume.pt")["trainer"]["samples"] == 20


def test_the_weights_say_where_they_come_from(run: Path) -> None:
    training = load_file(run)["training"]
    assert training["samples"] == 20
    assert training["started_from"] == "scratch"


def test_nothing_half_written_is_left_and_all_may_read_who_may_read_the_rest(run: Path) -> None:
    assert not list(run.glob("*.part"))
    assert (run / "weights.pt").stat().st_mode == (run / "run.json").stat().st_mode


def test_a_write_that_fails_leaves_the_last_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    write_atomic(path, {"whole": 1})

    class Unwritable:
        def __reduce__(self) -> str:
            raise ArithmeticError("half-way")

    with pytest.raises(ArithmeticError, match="half-way"):
        write_atomic(path, {"first": bytes(100_000), "cannot": Unwritable()})
    assert load_file(path) == {"whole": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_tensorboard_has_every_figure_of_the_log_and_pictures(run: Path) -> None:
    records = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    board = EventAccumulator(str(run / "tensorboard"), size_guidance={"images": 0}).Reload()
    losses = {event.step: event.value for event in board.Scalars("train/loss")}
    logged = {record["samples"]: record["loss"] for record in records if record["kind"] == "train"}
    assert losses == pytest.approx(logged)
    assert {"train/geodesic", "train/lr", "validation/E_r_mean_deg", "validation/recall"} <= set(
        board.Tags()["scalars"]
    )
    pictures = board.Images("held out")
    assert (pictures[0].width, pictures[0].height) == (768, 384)


def test_a_line_of_progress_says_how_far_how_fast_and_how_good(run: Path) -> None:
    line = next(line for line in (run / "said.txt").read_text().splitlines() if line.startswith("step      3"))
    assert re.match(
        r"step +3  samples +12 +40\.0 %.* images/s .*loss \d.* rotation error +\d+\.\d deg  depth error +\d", line
    )


def test_a_budget_ends_a_run_and_stretches_its_schedule_over_itself(tmp_path: Path) -> None:
    trainer = train(tmp_path, LONG, budget_s=1.0)
    assert trainer.steps >= 1
    state = load_file(tmp_path / "resume.pt")
    assert state["used_s"] >= 1.0
    progress = [json.loads(line).get("progress") for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert max(filter(None, progress)) > trainer.samples / 1_000_000


def test_a_resumed_run_goes_on_within_its_budget(tmp_path: Path) -> None:
    """A budget of some steps out of a million samples: by the samples alone, progress would start at nothing again."""

    def logged() -> list[float]:
        records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
        return [record["progress"] for record in records if record["kind"] == "train"]

    train(tmp_path, LONG, budget_s=60.0, max_steps=2)
    first = logged()
    train(tmp_path, LONG, resume=True, max_steps=1)
    assert logged()[-1] >= first[-1] > 100 * 8 / 1_000_000
    state = load_file(tmp_path / "resume.pt")
    state["used_s"] = state["budget_s"]
    torch.save(state, tmp_path / "resume.pt")
    with pytest.raises(ConfigError, match=f"{tmp_path}: the run's time budget is used up; give --budget-minutes"):
        train(tmp_path, LONG, resume=True)


def test_another_number_of_samples_leaves_the_time_budget_as_it_is_until_it_is_used_up() -> None:
    plan = Plan(1000, used_before_s=40.0, budget_s=60.0)
    assert plan.resumed(Path("run"), None, 500) == Plan(500, 40.0, 60.0)
    assert plan.resumed(Path("run"), 5.0, 500) == Plan(500, 40.0, 45.0)
    assert plan._replace(used_before_s=60.0).resumed(Path("run"), None, 2000) == Plan(2000, 60.0, None)


def test_a_plan_that_takes_the_schedule_back_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(tmp_path, LONG, budget_s=60.0, max_steps=2)
    capsys.readouterr()
    train(tmp_path, LONG, resume=True, budget_s=6000.0, max_steps=1)
    assert re.search(r"the schedule goes back from \d+% to \d+%", capsys.readouterr().out)


def test_weights_that_another_command_left_are_not_overwritten(tmp_path: Path) -> None:
    save_weights(tmp_path / "weights.pt", tiny.network(), tiny.TOML, {"samples": 0})
    before = (tmp_path / "weights.pt").read_bytes()
    with pytest.raises(ConfigError, match="already contains weights"):
        train(tmp_path, start_from=tmp_path / "weights.pt")
    assert (tmp_path / "weights.pt").read_bytes() == before


def test_a_resumed_run_takes_no_other_weights(run: Path) -> None:
    with pytest.raises(ConfigError, match="--start-from"):
        train(run, resume=True, start_from=run / "weights.pt")


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "--budget-minutes", "-1"],
        ["train", "--budget-minutes", "nan"],
        ["train", "--samples", "0"],
        ["ablate", "--windows", "0"],
        ["ablate", "--samples", "-1"],
        ["export", "--checkpoint", "x", "--samples", "0"],
        ["export", "--checkpoint", "x", "--tolerance", "-1"],
        ["export", "--checkpoint", "x", "--tolerance-pose", "inf"],
        ["evaluate", "--windows", "8", "--seed", "-1"],
    ],
)
def test_a_number_that_means_nothing_is_refused(arguments: list[str], capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--out", "x"])
    assert ended.value.code == 2
    told = re.escape(f"argument {arguments[-2]}: {arguments[-1]!r} is not ")
    assert re.search(told + "an? ", capsys.readouterr().err)


def test_a_folder_that_cannot_be_is_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "tiny.toml").write_text(tiny.TOML)
    out = str(tmp_path / "file" / "run")
    assert main(["train", "--config", str(tmp_path / "tiny.toml"), "--out", out]) == 2
    assert main(["export", "--untrained", str(tmp_path / "tiny.toml"), "--out", out]) == 2
    assert capsys.readouterr().err.count(f"uavpose-trainer: {out}: cannot be made a folder: Not a directory\n") == 2


def test_a_folder_that_nobody_may_write_to_is_named_before_anything_is_rendered(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["export", "--checkpoint", str(run)], ["evaluate", "--model", str(run), "--windows", "16"]):
        assert main([*command, "--out", "/proc/self"]) == 2
        told = "uavpose-trainer: /proc/self: cannot be written: /proc/self is read-only, or belongs to another user\n"
        assert capsys.readouterr() == ("", told)


def test_ctrl_c_where_nothing_is_to_be_kept_ends_without_a_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    try:
        assert main(["evaluate", "--out", str(tmp_path / "out")]) == 130
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
    assert capsys.readouterr().err == "uavpose-trainer: interrupted\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_mixed_precision_on_cuda_learns_and_resumes(tmp_path: Path) -> None:
    text = tiny.TOML.replace("threads = 1", "threads = 1\nbf16 = true")
    train(tmp_path, text, max_steps=2)
    trainer = train(tmp_path, text, resume=True)
    assert trainer.device.type == "cuda"
    assert trainer.steps == 4
    assert all(torch.isfinite(value).all() for value in trainer.model.state_dict().values())


def test_the_convolutions_run_in_bfloat16_and_the_poses_in_float32() -> None:
    config = parse_config(tiny.TOML.replace("threads = 1", "threads = 1\nbf16 = true"), "tiny.toml")
    trainer = Trainer(config, torch.device("cpu"))
    seen: dict[str, torch.dtype] = {}

    def listen(part: str) -> None:
        hook = lambda *call: seen.update({part: call[-1].dtype})  # noqa: E731
        trainer.model.get_submodule(part).register_forward_hook(hook)

    listen("neck")
    listen("pam")
    result = trainer.step(training_batch(synthetic_sampler.PlateSampler(1, 64).batch(0, 4)), 0.0)
    assert seen == {"neck": torch.bfloat16, "pam": torch.float32}
    assert math.isfinite(result.loss)
    assert all(p.dtype == torch.float32 for p in trainer.model.parameters())
