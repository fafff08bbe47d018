"""`uavpose-trainer evaluate` on datasets: known poses to known figures, real model files, files written, bad input."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny
import torch
from scipy.spatial.transform import Rotation

from sim_replay.evaluation.bop_results import write_results as write_bop_results
from trainer.checkpoint import save_weights
from trainer.cli import main
from trainer.evaluate import SCORE_THRESHOLD
from trainer.evaluate_dataset import DatasetRequest, evaluate_dataset
from trainer.export import export_unmeasured

# The dataset's models are drawn nose y, right wing x, up z; z = 0.5 m of theirs is the body's origin.
R_BODY_MODEL = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
T_BODY_MODEL_M = np.array([0.0, 0.0, 0.5])
VERTICES_MM = [(0, 4000, 0), (0, -4000, 0), (6000, 0, 0), (-6000, 0, 0), (0, 0, 1500)]
RANGES_M = (150.0, 250.0, 350.0, 450.0)
EMPTY_IMAGES = (4, 5)
RATES = ("recall", "rot_10deg", "depth_5pct", "pose_10deg_5pct", "add_0_5d", "add_0_1d")
KEYS = {
    *RATES, "frames", "false_positives_per_1000", "rotation_error_deg", "translation_error_m", "depth_error_m",
    "bearing_error_deg",
}  # fmt: skip


def true_pose(image: int) -> tuple[np.ndarray, np.ndarray]:
    """R_cam_body and t_cam_body_m of the target in an image."""
    R = Rotation.random(rng=np.random.default_rng(image)).as_matrix()
    return R, np.array([5.0 * image, -3.0, RANGES_M[image]])


def of_model(R_cam_body: np.ndarray, t_cam_body_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same pose told of the model's axes, as BOP files have it: R_m2c, t_m2c in millimetres."""
    return R_cam_body @ R_BODY_MODEL, 1e3 * (t_cam_body_m + R_cam_body @ T_BODY_MODEL_M)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images with one target each and two empty ones, written as the BOP format says, by hand."""
    root = tmp_path_factory.mktemp("data") / "plane"
    scene = root / "test" / "000002"
    (scene / "rgb").mkdir(parents=True)
    cameras, poses = {}, {}
    for image in (0, 1, 2, 3, *EMPTY_IMAGES):
        cv2.imwrite(str(scene / "rgb" / f"{image:06d}.png"), np.full((120, 160, 3), 200, np.uint8))
        cameras[str(image)] = {"cam_K": [900, 0, 79.5, 0, 900, 59.5, 0, 0, 1], "depth_scale": 1.0}
        poses[str(image)] = []
        if image not in EMPTY_IMAGES:
            R, t_mm = of_model(*true_pose(image))
            poses[str(image)] = [{"obj_id": 9, "cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": t_mm.tolist()}]
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    (root / "models").mkdir()
    head = ["ply", "format ascii 1.0", f"element vertex {len(VERTICES_MM)}"]
    head += [f"property float {axis}" for axis in "xyz"] + ["end_header"]
    rows = [" ".join(map(str, vertex)) for vertex in VERTICES_MM]
    (root / "models" / "obj_000009.ply").write_text("\n".join([*head, *rows, ""]))
    (root / "models" / "models_info.json").write_text(json.dumps({"9": {"diameter": 12000, "name": "test_glider"}}))
    lines = [", ".join(map(str, row)) for row in R_BODY_MODEL]
    (root / "model_frame.toml").write_text(
        f"R_body_model = [[{lines[0]}], [{lines[1]}], [{lines[2]}]]\nt_body_model_m = {T_BODY_MODEL_M.tolist()}\n"
    )
    return root


def write_results(path: Path, poses: list[tuple[int, np.ndarray, np.ndarray]]) -> Path:
    """A results file of poses (image, R_cam_body, t_cam_body_m)."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["scene_id", "im_id", "obj_id", "score", "R", "t", "time"])
        for image, R_body, t_body_m in poses:
            R, t_mm = of_model(R_body, t_body_m)
            writer.writerow([2, image, 9, 0.9, " ".join(map(str, R.ravel())), " ".join(map(str, t_mm)), 0.02])
    return path


def evaluated(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    assert main(["evaluate", "--json", *map(str, arguments)]) == 0
    told, aside = capsys.readouterr()
    assert aside.startswith("written to ")  # no progress bar where no terminal shows it
    return json.loads(told)


def test_ground_truth_as_results_scores_perfectly(dataset: Path, tmp_path: Path) -> None:
    """In a process of its own, as a person runs it."""
    results = write_results(tmp_path / "truth_plane-test.csv", [(k, *true_pose(k)) for k in range(4)])
    out = tmp_path / "out"
    command = [Path(sys.executable).parent / "uavpose-trainer", "evaluate", "--results", results]
    done = subprocess.run(
        [*command, "--dataset", dataset, "--split", "test", "--out", out, "--json"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    score = json.loads(done.stdout)
    assert score == json.loads((out / "metrics.json").read_text())
    assert set(score["by_range"]) == {"100-200", "200-300", "300-400", "400-500"}
    assert set(score["by_airframe"]) == {"test_glider"}
    for group in (score["overall"], *score["by_range"].values(), *score["by_airframe"].values()):
        assert set(group) >= KEYS
        assert [group[rate] for rate in RATES] == [1.0] * 6
        assert group["translation_error_m"]["mean"] == pytest.approx(0.0, abs=1e-4)
        assert group["rotation_error_deg"]["mean"] == pytest.approx(0.0, abs=1e-4)
    assert score["overall"]["frames"] == 6
    assert score["overall"]["false_positives_per_1000"] == 0.0
    assert score["time_ms"]["p50"] == pytest.approx(20.0)


def test_known_errors_score_their_known_values_and_a_results_file_that_lies_where_the_figures_go_stays_as_it_is(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Turned by 6 and 14 degrees, 4 % too far, one missed; and one of two empty images is not seen as empty."""
    poses = []
    for image, angle_deg, stretch in ((0, 6.0, 1.0), (1, 14.0, 1.0), (2, 0.0, 1.04)):
        R, t_m = true_pose(image)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.0, 0.8])).as_matrix()
        poses.append((image, turn @ R, stretch * t_m))
    poses.append((5, np.eye(3), np.array([0.0, 0.0, 444.0])))
    results = write_results(tmp_path / "off_plane-test.csv", poses)
    content = results.read_bytes()
    monkeypatch.chdir(dataset.parent)
    score = evaluated(capsys, "--results", results, "--dataset", dataset.name, "--out", tmp_path)
    overall = score["overall"]
    assert overall["recall"] == overall["depth_5pct"] == 0.75
    assert overall["rot_10deg"] == overall["pose_10deg_5pct"] == 0.5
    assert overall["rotation_error_deg"]["mean"] == pytest.approx(20 / 3, abs=1e-3)
    assert overall["rotation_error_deg"]["median"] == pytest.approx(6.0, abs=1e-3)
    assert overall["depth_error_m"]["mean"] == pytest.approx(0.04 * 350 / 3, abs=1e-3)
    assert overall["translation_error_m"]["mean"] == pytest.approx(0.04 * np.linalg.norm(true_pose(2)[1]) / 3, abs=1e-3)
    assert overall["false_positives_per_1000"] == 500.0
    assert score["by_range"]["400-500"]["recall"] == 0.0
    assert score["by_range"]["400-500"]["false_positives_per_1000"] == 500.0
    assert score["by_range"]["200-300"]["rotation_error_deg"]["mean"] == pytest.approx(14.0, abs=1e-3)
    assert overall["add_0_5d"] == 0.5  # 14 m too far is more than half of 12 m
    assert score == json.loads((tmp_path / "metrics.json").read_text())
    assert results.read_bytes() == content
    lines = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert [(line["scene_id"], line["im_id"]) for line in lines] == [(2, k) for k in range(6)]
    assert lines[0]["targets"][0]["rotation_error_deg"] == pytest.approx(6.0, abs=1e-3)
    assert lines[3]["targets"][0]["estimate"] is None
    assert lines[5]["false_poses"][0]["t_cam_target_m"][2] == pytest.approx(444.0)
    assert lines[0]["image"] == "test/000002/rgb/000000.png"
    for name in ("error_by_range.png", "cumulative_error.png", "sequence_000002.png", "worst_frames.jpg"):
        assert cv2.imread(str(tmp_path / name)) is not None


def test_images_are_named_from_the_dataset_on_also_where_one_of_its_scenes_is_given(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = write_results(tmp_path / "truth_plane-test.csv", [(0, *true_pose(0))])
    monkeypatch.chdir(dataset / "test")
    evaluated(capsys, "--results", results, "--dataset", "000002", "--out", tmp_path / "out")
    first = json.loads((tmp_path / "out" / "frames.jsonl").read_text().splitlines()[0])
    assert first["image"] == "test/000002/rgb/000000.png"


def test_the_results_file_that_is_written_scores_the_same(dataset: Path, tmp_path: Path) -> None:
    R, t_m = true_pose(1)
    turn = Rotation.from_euler("y", 8, degrees=True).as_matrix()
    results = write_results(tmp_path / "mine_plane-test.csv", [(1, turn @ R, t_m), (4, R, t_m)])
    first = evaluate_dataset(DatasetRequest(results=results, dataset=dataset))
    written = tmp_path / "two" / results.name
    written.parent.mkdir()
    write_bop_results(written, first.judged)
    assert evaluate_dataset(DatasetRequest(results=written, dataset=dataset)).score == first.score


def test_results_that_cannot_be_written_are_told_in_a_sentence(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, out = write_results(tmp_path / "truth_plane-test.csv", [(0, *true_pose(0))]), tmp_path / "out"
    (out / "metrics.json").mkdir(parents=True)
    assert main(["evaluate", "--results", str(results), "--dataset", str(dataset), "--out", str(out)]) == 2
    assert f"uavpose-trainer: {out}: cannot be written: Is a directory" in capsys.readouterr().err


def test_figures_of_an_earlier_evaluation_do_not_stand_beside_the_new_metrics(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other scenes then, all of them empty now: what is not drawn anew would be taken for the new method's."""
    empty = tmp_path / "sky" / "test" / "000007"
    shutil.copytree(dataset / "test" / "000002", empty)
    (empty / "scene_gt.json").write_text("{}")
    results, out = write_results(tmp_path / "none_plane-test.csv", []), tmp_path / "out"
    evaluated(capsys, "--results", results, "--dataset", dataset, "--split", "test", "--out", out)
    (out / "sequence_of_mine.png").write_bytes(b"kept")
    assert (out / "worst_frames.jpg").is_file()
    evaluated(capsys, "--results", results, "--dataset", tmp_path / "sky", "--split", "test", "--out", out)
    figures = {"error_by_range.png", "cumulative_error.png", "sequence_000007.png"}
    assert {path.name for path in out.iterdir()} == {"metrics.json", "frames.jsonl", "sequence_of_mine.png", *figures}


def test_by_default_the_shipped_model_flies_over_the_bundled_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    score = evaluated(capsys, "--every", "50", "--out", tmp_path)
    assert score["dataset"] == "crossing"
    assert (score["method"]["file"], score["method"]["precision"]) == ("mf-uavpose6d-edge-int8.onnx", "int8")
    assert score["overall"]["frames"] == 3
    assert set(score["overall"]["calibration"]) == {"depth", "bearing", "rotation"}
    assert (tmp_path / "mf-uavpose6d-edge-int8_crossing-all.csv").is_file()


def test_a_checkpoint_scores_as_its_exported_file_does(dataset: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    save_weights(run / "weights.pt", tiny.network(), tiny.TOML, {"seed": 3, "samples": 0, "commit": "unknown"})
    one = evaluate_dataset(DatasetRequest(model=run, dataset=dataset))
    exported = export_unmeasured(run, tmp_path, score_min=SCORE_THRESHOLD)
    other = evaluate_dataset(DatasetRequest(model=exported, dataset=dataset))
    assert (one.score["method"]["file"], one.score["method"]["precision"]) == ("run", "fp32")
    for score in (one.score, other.score):
        del score["method"], score["time_ms"]
    assert one.score == other.score


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--every", "0"], ["--every 0"]),
        (["--dataset", "nowhere"], ["nowhere"]),
        (["--model", "nowhere.onnx", "--dataset", "DATASET"], ["nowhere.onnx"]),
        (["--model", "nowhere.pt", "--dataset", "DATASET"], ["nowhere.pt"]),
        (["--results", "nowhere.csv", "--dataset", "DATASET"], ["nowhere.csv"]),
        (["--dataset", "DATASET", "--split", "val"], ["'val'"]),
        (["--results", "nowhere.csv", "--mode", "track", "--dataset", "DATASET"], ["--mode track"]),
        (["--windows", "64", "--dataset", "DATASET"], ["--dataset", "--windows"]),
        (["--windows", "64", "--mode", "track"], ["--mode", "--windows"]),
        (["--windows", "64", "--score-min", "0.5"], ["--score-min", "--windows"]),
        (["--dataset", "DATASET", "--stage", "acquire"], ["--stage", "--windows"]),
        (["--dataset", "DATASET", "--seed", "7"], ["--seed", "--windows"]),
    ],
)
def test_bad_input_is_told_in_a_sentence(
    dataset: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
) -> None:
    given = [str(dataset) if argument == "DATASET" else argument for argument in arguments]
    assert main(["evaluate", *given]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said


def test_a_test_split_without_public_truth_is_not_scored_as_if_it_were_empty(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "secret"
    shutil.copytree(dataset, secret)
    (secret / "test" / "000002" / "scene_gt.json").unlink()
    results = write_results(tmp_path / "truth_plane-test.csv", [(0, *true_pose(0))])
    assert main(["evaluate", "--results", str(results), "--dataset", str(secret), "--out", str(tmp_path)]) == 2
    assert f"{secret}: no scene_gt.json" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_told_before_the_work(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out"
    # The model is not there either: it would be asked for next.
    assert main(["evaluate", "--model", "nowhere.onnx", "--dataset", str(dataset), "--out", str(out)]) == 2
    assert f"{out}: cannot be made a folder: {tmp_path / 'file'} is a file" in capsys.readouterr().err


@pytest.mark.parametrize("content", [[1, 2], torch.zeros(2), {"weights": {}, "config": tiny.TOML, "training": {}}])
def test_another_programs_checkpoint_is_told_in_a_sentence(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: object
) -> None:
    path = tmp_path / "other.pt"
    torch.save(content, path)
    assert main(["evaluate", "--checkpoint", str(path), "--dataset", str(dataset), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"uavpose-trainer: {path}: ")
    assert len(said.splitlines()) == 1


def test_json_that_nobody_reads_ends_without_a_traceback(dataset: Path, tmp_path: Path) -> None:
    results = write_results(tmp_path / "truth_plane-test.csv", [(0, *true_pose(0))])
    read_end, write_end = os.pipe()
    os.close(read_end)  # as `| head` does when it has enough
    command = [sys.executable, "-m", "trainer.cli", "evaluate", "--json", "--results", results, "--dataset", dataset]
    done = subprocess.run(
        [*command, "--out", tmp_path / "out"], stdout=write_end, stderr=subprocess.PIPE, text=True, timeout=200
    )
    os.close(write_end)
    assert done.returncode == 141
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "--own-ship: applies to --mode track"),
        (["--results", "method_crossing-test.csv"], "--own-ship: applies to --mode track"),
        (["--windows", "8"], "--own-ship: applies to datasets"),
    ],
)
def test_an_own_ship_that_nobody_is_told_of_is_refused(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--own-ship", "exact", *arguments]) == 2
    assert told in capsys.readouterr().err
