"""`uavpose-trainer evaluate --windows`: each stage on its own windows, by the file's own threshold and calibration."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import tiny
import torch
from synthetic_sampler import PlateSampler

from msgs.contract import ScoreCalibration
from trainer.checkpoint import save_weights
from trainer.config import ConfigError, DataConfig
from trainer.data import TrainingBatch, training_batch
from trainer.evaluate import SCORE_THRESHOLD, calibrated, constant_guess, measure, predict_all
from trainer.export import export_unmeasured, stage_sampler
from trainer.graph import onnx_predictor, read_contract, write_contract
from trainer.held_out import Request, evaluate_file

SEED = 78  # of windows with and without a target at either size
TRAINING = {"seed": 3, "refined_seed": 11, "presence_seed": 12, "samples": 0, "commit": "unknown"}
# The network has learnt nothing: its peaks of 0.011 become 0.63 below the one threshold, and 0.1 above the other.
TRACK = ScoreCalibration(offset=5.0)
ACQUIRE = ScoreCalibration(offset=-1.0, slope=0.5, size_slope=0.3, size_cap_px=50.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("held-out")
    save_weights(folder / "run" / "weights.pt", tiny.network(), tiny.TOML, TRAINING)
    return folder / "run"


@pytest.fixture(scope="module")
def model(run: Path) -> Path:
    path = export_unmeasured(run, run.parent)
    said = {"track_score_min": 0.9, "acquire_score_min": 0.05, "track_score": TRACK, "acquire_score": ACQUIRE}
    write_contract(path, read_contract(path).model_copy(update=said))
    return path


def plates(seed: int, size_px: int) -> TrainingBatch:
    return training_batch(PlateSampler(seed, size_px, empty_share=0.3).batch(0, 16))


class Opened:
    """Opens plates for whatever is asked, and keeps that."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int, float]] = []

    def __call__(self, seed: int, size_px: int, acquire_share: float) -> Callable[[], PlateSampler]:
        self.asked.append((seed, size_px, acquire_share))
        return partial(PlateSampler, seed, size_px, empty_share=0.3)


@pytest.mark.parametrize(
    ("stage", "given_px", "size_px", "share", "law", "score_min"),
    [
        ("track", None, 64, 0.0, TRACK, 0.9),
        ("acquire", None, 96, 1.0, ACQUIRE, 0.05),
        ("acquire", 64, 64, 1.0, ACQUIRE, 0.05),
        ("track", 96, 96, 0.0, TRACK, 0.9),
    ],
)
def test_a_model_file_is_measured_as_its_stage_is_flown(
    model: Path, stage: str, given_px: int | None, size_px: int, share: float, law: ScoreCalibration, score_min: float
) -> None:
    opened, batches = Opened(), [plates(SEED, size_px)]
    got = evaluate_file(Request(model, 16, SEED, stage, given_px), open_view=opened)  # type: ignore[arg-type]
    assert opened.asked == [(SEED, size_px, share)]
    expected = measure(calibrated(predict_all(onnx_predictor(model), batches), law), batches, score_min)
    assert got == pytest.approx({**expected, **constant_guess(batches), "size_px": size_px, "score_min": score_min})
    assert got["false_alarms"] == (0.0 if stage == "track" else 1.0)


def test_a_checkpoint_is_measured_by_its_peaks_and_the_usual_threshold(run: Path, model: Path) -> None:
    for stage, size_px in (("track", 64), ("acquire", 96)):
        batches = [plates(SEED, size_px)]
        got = evaluate_file(Request(run, 16, SEED, stage), open_view=Opened())  # type: ignore[arg-type]
        expected = measure(predict_all(onnx_predictor(model), batches), batches, SCORE_THRESHOLD)
        expected |= {"size_px": size_px, "score_min": SCORE_THRESHOLD}
        assert got == pytest.approx({**expected, **constant_guess(batches)}, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize(("fit", "view"), [("squash", "frame"), ("letterbox", "crop")])
def test_windows_of_a_model_file_show_its_aircraft_as_it_is_shown_whole_frames(
    model: Path, tmp_path: Path, fit: str, view: str
) -> None:
    """The labels tell: those of other aircraft, or of the other view, have another best guess."""
    path = tmp_path / "one.onnx"
    path.write_bytes(model.read_bytes())
    contract = read_contract(path)
    names = contract.airframes[2:4]
    write_contract(path, contract.model_copy(update={"acquire_fit": fit, "airframes": [*names, "of another program"]}))
    from sim_replay.airframes import AIRFRAMES

    ids = [[airframe.name for airframe in AIRFRAMES].index(name) for name in names]
    data = DataConfig(seed=1, validation_seed=2, batch_size=16, airframe_ids=ids, acquire_view=view)
    batch = training_batch(stage_sampler(data, SEED, 96, 1.0)().batch(0, 16))
    assert set(batch.airframe_id[batch.present].tolist()) == set(ids)
    got = evaluate_file(Request(path, 16, SEED, "acquire"))
    assert {name: got[name] for name in constant_guess([batch])} == pytest.approx(constant_guess([batch]))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"seed": 3}, "--seed 3: was used in training"),
        ({"seed": 11}, "--seed 11: was used in training"),
        ({"seed": 12}, "--seed 12: was used in training"),
        ({"size_px": 48}, "--size 48: must be a multiple of 32"),
        ({"size_px": 16}, "--size 16: must be a multiple of 32"),
        ({"samples": 15}, "--windows 15: must be at least 16"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is_rendered(
    model: Path, run: Path, changed: dict[str, int], told: str
) -> None:
    for path in (model, run):
        opened = Opened()
        with pytest.raises(ConfigError, match=told):
            evaluate_file(Request(path, 16, SEED, "track")._replace(**changed), open_view=opened)
        assert opened.asked == []


def test_the_smallest_windows_are_of_one_stride_of_the_network(run: Path) -> None:
    torch.set_num_threads(1)
    got = evaluate_file(Request(run, 16, SEED, "track", 32), open_view=Opened())
    assert got["size_px"] == 32.0
