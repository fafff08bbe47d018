"""Evaluation of a model that is known on sequences: every frame is tracked, and every n-th is scored."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from edge.config_estimator import EstimatorSettings
from edge.estimator.estimator import Estimator
from tests.sim_replay.conftest import dark_spot_model
from tests.sim_replay.test_tracked import flown, write_scene
from trainer.cli import main
from trainer.config import ConfigError
from trainer.evaluate_dataset import DatasetRequest, Evaluation, evaluate_dataset

__all__ = ["dark_spot_model"]


@pytest.fixture(scope="module")
def spots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven frames of a camera that turns, with a target that a track tells from the third on."""
    root = tmp_path_factory.mktemp("spots")
    write_scene(root / "test" / "000004", [0.5 + 0.4 * k for k in range(7)])
    (root / "test" / "000004" / "sequence.toml").write_text("fps = 30.0\n")
    return root


def estimates(evaluation: Evaluation) -> dict[int, np.ndarray | None]:
    found = {frame.picture.image_id: frame.matches[0].estimate for frame in evaluation.judged}
    return {image: None if one is None else one.t_cam_target_m for image, one in found.items()}


def test_the_tracker_sees_all_frames_of_which_every_third_is_scored(spots: Path, dark_spot_model: Path) -> None:
    request, counts = DatasetRequest(dark_spot_model, dataset=spots, every=3), list[int]()
    track = evaluate_dataset(request._replace(mode="track", own_ship="exact"), on_start=counts.append)
    frames = evaluate_dataset(request, on_start=counts.append)
    assert counts == [7, 3]
    assert {image: one is not None for image, one in estimates(track).items()} == {0: False, 3: True, 6: True}
    assert {image: one is not None for image, one in estimates(frames).items()} == {0: True, 3: True, 6: True}
    assert [(e.score["mode"], e.score["every"], e.score["own_ship"]) for e in (track, frames)] == [
        ("track", 3, "exact"),
        ("frames", 3, None),
    ]
    assert (track.score["overall"]["recall"], frames.score["overall"]["recall"]) == (pytest.approx(2 / 3), 1.0)
    assert track.method == frames.method == "dark-spot"


def test_the_tracker_is_told_the_own_ship_s_pose_as_well_as_asked(spots: Path, dark_spot_model: Path) -> None:
    request = DatasetRequest(dark_spot_model, dataset=spots, mode="track")
    exact, usual = (evaluate_dataset(request._replace(own_ship=told)) for told in ("exact", "usual"))
    for image, frame in enumerate(flown(spots, dark_spot_model)):
        one, expected = estimates(exact)[image], frame.matches[0].estimate
        assert (one is None) == (expected is None)
        if expected is not None:
            np.testing.assert_allclose(one, expected.t_cam_target_m, atol=1e-9)
    assert not np.allclose(estimates(usual)[6], estimates(exact)[6], atol=1e-6)


def test_a_threshold_may_be_given_for_the_files_own(spots: Path, dark_spot_model: Path) -> None:
    """No peak is as certain as 1."""
    request = DatasetRequest(dark_spot_model, dataset=spots, every=6)
    for score_min, recall in ((None, 1.0), (0.9, 1.0), (1.0, 0.0)):
        score = evaluate_dataset(request._replace(score_min=score_min)).score
        assert score["overall"]["recall"] == recall
    with pytest.raises(ConfigError, match=r"the score threshold 1\.5 is not between 0 and 1"):
        evaluate_dataset(request._replace(score_min=1.5))
    with pytest.raises(ConfigError, match="--score-min: needs a model"):
        evaluate_dataset(request._replace(results=spots / "any.csv", score_min=0.5))


def test_the_size_of_a_scene_s_aircraft_may_be_given(spots: Path, dark_spot_model: Path) -> None:
    """The spot is 12 m long and wide to its network, which knows that it is 200 m away; a larger one is farther."""
    (spots / "models").mkdir(exist_ok=True)
    box = {"min_x": -9e3, "min_y": -9e3, "min_z": -1e3, "size_x": 14e3, "size_y": 14e3, "size_z": 2e3}
    (spots / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 20e3, **box}}))
    for mode in ("frames", "track"):
        request = DatasetRequest(dark_spot_model, dataset=spots, mode=mode, own_ship="exact")
        without, sized = (evaluate_dataset(request._replace(size_given=given)) for given in (False, True))
        assert [one.score["size_given"] for one in (without, sized)] == [False, True]
        for image, t_m in estimates(without).items():
            larger = estimates(sized)[image]
            assert (t_m is None) == (larger is None)
            if t_m is not None:
                assert np.linalg.norm(larger) > np.linalg.norm(t_m) + 2.0
    with pytest.raises(ConfigError, match="--size-given: needs a model"):
        evaluate_dataset(request._replace(mode="frames", results=spots / "any.csv", size_given=True))


def test_a_search_for_further_targets_that_fails_ends_the_evaluation(
    tmp_path: Path, dark_spot_model: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In flight it is passed over; figures without it are not those of what flies."""
    write_scene(tmp_path / "data" / "test" / "000004", [0.5] * (EstimatorSettings().acquire_every_n + 1))

    def out_of_memory(*_: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Estimator, "anywhere", out_of_memory)
    given = ["--dataset", str(tmp_path / "data"), "--model", str(dark_spot_model), "--out", str(tmp_path / "out")]
    assert main(["evaluate", "--mode", "track", *given]) == 2
    last = capfd.readouterr().err.splitlines()[-1]
    assert re.fullmatch(r"uavpose-trainer: .*000004: the search for further targets in image \d+ failed", last)
    assert not (tmp_path / "out").exists()
