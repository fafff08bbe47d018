"""Scoring a BOP dataset through the estimator and the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from edge.errors import InputError
from edge.estimator.decode import DOUBT_SIGMA_ROTATION_RAD
from sim_replay.cli import main
from sim_replay.datasets import open_dataset
from sim_replay.evaluation.judge import judge_frames
from sim_replay.offline import estimator_answers, load_model, with_score_min


def score_command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [Path(sys.executable).parent / "uavpose-replay", "score", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_every_frame_is_judged_by_itself(dark_spot_scene: Path, dark_spot_model: Path) -> None:
    dataset = open_dataset(dark_spot_scene)
    answers = estimator_answers(load_model(dark_spot_model, threads=1))
    results = judge_frames(list(dataset.frames()), dataset.models, answers)
    assert [len(result.matches) for result in results] == [1, 1, 1, 1, 0]
    assert [result.false_poses for result in results] == [()] * 5
    for result in results[:4]:
        match = result.matches[0]
        assert match.rotation_error_deg == pytest.approx(0.0, abs=1e-4)
        # The spot's darkest pixel lies within its radius of six pixels, 0.5 m at 200 m.
        assert match.translation_error_m is not None
        assert match.translation_error_m < 0.75
        assert match.estimate is not None
        assert match.estimate.score == pytest.approx(250 / 255, abs=0.05)
        assert match.estimate.covariance is not None
        doubt = (1.0 - match.estimate.score) * DOUBT_SIGMA_ROTATION_RAD**2
        assert match.estimate.covariance[3, 3] == pytest.approx(0.1**2 + doubt, rel=1e-4)


def test_a_higher_least_score_lets_less_through(dark_spot_scene: Path, dark_spot_model: Path) -> None:
    """The network's score of a spot is its darkness, 250 of 255, and of an empty sky 15: odds of 50 and of 1/16.

    Of the whole frame and its windows together they are 2,500 and 1/256.
    """
    dataset = open_dataset(dark_spot_scene)
    pictures = list(dataset.frames())
    found = []
    for score_min in (0.001, None, 0.9999):
        answers = estimator_answers(with_score_min(load_model(dark_spot_model, threads=1), score_min))
        results = judge_frames(pictures, dataset.models, answers)
        found.append((sum(m.estimate is not None for r in results for m in r.matches), len(results[-1].false_poses)))
    assert found == [(4, 1), (4, 0), (0, 0)]
    with pytest.raises(InputError, match="between 0 and 1"):
        with_score_min(load_model(dark_spot_model, threads=1), 1.5)


def test_the_command_scores_a_dataset_folder_as_json(dark_spot_scene: Path, dark_spot_model: Path) -> None:
    done = score_command("--dataset", dark_spot_scene.parents[1], "--model", dark_spot_model, "--json")
    assert done.returncode == 0, done.stderr
    score = json.loads(done.stdout)
    overall = score["overall"]
    assert (overall["frames"], overall["targets"], overall["false_poses"]) == (5, 4, 0)
    assert overall["recall"] == overall["pose_10deg_5pct"] == 1.0
    assert overall["false_positives_per_1000"] == 0.0
    assert {band for band, group in score["by_range"].items() if group["targets"]} == {"200-300"}
    assert score["method"]["file"] == "dark-spot.onnx"


def test_the_command_shows_the_score_as_a_table(dark_spot_scene: Path, dark_spot_model: Path) -> None:
    done = score_command("--dataset", dark_spot_scene.parents[1], "--every", "2", "--model", dark_spot_model)
    assert done.returncode == 0, done.stderr
    for words in ("dark-spot.onnx on dataset, 3 frames", "200-300 m", "Pose@10°/5 %", "obj_000001"):
        assert words in done.stdout


def test_a_table_that_is_written_to_a_file_is_whole(dark_spot_scene: Path, dark_spot_model: Path) -> None:
    info = dark_spot_scene.parents[1] / "models" / "models_info.json"
    models = json.loads(info.read_text())
    models["1"]["name"] = "tandem-wing-loitering-munition-with-pusher-propeller"
    info.write_text(json.dumps(models))
    done = score_command("--dataset", dark_spot_scene.parents[1], "--model", dark_spot_model)
    (row,) = [line for line in done.stdout.splitlines() if "propeller" in line]
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert (cells[0], cells[1:3], cells[-1]) == (models["1"]["name"], ["4", "100.0%"], "100.0%")


def test_bad_input_is_told_in_a_sentence_with_exit_code_2(
    dark_spot_scene: Path, dark_spot_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = json.loads((dark_spot_scene / "scene_gt.json").read_text())
    del poses["0"][0]["cam_t_m2c"]
    (dark_spot_scene / "scene_gt.json").write_text(json.dumps(poses))
    cases = (
        (["--dataset", dark_spot_scene, "--model", dark_spot_model], ("scene_gt.json", "cam_t_m2c")),
        (["--dataset", dark_spot_scene / "rgb", "--model", dark_spot_model], ("no BOP scene",)),
        (["--dataset", dark_spot_scene.parents[1], "--split", "val", "--model", dark_spot_model], ("'val'",)),
        (["--dataset", dark_spot_scene, "--every", "0", "--model", dark_spot_model], ("--every 0",)),
        (["--dataset", dark_spot_scene, "--model", dark_spot_scene / "none.onnx"], ("none.onnx",)),
    )
    for arguments, words in cases:
        assert main(["score", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert all(word in said for word in words), said
    done = score_command(*cases[0][0])
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
