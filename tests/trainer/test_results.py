"""The results page says what was measured, beside the paper, and how much training is behind it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from edge.config import SHIPPED_MODEL
from sim_replay.cli import main as replay
from trainer.cli import main
from trainer.config import ConfigError
from trainer.results import (
    CURVES,
    EXPLANATION,
    HISTORY,
    PAPER,
    datasets_in,
    draw_history,
    gathered,
    measure,
    page,
    read_beside,
    read_history,
    refuse_other_pictures,
    told,
)

ROOT = Path(__file__).parents[2]
CROSSING = ROOT / "sim_replay" / "data" / "crossing"
SMALL_PRESET = """
name = "small"
size_wh_px = [480, 270]
sequence_frames = [4, 5]
fps = [10.0]
splits = { train = { sequences = 1, frames = 4 }, test = { sequences = 1, frames = 4 } }
airframes = { only = ["light_aircraft"] }
lens = { focal_px = [300, 2000], box_share = 0.02 }
picture = { weather = { clear = 1 }, quality = { ordinary = 1 } }
compression = [{ jpeg_quality = [80, 90] }]
"""


def run_folder(folder: Path, samples: list[int]) -> Path:
    folder.mkdir(exist_ok=True)
    metrics = {"E_r_mean_deg": 30.0, "E_r_median_deg": 10.0, "depth_rel_mean": 0.1, "depth_rel_median": 0.05}
    metrics |= {"pose_10deg_5pct": 0.3, "rot_lt_10deg": 0.5}
    lines = [{"kind": "train", "samples": 1}]
    lines += [{"kind": "validation", "samples": n, "size_px": 128, "windows": 256, **metrics} for n in samples]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_samples_of_runs_begun_from_each_other_add_up(tmp_path: Path) -> None:
    history = gathered([], [run_folder(tmp_path / "a", [100, 250]), run_folder(tmp_path / "b", [40])])
    assert [line["total_samples"] for line in history] == [100, 250, 290]
    assert (history[0]["E_r_mean_deg"], history[0]["pose_10deg_5pct"]) == (30.0, 0.3)
    assert told(history, {}).startswith("Trained on 290 windows in 2 runs")
    refined = {"refined_windows": 1200, "refined_epochs": 3, "refined_seed": 7, "refined_strangers": 0.35}
    ending = "3 epochs on 1,200 further windows (seed 7; 35 % of the targets are randomly generated aircraft)."
    assert told(history, refined).endswith(f"The refinement head was then trained alone for {ending}")
    presence = {f"presence_{key.removeprefix('refined_')}": value for key, value in refined.items()}
    both = told(history, refined | presence | {"presence_seed": 8, "presence_strangers": 0.5})
    of_presence = ending.replace("seed 7; 35 %", "seed 8; 50 %")
    assert both.endswith(f" for {ending} The presence head was then trained alone for {of_presence}")
    draw_history(history, tmp_path / "learning.png")
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ConfigError, match="no validation"):
        gathered([], [run_folder(tmp_path / "c", [])])


def test_a_rate_that_a_run_could_not_measure_stays_unknown(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "a", [100])
    log = folder / "log.jsonl"
    log.write_text(log.read_text().replace('"windows": 256', '"windows": 256, "false_alarms": null'))
    assert gathered([], [folder])[0]["false_alarms"] is None
    log.write_text(re.sub(r'("E_r_mean_deg"|"pose_10deg_5pct"): [\d.]+', r"\1: null", log.read_text()))
    history = gathered([], [folder])
    assert history[0]["E_r_mean_deg"] is None
    draw_history(history, tmp_path / "learning.png")
    assert (tmp_path / "learning.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_is_added_to_the_history_and_one_that_went_on_takes_its_place_and_all_after_it(tmp_path: Path) -> None:
    a, b, c = (run_folder(tmp_path / name, samples) for name, samples in (("a", [100]), ("b", [40]), ("c", [5])))
    history = gathered(gathered([], [a, b]), [c])
    assert [line["total_samples"] for line in history] == [100, 140, 145]
    run_folder(b, [40, 60])
    assert [line["total_samples"] for line in gathered(history, [b])] == [100, 140, 160]


def test_the_shipped_history_ends_with_the_shipped_weights() -> None:
    from edge.estimator.model import load_model

    training = load_model(SHIPPED_MODEL, 1).contract.training
    assert read_history(HISTORY)[-1]["samples"] == training["samples"]


def test_the_readme_and_the_card_speak_of_the_shipped_model() -> None:
    sha256 = hashlib.sha256(SHIPPED_MODEL.read_bytes()).hexdigest()
    windows = f"{read_history(HISTORY)[-1]['total_samples']:,} "
    readme, card = (path.read_text() for path in (ROOT / "README.md", SHIPPED_MODEL.parent / "README.md"))
    assert f"`{sha256[:8]}…`" in readme
    assert sha256 in card
    assert windows in readme
    assert windows in card


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first images of the bundled scene: enough to have its track confirmed and sent."""
    folder = tmp_path_factory.mktemp("begins") / "crossing"
    shutil.copytree(CROSSING, folder, ignore=shutil.ignore_patterns("0000[4-9]*", "0001*"))
    for labels in folder.glob("scene_*.json"):
        kept = {key: told for key, told in json.loads(labels.read_text()).items() if int(key) < 40}
        labels.write_text(json.dumps(kept))
    return folder


@pytest.fixture(scope="module")
def scores(crossing: Path) -> list[dict[str, Any]]:
    """Of the shipped model."""
    return measure([None], [crossing], lambda _: None)


def test_the_page_has_a_row_for_each_score_and_one_of_the_paper(scores: list[dict[str, Any]]) -> None:
    kinds = [(score["mode"], score["size_given"]) for score in scores]
    assert kinds == [("frames", False), ("frames", True), ("track", False), ("track", True)]
    text = page(scores, "the command", "Trained on much.")
    rows = [line for line in text.splitlines() if line.startswith("| crossing")]
    assert [row.split(" | ")[:2] for row in rows] == [
        ["| crossing", "int8"],
        ["| crossing", "int8, size given"],
        ["| crossing, track", "int8"],
        ["| crossing, track", "int8, size given"],
    ]
    for score, row in zip(scores, rows, strict=True):
        assert f"| {100 * score['overall']['recall']:.1f} |" in row
        assert f"| {score['overall']['translation_error_m']['mean']:.1f} |" in row
    assert [line for line in text.splitlines() if line.startswith("## crossing")] == [
        "## crossing, int8, frames",
        "## crossing, int8, track",
    ]
    paper = next(line for line in text.splitlines() if "the paper, FP32" in line)
    assert f"{100 * PAPER['pose_10deg_5pct']:.1f}" in paper
    assert "the command" in text
    shown = (ROOT / "docs" / "results.md").read_text()
    assert all(words in text and words in shown for words in (EXPLANATION, CURVES))


def test_another_method_stands_beside_a_model_that_saw_the_same_pictures(
    scores: list[dict[str, Any]], crossing: Path, tmp_path: Path
) -> None:
    other = {**scores[0], "method": {"file": "other_crossing-all.csv", "precision": None}}
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps(other))
    beside = read_beside([path])
    refuse_other_pictures(beside, [crossing])
    rows = [line for line in page(scores, "the command", "", beside).splitlines() if line.startswith("| ")]
    first = [row.split(" | ")[:2] for row in rows[5:7]]
    assert [row[0] for row in first] == ["| crossing", "| FW-UAV6DPose (the paper's own data)"]
    assert first[0][1] == "other_crossing-all.csv"

    track = {**scores[2], "method": other["method"]}
    refuse_other_pictures([track], [crossing])
    older = {key: value for key, value in other.items() if key != "labels_sha256"}
    refuse_other_pictures([older], [crossing])
    fewer = {**older, "overall": {**other["overall"], "frames": 3}}
    another_seed = {**other, "labels_sha256": "0" * 64}
    for unlike in (fewer, another_seed, {**other, "every": 2}, {**track, "own_ship": "exact"}):
        with pytest.raises(ConfigError, match="other images"):
            refuse_other_pictures([unlike], [crossing])
    for text in ("no json", "{}", "[]", json.dumps({**other, "method": "other_crossing-all.csv"})):
        path.write_text(text)
        with pytest.raises(ConfigError, match=str(path)):
            read_beside([path])


def test_a_model_beside_is_told_by_its_name_and_how_long_it_learnt() -> None:
    from sim_replay.offline import load_model, method_of

    method = method_of(load_model(SHIPPED_MODEL, 1)) | {"training_samples": 24_000}
    score = {
        "dataset": "d",
        "mode": "frames",
        "overall": {"frames": 1},
        "by_range": {},
        "by_airframe": {},
        "recipe": "",
    }
    text = page([{**score, "method": method}], "the command", "", [{**score, "method": method}])
    assert "| d | mf-uavpose6d-edge, int8, after 24,000 windows | 1 |" in text


def test_each_column_tells_the_figure_of_its_name_and_the_papers_row_the_papers() -> None:
    method = {"file": "m.onnx", "precision": "int8", "sha256": "0" * 64}
    group = {
        "frames": 9,
        "targets": 8,
        "recall": 0.911,
        "false_positives_per_1000": 12.4,
        "rotation_error_deg": {"mean": 1.11, "median": 2.22},
        "translation_error_m": {"mean": 3.33, "median": 30.3},
        "depth_error_m": {"mean": 4.44, "median": 40.4},
        "depth_error_rel": {"mean": 0.055, "median": 0.066},
        "bearing_error_deg": {"mean": 0.0777, "median": 0.0888},
        "rot_10deg": 0.822,
        "depth_5pct": 0.733,
        "pose_10deg_5pct": 0.644,
        "add_0_5d": 0.555,
        "add_0_1d": 0.466,
    }
    score = {"dataset": "d", "mode": "frames", "method": method, "recipe": "", "overall": group}
    bands = {"100-200": group, "200-300": {"targets": 0}}
    measured = [{**score, "by_range": bands, "by_airframe": {"glider": group}}]
    measured += [{**score, "dataset": "e", "by_range": {}, "by_airframe": {}}]
    beside = {**score, "method": {"file": "another.csv"}}
    text = page(measured, "the command", "", [beside])
    figures = "91.1 | 12 | 1.1 | 2.2 | 82.2 | 3.3 | 4.4 | 73.3 | 64.4 | 55.5 | 46.6 | 0.078 |"
    names = "recall % | false / 1,000 | E_r mean ° | median ° | Rot<10° % | E_t mean m | E_z mean m | Depth<5 % % |"
    names += " Pose@10°/5 % % | ADD-0.5d % | ADD-0.1d % | bearing mean ° |"
    rows = text.splitlines()
    assert f"| dataset | model | frames | Pose, 95 % | {names}" in rows
    overall = [f"| {name} | 9 | – | {figures}" for name in ("d | int8", "d | another.csv", "e | int8")]
    first = rows.index(overall[0])
    assert rows[first : first + 3] == overall
    assert f"| range m | targets | {names}" in rows
    assert f"| airframe | targets | {names}" in rows
    assert f"| 100-200 | 8 | {figures}" in rows
    assert not any("200-300" in row for row in rows)
    assert f"| glider | 8 | {figures}" in rows
    papers = "– | – | 5.0 | – | 90.9 | 7.3 | 7.0 | 89.0 | 82.8 | 88.5 | – | – |"
    assert f"| FW-UAV6DPose (the paper's own data) | the paper, FP32 | 4,500 | – | {papers}" in rows


def test_a_rate_is_told_with_how_far_other_flights_may_put_it() -> None:
    method = {"file": "m.onnx", "precision": "int8", "sha256": "0" * 64}
    score = {"dataset": "d", "mode": "frames", "overall": {"frames": 9}, "by_range": {}, "by_airframe": {}}
    score |= {"method": method, "recipe": ""}
    told = {**score, "dataset": "e", "intervals_95": {"pose_10deg_5pct": (0.7012, 0.8049)}}
    text = page([score, told], "the command", "")
    assert "| d | int8 | 9 | – |" in text
    assert "| e | int8 | 9 | 70–80 |" in text


def test_two_models_of_one_name_and_precision_are_told_apart() -> None:
    from sim_replay.offline import load_model, method_of

    method = method_of(load_model(SHIPPED_MODEL, 1))
    score = {"dataset": "d", "mode": "frames", "overall": {}, "by_range": {}, "by_airframe": {}, "recipe": ""}
    score["overall"] = {"frames": 1}
    other = {**method, "sha256": "0" * 64}
    text = page([{**score, "method": one} for one in (method, other)], "the command", "")
    for one in (method, other):
        assert f"sha256 `{one['sha256'][:16]}`" in text
        assert f"| d | int8 `{one['sha256'][:8]}` | 1 |" in text
        assert f"## d, int8 `{one['sha256'][:8]}`, frames" in text


def test_what_lies_beside_the_test_split_is_not_measured(tmp_path: Path) -> None:
    preset, dataset = tmp_path / "small.toml", tmp_path / "two_splits"
    preset.write_text(SMALL_PRESET)
    made = ["generate", "--preset", str(preset), "--seed", "3", "--every", "2", "--out", str(dataset), "--workers", "1"]
    assert replay(made) == 0
    assert {path.name for path in dataset.iterdir()} >= {"train", "test"}
    other = Path(shutil.copy(SHIPPED_MODEL, tmp_path / "other.onnx"))
    score, _, of_other = measure([None, other], [dataset], lambda _: None)
    assert (score["method"]["file"], of_other["method"]["file"]) == (SHIPPED_MODEL.name, "other.onnx")
    assert score["overall"]["frames"] == len(list((dataset / "test").glob("*/rgb/*")))
    assert score["recipe"].endswith("--every 2 --split test")


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (["--out", "{tmp}/file"], "{tmp}/file: cannot be made a folder"),
        (["--out", "{tmp}/out", "--model", "{tmp}/typo.onnx"], "{tmp}/typo.onnx: no such model file"),
        (["--out", "{tmp}/out", "--model", "{tmp}/history.jsonl"], "{tmp}/history.jsonl: not an ONNX model"),
        (["--out", "{tmp}/out", "--model", "{tmp}/file"], "{tmp}/file: has no uavpose_contract metadata"),
        (["--out", "{tmp}/out", "--beside", "{tmp}/none.json"], "{tmp}/none.json: is not a metrics.json"),
    ],
)
def test_what_is_wrong_is_told_before_anything_is_measured_or_changed(
    wrong: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "history.jsonl").write_bytes(HISTORY.read_bytes())
    monkeypatch.setattr("trainer.results.HISTORY", tmp_path / "history.jsonl")
    (tmp_path / "benchmark" / "one").mkdir(parents=True)
    (tmp_path / "benchmark" / "one" / "dataset.toml").touch()
    given = ["--benchmark", str(tmp_path / "benchmark"), "--runs", str(run_folder(tmp_path / "run", [100]))]
    arguments = [word.format(tmp=tmp_path) for word in wrong]
    monkeypatch.setattr("trainer.results.measure", lambda *_: pytest.fail("it measured"))
    assert main(["results", *given, *arguments]) == 2
    assert told.format(tmp=tmp_path) in capsys.readouterr().err
    assert (tmp_path / "history.jsonl").read_bytes() == HISTORY.read_bytes()


def test_what_stands_beside_other_pictures_is_refused_before_the_hours_of_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    dataset = tmp_path / "benchmark" / "crossing"
    shutil.copytree(CROSSING, dataset, copy_function=os.symlink)
    (dataset / "dataset.toml").touch()
    score = {"dataset": "crossing", "split": None, "mode": "frames", "overall": {"frames": 150, "targets": 149}}
    beside = tmp_path / "metrics.json"
    beside.write_text(json.dumps({**score, "method": {"file": "other.csv"}}))
    monkeypatch.setattr("trainer.results.measure", lambda *_: pytest.fail("it measured"))
    given = ["--benchmark", str(dataset.parent), "--beside", str(beside), "--out", str(tmp_path / "out")]
    assert main(["results", *given]) == 2
    told = "other.csv: was evaluated on other images: ('crossing', None, 1, 150, 149, 'frames', None, None)"
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_without_datasets_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=str(tmp_path)):
        datasets_in(tmp_path)
