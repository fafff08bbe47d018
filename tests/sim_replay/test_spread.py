"""How far a rate may be from the truth, by flights and not by frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from sim_replay.bop import BopScene
from sim_replay.datasets import DatasetFrame
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.evaluation.spread import intervals_95
from sim_replay.score import Match, TargetPose, Truth

T_CAM_TARGET_M = np.array([4.0, -3.0, 300.0])


def flights(turned_deg: Sequence[Sequence[float | None]]) -> list[JudgedFrame]:
    """Frames of flights, each with one target that is found turned by so much, or not at all."""
    judged: list[JudgedFrame] = []
    for number, of_flight in enumerate(turned_deg):
        scene = BopScene(Path("all"), number)
        for angle_deg in of_flight:
            truth = Truth(len(judged), np.eye(3), T_CAM_TARGET_M, 4, 10.0)
            estimate = None
            if angle_deg is not None:
                R = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
                estimate = TargetPose(len(judged), R, T_CAM_TARGET_M)
            picture = DatasetFrame(number, len(judged), np.eye(3), None, Path("none.jpg"), (), scene, ())
            judged.append(JudgedFrame(picture, (Match(truth, estimate),), (), None))
    return judged


def test_flights_that_are_right_or_wrong_throughout_vary_as_so_many_draws_and_not_as_their_frames() -> None:
    found = intervals_95(flights([[0.0] * 25] * 30 + [[90.0] * 25] * 10))
    assert found is not None
    by_flights = stats.binom.ppf([0.025, 0.975], 40, 0.75) / 40
    assert found["pose_10deg_5pct"] == pytest.approx(tuple(by_flights), abs=1.01 / 40)


@pytest.mark.parametrize("flown", [6, 30])
def test_no_failure_in_any_flight_and_no_success_are_no_certainty(flown: int) -> None:
    """However many frames the flights have, their number alone tells how often others may fail."""
    found = intervals_95(flights([[90.0] * 25] * flown))
    assert found is not None
    always = stats.binomtest(flown, flown).proportion_ci(0.95, method="exact")
    never = stats.binomtest(0, flown).proportion_ci(0.95, method="exact")
    assert found["recall"] == found["depth_5pct"] == pytest.approx((always.low, 1.0), abs=1e-4)
    assert found["rot_10deg"] == found["pose_10deg_5pct"] == pytest.approx((0.0, never.high), abs=1e-4)


def test_a_miss_makes_nobody_surer_and_few_flights_with_one_are_as_many_draws() -> None:
    """Of 30 flights of ten frames with a single miss a resample promises 99 %, while none at all promises 88 %."""
    single = intervals_95(flights([[None, *[0.0] * 9], *[[0.0] * 10] * 29]))
    none = intervals_95(flights([[0.0] * 10] * 30))
    assert single is not None
    assert none is not None
    assert single["recall"][0] < none["recall"][0]
    single_hit = intervals_95(flights([[0.0, *[90.0] * 9], *[[90.0] * 10] * 29]))
    never = intervals_95(flights([[90.0] * 10] * 30))
    assert single_hit is not None
    assert never is not None
    assert single_hit["rot_10deg"][1] > never["rot_10deg"][1]
    whole = intervals_95(flights([*[[None] * 10] * 5, *[[0.0] * 10] * 25]))
    assert whole is not None
    assert whole["recall"][0] == pytest.approx(stats.binomtest(25, 30).proportion_ci(0.95, "exact").low, abs=1e-4)


def test_flights_of_unequal_length_agree_with_scipys_bootstrap() -> None:
    rng = np.random.default_rng(5)
    lengths = rng.integers(2, 40, 30)
    shares = rng.uniform(0.3, 1.0, 30)
    wrong: tuple[float | None, float] = (None, 170.0)
    drawn = [
        [0.0 if rng.random() < share else wrong[rng.integers(2)] for _ in range(length)]
        for share, length in zip(shares, lengths, strict=True)
    ]
    found = intervals_95(flights(drawn))
    assert found is not None
    right = np.array([sum(angle == 0.0 for angle in one) for one in drawn])
    oracle = stats.bootstrap(
        (right, lengths),
        lambda r, n, axis: r.sum(axis=axis) / n.sum(axis=axis),
        paired=True,
        n_resamples=4000,
        method="percentile",
        rng=1,
    ).confidence_interval
    assert found["pose_10deg_5pct"] == pytest.approx((oracle.low, oracle.high), abs=0.01)


def test_few_flights_tell_nothing_of_others_nor_does_an_empty_sky() -> None:
    """Intervals of three flights would miss the rate of many in three of ten cases."""
    six = flights([[0.0] * 5, [90.0] * 5, *[[0.0] * 5] * 4])
    empty = replace(six[-1], matches=(), picture=replace(six[-1].picture, scene=BopScene(Path("all"), 9)))
    assert intervals_95([*six[:25], empty]) is None
    assert intervals_95([]) is None
    found = intervals_95([*six, empty])
    assert found is not None
    low = stats.binomtest(5, 6).proportion_ci(0.95, "exact").low
    assert found["pose_10deg_5pct"] == pytest.approx((low, 1.0), abs=1e-4)
