"""What a dataset says of itself any reader of TOML takes; what a worker is given and cannot use is told by its name."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from sim_replay.benchmark.plan import plan_dataset
from sim_replay.benchmark.preset import load_preset, parse_preset
from sim_replay.benchmark.sequence_files import Job
from sim_replay.cli import main

PRESET = """
name = "mine"
size_wh_px = [64, 64]
sequence_frames = [2, 2]
[splits]
test = { sequences = 1, frames = 2 }
[airframes]
only = ["light_aircraft"]
[picture]
weather = { clear = 1 }
quality = { ordinary = 1 }
"""


def test_the_command_is_told_as_it_was_given(tmp_path: Path) -> None:
    preset = tmp_path / 'of "Müller" \\new\\it\'s.toml'
    preset.write_text(PRESET)
    out = tmp_path / "data"
    words = ["generate", "--preset", str(preset), "--seed", "4"]
    assert main([*words, "--out", str(out), "--labels-only", "--workers", "1"]) == 0
    for path in (out / "dataset.toml", out / "test" / "000000" / "sequence.toml"):
        told = tomllib.loads(path.read_text(encoding="utf-8"))["command"]
        assert shlex.split(told) == ["uavpose-replay", *words, "--labels-only"]


def test_the_command_of_a_part_makes_that_part(tmp_path: Path) -> None:
    preset, out = tmp_path / "mine.toml", tmp_path / "data"
    splits = "val = { sequences = 2, frames = 4 }\ntest = { sequences = 3, frames = 6 }"
    preset.write_text(PRESET.replace("test = { sequences = 1, frames = 2 }", splits))
    words = ["generate", "--preset", str(preset), "--seed", "0", "--labels-only"]
    for added, part in (("0-1", "--split val"), ("3", "--sequences 0-1,3")):
        assert main([*words, "--out", str(out), "--workers", "1", "--resume", "--sequences", added]) == 0
        told = tomllib.loads((out / "dataset.toml").read_text(encoding="utf-8"))["command"]
        assert shlex.split(told) == ["uavpose-replay", *words, *part.split()]


def test_a_photograph_that_a_worker_cannot_read_is_told_as_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(PRESET)
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    (photographs / "torn.jpg").write_bytes(b"\xff\xd8\xff no more")
    preset = parse_preset("mine.toml", PRESET)
    # Half of the sequences take a photograph; here is a seed of one that does.
    seed = next(s for s in range(20) if plan_dataset(preset, s)[0].environment_seed // 2 % 2)
    words = ["generate", "--preset", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "data")]
    assert main([*words, "--seed", str(seed), "--backdrops", str(photographs), "--workers", "1"]) == 2
    told = capsys.readouterr().err
    assert "torn.jpg is not a readable picture" in told
    assert "--resume" not in told


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("page.jpg", r"page\.jpg is not a readable picture"),
        ("sky.exr", r"holds no \.jpg, \.png or \.hdr file"),
        ("._sky.jpg", r"holds no \.jpg, \.png or \.hdr file"),  # macOS writes it beside sky.jpg
    ],
)
def test_what_is_no_photograph_is_told_before_anything_is_flown(
    name: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(PRESET)
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / name).write_text("<html>moved</html>")
    words = ["generate", "--preset", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "data")]
    assert main([*words, "--backdrops", str(tmp_path / "photographs")]) == 2
    assert re.search(told, capsys.readouterr().err)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_every_photograph_is_used_and_half_of_the_sequences_use_none(count: int) -> None:
    preset = load_preset("fw-uav6d")
    plans = plan_dataset(preset, 0)
    photographs = tuple(Path(f"{number}.jpg") for number in range(count))
    job = Job(preset, Path("data"), "", {}, backdrops=photographs)
    used = Counter(job.backdrop(plan) for plan in plans)
    assert 0.4 < used.pop(None) / len(plans) < 0.6
    assert used.keys() == set(photographs)
    assert max(used.values()) < 2 * min(used.values())


def words_in(folder: Path) -> list[str]:
    words = ["generate", "--preset", str(folder / "mine.toml"), "--out", str(folder / "data"), "--labels-only"]
    return [*words, "--workers", "1", "--backdrops", str(folder / "photographs")]


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset, for which two photographs were offered."""
    folder = tmp_path_factory.mktemp("once")
    (folder / "mine.toml").write_text(PRESET)
    (folder / "photographs").mkdir()
    for name in ("lake", "meadow"):
        cv2.imwrite(str(folder / "photographs" / f"{name}.png"), np.full((32, 64, 3), 90, np.uint8))
    assert main(words_in(folder)) == 0
    return folder


@pytest.fixture
def made(once: Path, tmp_path: Path) -> list[str]:
    """The words that make such a dataset, which is there, go on."""
    shutil.copytree(once, tmp_path, dirs_exist_ok=True)
    return [*words_in(tmp_path), "--resume"]


def test_the_same_recipe_goes_on(made: list[str]) -> None:
    assert main(made) == 0


@pytest.mark.parametrize(
    ("instead_of_lake", "told"),
    [
        ("lake", r"\[backdrops\] lake\.png is \w{64} there and \w{64} now"),
        ("city", r"\[backdrops\] city\.png is absent there and \w{64} now"),
    ],
)
def test_as_many_other_photographs_are_not_mixed_in(
    instead_of_lake: str, told: str, made: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (tmp_path / "data" / "dataset.toml").read_bytes()
    (tmp_path / "photographs" / "lake.png").unlink()
    cv2.imwrite(str(tmp_path / "photographs" / f"{instead_of_lake}.png"), np.full((32, 64, 3), 91, np.uint8))
    assert main(made) == 2
    assert re.search(told, capsys.readouterr().err)
    assert (tmp_path / "data" / "dataset.toml").read_bytes() == before


def test_other_packages_are_not_mixed_in(made: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "data" / "dataset.toml"
    installed = tomllib.loads(path.read_text(encoding="utf-8"))["packages"]["numpy"]
    path.write_text(path.read_text(encoding="utf-8").replace(f'numpy = "{installed}"', 'numpy = "0.9"'))
    before = path.read_bytes()
    assert main(made) == 2
    assert f"[packages] numpy is 0.9 there and {installed} now; it must stay" in capsys.readouterr().err
    assert path.read_bytes() == before
