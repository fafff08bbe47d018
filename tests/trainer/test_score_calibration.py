"""From peaks to probabilities: the fit against a law that is known, and a file calibrated by command."""

from __future__ import annotations

import json
import math
import resource
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msgs.contract import ScoreCalibration
from sim_replay.bop import DISTORTION_KEY
from sim_replay.datasets import open_dataset
from sim_replay.evaluation.candidates import Candidate, candidates
from sim_replay.evaluation.judge import judge_frames
from sim_replay.offline import estimator_answers, load_model
from tests.sim_replay.conftest import CX_PX, CY_PX, FOCAL_PX, SPOT_Z_M, dark_spot_model
from trainer.cli import main
from trainer.config import ConfigError
from trainer.graph import read_contract, write_contract
from trainer.score_calibration import ScoresTellNothing, TooFewCandidates, expected_calibration_error, fit
from trainer.score_command import calibrate_file, warn_of_training_images

__all__ = ["dark_spot_model"]

TRUE = ScoreCalibration(offset=-6.0, slope=3.0, size_slope=1.5, size_cap_px=45.0)
peaks = st.floats(0.0, 1.0)
sizes = st.floats(0.0, 3000.0)


def drawn(law: ScoreCalibration, count: int, seed: int) -> list[Candidate]:
    rng = np.random.default_rng(seed)
    seen = []
    for peak, shown in zip(rng.uniform(0.1, 0.95, count), np.exp(rng.uniform(1.5, 5.5, count)), strict=True):
        on = bool(rng.random() < law.probability(float(peak), float(shown)))
        seen.append(Candidate("acquire", float(peak), float(shown), on))
    return seen


def test_the_law_that_the_peaks_were_drawn_by_is_found() -> None:
    found = fit(drawn(TRUE, 20_000, seed=1))
    assert found.size_cap_px == TRUE.size_cap_px
    assert (found.offset, found.slope, found.size_slope) == pytest.approx(
        (TRUE.offset, TRUE.slope, TRUE.size_slope), rel=0.1
    )


def test_what_is_told_comes_true_as_often_as_told_on_peaks_not_seen_before() -> None:
    found, later = fit(drawn(TRUE, 2000, seed=2)), drawn(TRUE, 20_000, seed=3)
    assert expected_calibration_error(found, later) < 0.02
    assert expected_calibration_error(ScoreCalibration(), later) > 0.1


def test_what_is_told_too_often_in_one_bin_does_not_make_up_for_too_seldom_in_another() -> None:
    """Of two at 15 % one is a target, of two at 85 % none, and the one at 100 % is: (0.7 + 1.7 + 0) / 5."""
    told = [(0.15, True), (0.15, False), (0.85, False), (0.85, False), (1.0, True)]
    seen = [Candidate("track", peak, 50.0, on) for peak, on in told]
    assert expected_calibration_error(ScoreCalibration(), seen) == pytest.approx(2.4 / 5, abs=1e-5)


def test_peaks_that_part_perfectly_have_a_finite_answer() -> None:
    seen = [Candidate("track", 0.7, 50.0, True)] * 30 + [Candidate("track", 0.2, 50.0, False)] * 30
    found = fit(seen)
    assert found.probability(0.7, 50.0) > 0.9
    assert found.probability(0.2, 50.0) < 0.1
    assert all(math.isfinite(value) for value in (found.offset, found.slope, found.size_slope))


def test_too_few_peaks_are_refused_with_their_number() -> None:
    on, off = Candidate("track", 0.7, 50.0, True), Candidate("track", 0.2, 50.0, False)
    for targets, elsewhere in ((19, 30), (30, 19)):
        with pytest.raises(TooFewCandidates, match=rf"^{targets} peaks on targets and {elsewhere} elsewhere"):
            fit([on] * targets + [off] * elsewhere)
    fit([on] * 20 + [off] * 20)


def test_a_network_whose_higher_peaks_are_no_surer_is_refused() -> None:
    rng = np.random.default_rng(0)
    on = [Candidate("track", float(peak), 30.0, True) for peak in rng.uniform(0.1, 0.5, 40)]
    off = [Candidate("track", float(peak), 30.0, False) for peak in rng.uniform(0.2, 0.7, 40)]
    with pytest.raises(ScoresTellNothing, match="do not separate targets from background: train it longer"):
        fit(on + off)
    with pytest.raises(ScoresTellNothing):
        fit([Candidate("track", 0.5, 30.0, k % 2 == 0) for k in range(80)])


@given(peaks, peaks, sizes)
def test_a_higher_peak_of_the_same_size_is_never_less_probable(a: float, b: float, shown_px: float) -> None:
    low, high = TRUE.probability(min(a, b), shown_px), TRUE.probability(max(a, b), shown_px)
    assert 0.0 <= low <= high <= 1.0


@given(peaks, sizes)
def test_as_it_stands_it_leaves_the_peak_as_it_is(peak: float, shown_px: float) -> None:
    assert ScoreCalibration().probability(peak, shown_px) == pytest.approx(peak, abs=2e-6)


@pytest.mark.parametrize("peak", [math.nan, math.inf])
def test_a_peak_that_is_not_finite_is_no_target(peak: float) -> None:
    assert TRUE.probability(peak, 50.0) == 0.0


def write_scene(
    scene: Path,
    spots: int,
    specks: int,
    spot_greys: tuple[int, int] = (20, 90),
    speck_greys: tuple[int, int] = (110, 160),
) -> None:
    """Targets that are nearly black; then pictures of none, with a grey speck that the network takes for one."""
    (scene / "rgb").mkdir(parents=True)
    rng = np.random.default_rng(5)
    cameras, poses = {}, {}
    for frame in range(spots + specks):
        x_m, y_m = rng.uniform((-50.0, -25.0), (50.0, 25.0))
        center = (round(CX_PX + FOCAL_PX * x_m / SPOT_Z_M), round(CY_PX + FOCAL_PX * y_m / SPOT_Z_M))
        grey = int(rng.integers(*(spot_greys if frame < spots else speck_greys)))
        image = np.full((1080, 1920, 3), 240, np.uint8)
        cv2.ellipse(image, center, (70, 65), 0, 0, 360, (grey, grey, grey), -1, cv2.LINE_AA)
        cv2.imwrite(str(scene / "rgb" / f"{frame:06d}.png"), image)
        cameras[str(frame)] = {"cam_K": [FOCAL_PX, 0, CX_PX, 0, FOCAL_PX, CY_PX, 0, 0, 1], "depth_scale": 1.0}
        if frame < spots:
            t_mm = [x_m * 1e3, y_m * 1e3, SPOT_Z_M * 1e3]
            poses[str(frame)] = [{"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": t_mm}]
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    boxes = {
        frame: [{"bbox_visib": [*_corner(target["cam_t_m2c"]), 140, 130], "px_count_visib": 14000, "visib_fract": 1.0}]
        for frame, (target,) in poses.items()
    }
    (scene / "scene_gt_info.json").write_text(json.dumps(boxes))
    models = scene.parents[1] / "models"
    models.mkdir(exist_ok=True)
    size_mm = {"min_x": -6e3, "min_y": -6e3, "min_z": -1e3, "size_x": 12e3, "size_y": 12e3, "size_z": 2e3}
    (models / "models_info.json").write_text(json.dumps({"1": {"diameter": 12e3, **size_mm}}))


def _corner(t_mm: list[float]) -> tuple[int, int]:
    return round(CX_PX + FOCAL_PX * t_mm[0] / t_mm[2]) - 70, round(CY_PX + FOCAL_PX * t_mm[1] / t_mm[2]) - 65


def test_a_calibrated_file_tells_targets_from_what_fooled_it(
    tmp_path: Path, dark_spot_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "dataset" / "val" / "000000", spots=24, specks=24)
    write_scene(tmp_path / "dataset" / "test" / "000000", spots=0, specks=1)
    model = tmp_path / "model.onnx"
    shutil.copy(dark_spot_model, model)
    before = read_contract(model)

    dataset_of = ["--dataset", str(tmp_path / "dataset"), "--split"]
    assert main(["calibrate-score", "--model", str(model), *dataset_of, "training"]) == 2
    assert "no split 'training'; it has test, val" in capsys.readouterr().err
    assert main(["calibrate-score", "--model", str(model), *dataset_of, "val"]) == 0
    assert capsys.readouterr().out.startswith("acquire")
    after = read_contract(model)
    assert (after.acquire_score_min, after.track_score_min) == (0.7, 0.3)
    assert after.training["score_frames"] == 48
    assert after.training["score_datasets"] == "dataset/val (48)"
    same = before.model_dump(exclude={"acquire_score", "track_score", "acquire_score_min", "track_score_min"})
    assert {**after.model_dump(exclude=set(before.model_dump()) - set(same)), "training": {}, "metrics": {}} == same

    dataset = open_dataset(tmp_path / "dataset", "val")
    judged = judge_frames(list(dataset.frames()), dataset.models, estimator_answers(load_model(model, threads=1)))
    found = [match.estimate for frame in judged for match in frame.matches if match.estimate is not None]
    assert len(found) >= 22
    assert sum(len(frame.false_poses) for frame in judged) <= 2


def test_images_that_the_model_was_trained_on_are_warned_of(
    tmp_path: Path, dark_spot_model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for split in ("train_pbr", "val"):
        write_scene(tmp_path / "dataset" / split / "000000", spots=12, specks=12)
    model = tmp_path / "model.onnx"
    shutil.copy(dark_spot_model, model)
    trained_on = "my dataset, split val: 10%; dataset, split train: 40%; rendered windows: 50%, of them 20% empty"
    write_contract(model, read_contract(model).model_copy(update={"data": trained_on}))
    warn_of_training_images(open_dataset(tmp_path / "dataset", "val"), read_contract(model))
    assert caplog.text == ""
    assert main(["calibrate-score", "--model", str(model), "--dataset", str(tmp_path / "dataset")]) == 0
    assert f"{tmp_path / 'dataset'}: the model was trained on split train_pbr of a dataset of this name" in caplog.text
    caplog.clear()
    of_its_folder = read_contract(model).model_copy(update={"data": "train_pbr, split train: 40%"})
    warn_of_training_images(open_dataset(tmp_path / "dataset"), of_its_folder)
    assert "the model was trained on split train_pbr" in caplog.text
    caplog.clear()
    refined = read_contract(dark_spot_model).model_copy(
        update={"training": {"presence_datasets": "dataset, split val"}}
    )
    warn_of_training_images(open_dataset(tmp_path / "dataset", "train_pbr"), refined)
    assert caplog.text == ""
    warn_of_training_images(open_dataset(tmp_path / "dataset", "val"), refined)
    assert "the model was trained on split val" in caplog.text, "its heads were"


def test_behind_a_lens_a_peak_on_the_target_counts_as_one(tmp_path: Path, dark_spot_model: Path) -> None:
    K, lens = np.array([[FOCAL_PX, 0, CX_PX], [0, FOCAL_PX, CY_PX], [0, 0, 1]]), (-1.0, 0.0, 0.0, 0.0, 0.0)
    scene = tmp_path / "dataset" / "val" / "000000"
    (scene / "rgb").mkdir(parents=True)
    around = np.linspace(0.0, 2 * np.pi, 90)
    center_m = SPOT_Z_M * np.array([0.35, 0.02, 1.0])
    ring = center_m + 6.0 * np.column_stack([np.cos(around), np.sin(around), np.zeros_like(around)])
    outline, _ = cv2.projectPoints(ring, np.zeros(3), np.zeros(3), K, np.array(lens))
    image = np.full((1080, 1920, 3), 240, np.uint8)
    cv2.fillPoly(image, [np.round(outline).astype(np.int32)], (40, 40, 40), cv2.LINE_AA)
    middle, _ = cv2.projectPoints(center_m[None], np.zeros(3), np.zeros(3), K, np.array(lens))
    cv2.circle(image, [round(float(v)) for v in middle.ravel()], 9, (5, 5, 5), -1, cv2.LINE_AA)
    cv2.imwrite(str(scene / "rgb" / "000000.png"), image)
    x, y, width, height = cv2.boundingRect(np.round(outline).astype(np.int32))
    pose = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": (1e3 * center_m).tolist()}
    (scene / "scene_camera.json").write_text(json.dumps({"0": {"cam_K": K.ravel().tolist(), DISTORTION_KEY: lens}}))
    (scene / "scene_gt.json").write_text(json.dumps({"0": [pose]}))
    (scene / "scene_gt_info.json").write_text(json.dumps({"0": [{"bbox_visib": [x, y, width, height]}]}))
    pictures = open_dataset(tmp_path / "dataset").labelled_frames()
    seen = list(candidates(load_model(dark_spot_model, threads=1), pictures))
    assert [(one.stage, one.is_target) for one in seen] == [("acquire", True), ("track", True)]
    side_px = FOCAL_PX * 12.0 / SPOT_Z_M  # in the frame; squashed to 640x384, and a window 1.8 as large in 256 px
    shown_px = (side_px * np.sqrt(640 / 1920 * 384 / 1080), 256 / 1.8)
    assert [one.shown_px for one in seen] == pytest.approx(shown_px, rel=0.01)


def test_a_peak_on_an_aircraft_that_the_list_of_targets_leaves_out_is_neither_right_nor_wrong(
    tmp_path: Path, dark_spot_model: Path
) -> None:
    write_scene(tmp_path / "dataset" / "test" / "000000", spots=2, specks=1)
    names = [{"scene_id": 0, "im_id": image, "obj_id": image, "inst_count": 1} for image in (1, 0, 2)]
    (tmp_path / "dataset" / "test_targets_bop19.json").write_text(json.dumps(names))
    pictures = open_dataset(tmp_path / "dataset", "test").boxed_frames()
    assert [len(picture.targets) for picture in pictures] == [0, 1, 0]
    seen = list(candidates(load_model(dark_spot_model, threads=1), pictures))
    assert [one.is_target for one in seen] == [True, True, False, False]  # both stages; the speck is none


def test_what_tells_no_targets_or_not_where_they_are_is_named_and_the_file_left(
    tmp_path: Path, dark_spot_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The greys are the wrong way round for a network that finds what is dark; then there are no boxes."""
    scene = tmp_path / "dataset" / "val" / "000000"
    write_scene(scene, spots=24, specks=24, spot_greys=(110, 160), speck_greys=(20, 90))
    model = tmp_path / "model.onnx"
    shutil.copy(dark_spot_model, model)
    content = model.read_bytes()
    command = ["calibrate-score", "--model", str(model), "--dataset", str(tmp_path / "dataset")]
    assert main(command) == 2
    assert f"{model}: acquire: its scores do not separate targets from background" in capsys.readouterr().err
    (scene / "scene_gt_info.json").unlink()
    (scene.parents[1] / "models" / "models_info.json").unlink()
    assert main(command) == 2
    assert "nothing tells where picture 0 shows its target of obj_id 1" in capsys.readouterr().err
    assert model.read_bytes() == content


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path: Path, dark_spot_model: Path) -> None:
    """A limit on the size of files stands for a disk that is full."""
    model = tmp_path / "model.onnx"
    shutil.copy(dark_spot_model, model)
    content = model.read_bytes()
    contract = read_contract(model)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) // 2, limits[1]))
    try:
        with pytest.raises(ConfigError, match=r"model\.onnx: cannot be written: File too large"):
            write_contract(model, contract)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert model.read_bytes() == content
    assert list(tmp_path.iterdir()) == [model]


def test_a_dataset_without_false_peaks_is_refused_and_the_file_left(
    tmp_path: Path, dark_spot_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "dataset" / "val" / "000000", spots=20, specks=0)
    model = tmp_path / "model.onnx"
    shutil.copy(dark_spot_model, model)
    content = model.read_bytes()
    assert main(["calibrate-score", "--model", str(model), "--dataset", str(tmp_path / "dataset")]) == 2
    assert "--dataset: acquire: 20 peaks on targets and 0 elsewhere" in capsys.readouterr().err
    assert model.read_bytes() == content


def test_too_few_targets_are_refused_before_the_model_runs(tmp_path: Path, dark_spot_model: Path) -> None:
    """Thousands of images may be without a target, and the model would run on each of them for nothing."""
    write_scene(tmp_path / "dataset" / "val" / "000000", spots=2, specks=3)
    begun: list[int] = []
    with pytest.raises(ConfigError, match=r"--dataset: 2 visible targets in 5 images: at least 20 are needed"):
        calibrate_file(dark_spot_model, [tmp_path / "dataset"], on_start=begun.append)
    assert not begun
