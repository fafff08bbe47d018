"""What a model file may say of itself: numbers that are finite, inputs that have a size."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from msgs.contract import ModelContract, ScoreCalibration

WHOLE: dict[str, Any] = {
    "name": "toy", "configuration": "edge", "backbone": "none", "precision": "fp32", "max_peaks": 1,
    "acquire_size_wh": (640, 384), "acquire_fit": "squash", "track_size_wh": (256, 256), "track_window_scale": 1.8,
    "acquire_score_min": 0.5, "track_score_min": 0.5, "trained_range_m": (50.0, 600.0),
    "trained_focal_px": (500.0, 9000.0), "trained_box_px": (8.0, 256.0), "airframes": ["toy"], "training": {},
    "metrics": {}, "weights_sha256": "0" * 64,
}  # fmt: skip
NAN, INF = float("nan"), float("inf")


def test_a_whole_contract_is_read() -> None:
    assert ModelContract.model_validate(WHOLE).track_size_wh == (256, 256)
    assert ModelContract.model_validate(WHOLE | {"track_size_wh": None}).track_size_wh is None


def test_scores_are_calibrated_once_the_stage_that_tells_tracks_is() -> None:
    fitted = {"offset": -1.0, "slope": 2.0}
    assert not ModelContract.model_validate(WHOLE).scores_calibrated
    assert not ModelContract.model_validate(WHOLE | {"acquire_score": fitted}).scores_calibrated
    assert ModelContract.model_validate(WHOLE | {"track_score": fitted}).scores_calibrated
    assert ModelContract.model_validate(WHOLE | {"track_size_wh": None, "acquire_score": fitted}).scores_calibrated


def test_a_score_becomes_a_probability_by_its_odds_and_by_the_size_shown() -> None:
    """Odds of 9 to 1 to the power of 0.5, times e, over the square root of the size: 3 e / 4 at 16 px."""
    fitted = ScoreCalibration(offset=1.0, slope=0.5, size_slope=-0.5, size_cap_px=100.0)
    assert fitted.probability(0.9, 16.0) == pytest.approx(1.0 / (1.0 + 4.0 / (3.0 * math.e)))
    assert fitted.probability(0.9, 100.0) == fitted.probability(0.9, 400.0) < fitted.probability(0.9, 99.0)
    assert fitted.probability(0.9, 0.0) == fitted.probability(0.9, 1.0) > fitted.probability(0.9, 1.1)
    assert 0.0 < fitted.probability(0.0, 16.0) < 0.01
    assert 0.99 < fitted.probability(1.0, 16.0) < 1.0
    for score, shown_px in ((NAN, 16.0), (INF, 16.0), (0.9, NAN), (0.9, INF)):
        assert fitted.probability(score, shown_px) == 0.0


def test_a_model_of_one_fixed_camera_has_one_focal_length() -> None:
    one = ModelContract.model_validate(WHOLE | {"trained_focal_px": (700.0, 700.0)})
    assert one.trained_focal_px == (700.0, 700.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"acquire_size_wh": (0, 384)},
        {"track_size_wh": (256, -256)},
        {"track_window_scale": INF},
        {"depth_limits_m": (NAN, 600.0)},
        {"trained_range_m": (50.0, INF)},
        {"trained_range_m": (600.0, 50.0)},
        {"trained_range_m": (0.0, 600.0)},
        {"trained_box_px": (0.0, 0.0)},
        {"trained_box_px": (200.0, 200.0)},
        {"trained_focal_px": (9000.0, 500.0)},
        {"trained_focal_px": (0.0, 0.0)},
        {"depth_limits_m": (-50.0, 600.0)},
        {"pixel_mean_bgr": (NAN, 0.0, 0.0)},
        {"metrics": {"recall": NAN}},
        {"training": {"seconds": INF}},
        {"acquire_score": {"offset": NAN}},
        {"track_score": {"slope": INF}},
    ],
)
def test_a_number_that_is_none_or_a_span_that_holds_none_is_refused_by_its_key(wrong: dict[str, Any]) -> None:
    (key,) = wrong
    with pytest.raises(ValidationError) as error:
        ModelContract.model_validate(WHOLE | wrong)
    assert {fault["loc"][0] for fault in error.value.errors()} == {key}
