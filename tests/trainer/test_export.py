"""Exported files compute what the network computes, carry their contract, and take any size."""

from __future__ import annotations

import re
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from synthetic_sampler import PlateSampler

from msgs.contract import OUTPUT_NAMES
from msgs.geometry import R_from_euler
from trainer.checkpoint import load_model, save_weights
from trainer.comparison import Measured, Strayed, Tolerance, Views, comparison_table, too_blind
from trainer.config import ConfigError
from trainer.data import TrainingBatch, training_batch
from trainer.evaluate import (
    SCORE_THRESHOLD,
    Predictions,
    choose_threshold,
    constant_guess,
    difference,
    measure,
    predict_all,
    sigma_shortfall,
)
from trainer.export import export_models, export_unmeasured, stage_sampler, write_int8
from trainer.graph import onnx_predictor, open_session, read_contract
from trainer.held_out import Request, evaluate_file
from trainer.sources import window_sampler
from trainer.tally import Tally

ANY = Tolerance(180.0, 100.0, 100.0, 100.0, 100.0)


def open_view(seed: int, size_px: int, acquire_share: float) -> partial:
    return partial(PlateSampler, seed, size_px, empty_share=0.3)


class Exported:
    def __init__(self, folder: Path) -> None:
        self.run = folder / "run"
        save_weights(self.run / "weights.pt", tiny.network(), tiny.TOML, {"seed": 3, "samples": 0, "commit": "unknown"})
        self.said: list[str] = []
        self.fp32, self.int8 = export_models(
            self.run, folder / "models", samples=16, tolerance=ANY, open_view=open_view, say=self.said.append
        )


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return Exported(tmp_path_factory.mktemp("export"))


def inputs(count: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    image = np.random.default_rng(1).integers(0, 255, (count, height, width, 3), dtype=np.uint8)
    K = np.array([[900.0, 0, width / 2], [0, 880, height / 2], [0, 0, 1]], np.float32)
    return image, np.repeat(K[None], count, 0)


@pytest.mark.parametrize("shape", [(1, 64, 64), (3, 128, 96), (1, 384, 640)])
def test_fp32_file_equals_the_network(exported: Exported, shape: tuple[int, int, int]) -> None:
    image, K = inputs(*shape)
    model, *_ = load_model(exported.run)
    with torch.no_grad():
        expected = model(torch.from_numpy(image), torch.from_numpy(K))
    got = open_session(exported.fp32).run(list(OUTPUT_NAMES), {"image": image, "K": K})
    for name, a, b in zip(OUTPUT_NAMES, got, expected, strict=True):
        assert a.shape == tuple(b.shape), name
        np.testing.assert_allclose(
            a, b.numpy(), rtol=1e-4, atol=2e-3 if name.endswith(("_px", "_m")) else 1e-4, err_msg=name
        )


@pytest.mark.parametrize("shape", [(1, 128, 128), (2, 192, 192), (1, 256, 256), (1, 384, 640)])
def test_int8_file_takes_every_size_and_returns_poses(exported: Exported, shape: tuple[int, int, int]) -> None:
    image, K = inputs(*shape)
    out = dict(
        zip(OUTPUT_NAMES, open_session(exported.int8).run(list(OUTPUT_NAMES), {"image": image, "K": K}), strict=True)
    )
    R = out["R_cam_target"]
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-4)
    assert np.all((out["t_cam_target_m"][..., 2] >= 49.9) & (out["t_cam_target_m"][..., 2] <= 600.1))
    assert np.all(np.diff(out["score"], axis=1) <= 0)
    assert np.all(out["sigma"] > 0)
    for array in out.values():
        assert array.shape[:2] == (shape[0], 4)
        assert np.isfinite(array).all()


def test_int8_file_is_quantised_and_near_the_float_one(exported: Exported) -> None:
    assert exported.int8.stat().st_size < 0.7 * exported.fp32.stat().st_size
    image, K = inputs(4, 96, 96)
    one, other = onnx_predictor(exported.int8)(image, K), onnx_predictor(exported.fp32)(image, K)
    np.testing.assert_allclose(one.score, other.score, atol=0.05)


def test_both_files_carry_a_contract_with_what_was_measured(exported: Exported) -> None:
    fp32, int8 = read_contract(exported.fp32), read_contract(exported.int8)
    assert (fp32.precision, int8.precision) == ("fp32", "int8")
    assert fp32.weights_sha256 == int8.weights_sha256 == load_model(exported.run)[3]
    assert fp32.track_size_wh == (64, 64)
    assert fp32.airframes
    assert int8.data == "rendered windows: 100%, of them 12% without a target, 30% of the whole frame"
    assert int8.depth_limits_m == (50.0, 600.0)
    np.testing.assert_allclose(int8.pixel_mean_bgr, 255 * np.array([0.406, 0.456, 0.485]))  # ImageNet's, as BGR bytes
    np.testing.assert_allclose(int8.pixel_std_bgr, 255 * np.array([0.225, 0.224, 0.229]))
    assert int8.metrics["track_windows"] == 16.0
    assert 0 <= int8.metrics["acquire_E_r_median_deg"] <= 180
    assert any("INT8 vs. FP32" in text for text in exported.said)


def test_a_network_that_finds_few_targets_is_warned_of(exported: Exported) -> None:
    """INT8 that finds as little as FP32 is within all tolerances."""
    metrics = read_contract(exported.fp32).metrics
    for stage in ("track", "acquire"):
        recall = metrics[f"{stage}_recall"]
        assert recall < 0.5  # it is untrained
        told = f"WARNING: the {stage} stage finds {100 * recall:.0f} % of the targets"
        assert sum(text.startswith(told) for text in exported.said) == 1
    assert too_blind({"track_recall": 0.5, "acquire_recall": 0.9}) == []
    assert len(too_blind({"acquire_recall": 0.49})) == 1  # of a model without a track stage


def test_how_far_each_part_has_come_is_said(exported: Exported) -> None:
    for part, count in (("rendering", 64), ("evaluating FP32", 32), ("evaluating INT8", 32)):
        assert f"{part}: {count} of {count} windows" in exported.said
    said: list[str] = []
    tally = Tally("rendering", 464, said.append)
    for _ in range(29):
        tally.add(16)
    assert [text.split()[1] for text in said] == ["160", "304", "464"]


def windows(seed: int, size_px: int) -> TrainingBatch:
    return training_batch(open_view(seed, size_px, 0.0)().batch(0, 16))


@pytest.fixture(scope="module")
def views() -> Views:
    return Views([windows(1, 64)], [windows(2, 96)])


def measured(path: Path, views: Views) -> Measured:
    predict = onnx_predictor(path)
    return Measured(predict_all(predict, views.track), predict_all(predict, views.acquire))


@pytest.fixture(scope="module")
def strayed(exported: Exported, views: Views) -> Strayed:
    int8, floats = measured(exported.int8, views), measured(exported.fp32, views)
    return comparison_table(views, "INT8 vs. FP32", int8, floats, (0.5, 0.5))[1]


@pytest.mark.parametrize(
    ("tolerance", "told"),
    [
        (ANY._replace(rotation_deg=0.0), r"median rotation differs .* --tolerance 0"),
        (ANY._replace(depth_percent=0.0), r"median depth differs .* --tolerance-depth 0"),
        (ANY._replace(pose_points=-1.0), r"Pose@10°/5 % is 0 points worse .* --tolerance-pose -1"),
        (ANY._replace(sigma_percent=-200.0), r"median sigma is smaller .* --tolerance-sigma -200"),
        (ANY._replace(recall_points=-1.0), r"recall is 0 points worse .* --tolerance-recall -1"),
    ],
)
def test_int8_that_strays_is_refused_by_what_it_strays_in(strayed: Strayed, tolerance: Tolerance, told: str) -> None:
    assert strayed.refusal(ANY) is None
    assert re.match(told, str(strayed.refusal(tolerance)))


def test_an_int8_file_that_is_refused_is_not_written_and_onnx_runtime_says_nothing(
    exported: Exported, views: Views, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    floats, destination = measured(exported.fp32, views), tmp_path / "strays.onnx"
    said: list[str] = []
    with pytest.raises(ConfigError, match=r"strays\.onnx: not written: median rotation differs .* --tolerance 0"):
        write_int8(
            exported.fp32,
            destination,
            read_contract(exported.fp32),
            views,
            views,
            floats,
            ANY._replace(rotation_deg=0.0),
            said.append,
        )
    assert list(tmp_path.iterdir()) == []
    assert said[:2] == ["quantising: 32 of 32 windows", "correcting biases: 32 of 32 windows"]
    assert "onnxruntime" not in capfd.readouterr().err


def test_of_two_exports_into_one_folder_at_the_same_time_neither_uses_a_file_of_the_other(
    exported: Exported, views: Views, tmp_path: Path
) -> None:
    other_floats = measured(exported.fp32, views)
    save_weights(tmp_path / "run" / "weights.pt", tiny.network(1), tiny.TOML, {"seed": 3, "samples": 0})
    fp32, int8 = (tmp_path / "models" / path.name for path in (exported.fp32, exported.int8))

    def meanwhile(text: str) -> None:
        if "FP32 vs. PyTorch" in text:
            shutil.copyfile(exported.fp32, fp32)
        if text == "evaluating INT8: 32 of 32 windows":
            write_int8(
                exported.fp32, int8, read_contract(exported.fp32), views, views, other_floats, ANY, lambda _: None
            )

    export_models(tmp_path / "run", tmp_path / "models", samples=16, tolerance=ANY, open_view=open_view, say=meanwhile)
    assert set((tmp_path / "models").iterdir()) == {fp32, int8}
    network, *_, sha256 = load_model(tmp_path / "run")
    assert read_contract(int8).weights_sha256 == sha256 != read_contract(fp32).weights_sha256
    image, K = inputs(2, 96, 96)
    with torch.no_grad():
        t_m = network(torch.from_numpy(image), torch.from_numpy(K))[OUTPUT_NAMES.index("t_cam_target_m")][:, 0]
    Z_m, other_Z_m = (onnx_predictor(path)(image, K).t_cam_target_m[:, 2] for path in (int8, fp32))
    assert np.all(np.abs(Z_m - t_m[:, 2].numpy()) < np.abs(other_Z_m - t_m[:, 2].numpy()) / 3)


def test_a_file_that_detects_nothing_is_refused_however_right_its_highest_peaks_are() -> None:
    """Here half of the targets, of one stage, are below the threshold."""
    batch = windows(1, 64)
    on = batch.present
    nothing = np.zeros((len(on), 6), np.float32)
    labels = batch.center_px, batch.size_px, batch.center_px, batch.t_cam_target_m, batch.R_cam_target
    right = Predictions(np.where(on, 0.8, 0.2).astype(np.float32), *labels, nothing + 1.0)
    half = right._replace(score=np.where(np.cumsum(on) <= on.sum() // 2, right.score, 0.2 * right.score))
    views = Views([batch], [batch])
    for other, lost_points in ((right, 0.0), (half, 100.0 * (1 - on.sum() // 2 / on.sum()))):
        for int8 in (Measured(other, right), Measured(right, other)):
            table, strayed = comparison_table(views, "INT8 vs. FP32", int8, Measured(right, right), (0.5, 0.5))
            assert strayed.recall_points == pytest.approx(lost_points)
            assert (strayed.refusal(Tolerance()) is None) == (other is right)
            assert f"{100.0 - lost_points:9.1f} /  100.0" in table


def test_a_contract_that_contradicts_how_the_network_was_trained_is_refused(exported: Exported, tmp_path: Path) -> None:
    """Its acquire stage would be given squashed frames, of which training showed none."""
    contract = tiny.config().contract.model_copy(update={"acquire_fit": "squash", "acquire_size_wh": (64, 64)})
    for export in (export_models, export_unmeasured):
        with pytest.raises(ConfigError, match=r"--config: its \[contract\] contradicts .*: data\.acquire_view"):
            export(exported.run, tmp_path / "out", contract=contract)
    other = tiny.config().contract.model_copy(update={"name": "another"})
    assert export_unmeasured(exported.run, tmp_path, contract=other).name == "another-unmeasured-fp32.onnx"


def test_an_answer_that_is_no_number_is_refused() -> None:
    assert Strayed(float("nan")).refusal(ANY) is not None
    assert Strayed(1.0, 1.0, -3.0, -4.0).refusal(Tolerance()) is None


def test_files_are_compared_on_windows_with_a_target_only() -> None:
    px, R = np.zeros((4, 2), np.float32), np.repeat(np.eye(3, dtype=np.float32)[None], 4, 0)
    one = Predictions(np.full(4, 0.5, np.float32), px, px, px, R[:, 2], R, np.ones((4, 6), np.float32))
    other = one._replace(score=np.array([0.5, 0.5, 0.9, 0.9], np.float32))
    present = np.array([True, True, False, False])
    assert set(difference(one, other, present).values()) == {0.0}
    assert difference(one, other, ~present)["score_median"] == pytest.approx(0.4)


def test_sigmas_that_are_told_too_small_are_found_whichever_of_the_six() -> None:
    rng = np.random.default_rng(6)
    sure = Predictions(*[np.zeros(1, np.float32)] * 6, rng.uniform(0.1, 1.0, (40, 6)).astype(np.float32))
    told = sure.sigma * np.array([1.3, 1.0, 0.8, 1.1, 1.0, 1.0], np.float32)
    told[::4] *= 0.01  # now and then far off: a median does not mind
    present = np.arange(40) < 36
    told[~present] = 0.0
    assert sigma_shortfall(sure._replace(sigma=told), sure, present) == pytest.approx(0.2, abs=1e-5)
    assert sigma_shortfall(sure, sure, present) == pytest.approx(0.0, abs=1e-6)


def test_evaluation_measures_the_windows_of_its_seed(exported: Exported) -> None:
    request = Request(exported.fp32, samples=16, seed=77, stage="track")
    got = evaluate_file(request, open_view=open_view)
    batches = [windows(77, 64)]
    threshold = read_contract(exported.fp32).track_score_min
    expected = measure(predict_all(onnx_predictor(exported.fp32), batches), batches, threshold)
    expected |= {"size_px": 64.0, "score_min": threshold, **constant_guess(batches)}
    assert got == pytest.approx(expected, nan_ok=True)
    with pytest.raises(ConfigError, match="was used in training"):
        evaluate_file(request._replace(seed=3), open_view=open_view)


def test_the_constant_guess_lies_midway() -> None:
    """Headings of -30, 0 and 30 degrees at 100, 200 and 800 m: the middle one errs by 20 degrees and 7/12."""
    batch = windows(5, 64)
    on = np.zeros(len(batch.present), dtype=bool)
    on[:3] = True
    R, t = batch.R_cam_target.copy(), batch.t_cam_target_m.copy()
    R[:3] = R_from_euler(0.4, -0.7, 1.1) @ R_from_euler(0.0, 0.0, np.deg2rad([-30.0, 0.0, 30.0]))
    t[:3, 2] = [100.0, 200.0, 800.0]
    got = constant_guess([batch._replace(present=on, R_cam_target=R, t_cam_target_m=t)])
    assert got == pytest.approx({"constant_E_r_mean_deg": 20.0, "constant_depth_rel_mean": 7 / 12}, abs=1e-4)


def test_windows_are_measured_on_alike_whatever_was_trained_on() -> None:
    data = tiny.config().data
    shares = {"empty_share": 0.0, "invented_share": 0.0}, {"empty_share": 0.4, "invented_share": 0.9}
    drawn = [stage_sampler(data.model_copy(update=s), 5, 64, 0.0)().batch(0, 40) for s in shares]
    np.testing.assert_array_equal(drawn[0].image_bgr, drawn[1].image_bgr)
    assert 20 < drawn[0].present.sum() < 40


def test_hard_airframes_are_drawn_twice_as_often_in_training_but_not_in_what_is_judged_by() -> None:
    data = tiny.config().data.model_copy(update={"airframe_ids": [3, 6], "hard_airframe_ids": [6], "empty_share": 0.0})
    trained, judged = (window_sampler(data, 5, 64, held_out)().batch(0, 300) for held_out in (False, True))
    shares = [np.mean(batch.airframe_id[batch.present] == 6) for batch in (trained, judged)]
    assert shares == pytest.approx([2 / 3, 1 / 2], abs=0.08)


def test_weights_are_exported_without_the_flights_that_they_were_trained_on() -> None:
    data = tiny.config().data
    flown = data.model_copy(update={"flown": [Path("/no/longer/there")], "flown_share": 0.5})
    with pytest.raises(ConfigError, match="/no/longer/there"):
        window_sampler(flown, 5, 64)()
    calibration = [stage_sampler(one, 5, 64, 0.0, held_out=False)().batch(0, 8) for one in (data, flown)]
    np.testing.assert_array_equal(calibration[0].image_bgr, calibration[1].image_bgr)


def test_where_every_window_holds_a_target_the_threshold_is_the_usual_one(exported: Exported) -> None:
    batch = windows(1, 64)
    predicted = predict_all(onnx_predictor(exported.fp32), [batch])
    assert choose_threshold(predicted, [batch._replace(present=np.ones_like(batch.present))]) == SCORE_THRESHOLD


def test_the_threshold_lies_between_targets_and_the_rest(exported: Exported) -> None:
    batch = windows(1, 64)
    score = np.where(batch.present, 0.8, 0.2).astype(np.float32)
    predicted = predict_all(onnx_predictor(exported.fp32), [batch])._replace(score=score)
    assert choose_threshold(predicted, [batch]) == pytest.approx(0.505, abs=0.01)
