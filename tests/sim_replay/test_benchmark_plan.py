"""From preset and seed to sequence plans: sizes, disjoint splits, even ranges, lenses; bad presets are named."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import trainer
from edge.errors import InputError
from sim_replay.airframes import AIRFRAMES, airframe_id, airframe_of
from sim_replay.airframes.invented import KEPT_BACK_VARIANTS, TRAINING_VARIANTS, draw_invented
from sim_replay.benchmark.plan import SequencePlan, allotted, cut_frames, plan_dataset, spread_ranges
from sim_replay.benchmark.preset import RANGE_LIMITS_M, held_out_airframes, load_preset, parse_preset
from sim_replay.flight import EncounterPlan, fly_encounter

MINIMAL = """
name = "mine"
[splits]
test = { sequences = 3, frames = 30 }
[picture]
weather = { clear = 1 }
quality = { ordinary = 1 }
"""


@pytest.fixture(scope="module", params=[0, 7])
def paper_plan(request: pytest.FixtureRequest) -> tuple[SequencePlan, ...]:
    return plan_dataset(load_preset("fw-uav6d"), request.param)


def _frames(plans: tuple[SequencePlan, ...]) -> np.ndarray:
    return np.array([plan.frames for plan in plans])


def test_it_has_the_papers_size(paper_plan: tuple[SequencePlan, ...]) -> None:
    assert len(paper_plan) == 161
    frames: Counter[str] = Counter()
    for plan in paper_plan:
        frames[plan.split] += plan.frames
    assert frames == {"train": 8425, "val": 2400, "test": 4500}
    assert [plan.index for plan in paper_plan] == list(range(161))


def test_no_two_splits_share_an_airframe_in_a_flight(paper_plan: tuple[SequencePlan, ...]) -> None:
    pairs = {split: {(p.airframes[0], p.flight_seed) for p in paper_plan if p.split == split} for split in
             ("train", "val", "test")}  # fmt: skip
    assert not pairs["train"] & pairs["val"]
    assert not pairs["train"] & pairs["test"]
    assert not pairs["val"] & pairs["test"]
    for split in pairs:
        assert {name for name, _ in pairs[split]} == set(load_preset("fw-uav6d").airframe_names())


def test_ranges_fill_every_split_evenly(paper_plan: tuple[SequencePlan, ...]) -> None:
    for split in ("train", "val", "test"):
        chosen = tuple(plan for plan in paper_plan if plan.split == split)
        share, _ = np.histogram([p.range_m for p in chosen], bins=4, range=(100, 500), weights=_frames(chosen))
        np.testing.assert_allclose(share / _frames(chosen).sum(), 0.25, atol=0.05)


def test_lenses_are_those_there_are_and_show_the_planned_size(paper_plan: tuple[SequencePlan, ...]) -> None:
    focal = np.array([plan.focal_px for plan in paper_plan])
    assert focal.min() >= 1200
    assert focal.max() <= 8000
    assert len(np.unique(focal)) > 150
    share = np.array([plan.box_share for plan in paper_plan])
    assert np.average(share, weights=_frames(paper_plan)) == pytest.approx(0.012, abs=1e-5)


def test_the_same_seed_plans_the_same_and_another_does_not() -> None:
    preset = load_preset("stress")
    assert plan_dataset(preset, 3) == plan_dataset(preset, 3)
    assert plan_dataset(preset, 3) != plan_dataset(preset, 4)


def test_held_out_airframes_are_in_no_training_preset(paper_plan: tuple[SequencePlan, ...]) -> None:
    held_out = set(held_out_airframes())
    assert len(held_out) >= 3
    assert not held_out & {name for plan in paper_plan for name in plan.airframes}
    unseen = plan_dataset(load_preset("unseen"), 0)
    assert {name for plan in unseen for name in plan.airframes} == held_out


def test_the_shipped_training_leaves_out_what_is_held_out() -> None:
    config = Path(trainer.__file__).parent / "configs" / "edge.toml"
    trained_on = tomllib.loads(config.read_text())["data"]["airframe_ids"]
    assert {AIRFRAMES[k].name for k in trained_on} == {a.name for a in AIRFRAMES} - set(held_out_airframes())


def test_the_strangers_to_judge_by_are_of_no_training_and_of_no_part_of_what_is_held_out() -> None:
    preset = load_preset(str(Path(trainer.__file__).parent / "configs" / "strangers.toml"))
    shown = {name for plan in plan_dataset(preset, 0) for name in plan.airframes}
    assert shown == set(preset.airframe_names())
    assert len(shown) == 24
    rng = np.random.default_rng(0)
    drawn = {
        draw_invented(rng, range(len(AIRFRAMES)), variants)
        for variants in (TRAINING_VARIANTS, KEPT_BACK_VARIANTS)
        for _ in range(4000)
    }
    assert not drawn & {airframe_id(name) for name in shown}
    words = " ".join(airframe_of(airframe_id(name)).description for name in shown)
    assert not [name for name in held_out_airframes() if name in words]


def test_stress_has_empty_skies_company_and_every_hardship() -> None:
    plans = plan_dataset(load_preset("stress"), 1)
    empty = sum(plan.frames for plan in plans if plan.shown == 0)
    assert empty >= 0.15 * _frames(plans).sum()
    assert {plan.shown for plan in plans} == {0, 1, 2, 3}
    assert {"fog", "dusk", "glare", "broken_cloud"} <= {plan.weather for plan in plans}
    assert any(plan.h264_kbps for plan in plans)
    assert min(plan.jpeg_quality for plan in plans) < 35
    assert any(plan.leaves for plan in plans)
    assert all(plan.distractors >= 1 for plan in plans)
    for plan in plans:
        assert len(plan.airframes) == len(plan.livery_seeds) == max(plan.shown, 1)


@given(data=st.data(), count=st.integers(1, 40), shortest=st.integers(2, 50), room=st.integers(0, 100))
@settings(deadline=None, max_examples=60)
def test_lengths_add_up_within_their_bounds(data: st.DataObject, count: int, shortest: int, room: int) -> None:
    total = data.draw(st.integers(count * shortest, count * (shortest + room)))
    lengths = cut_frames(np.random.default_rng(total), total, count, shortest, shortest + room)
    assert len(lengths) == count
    assert sum(lengths) == total
    assert min(lengths) >= shortest
    assert max(lengths) <= shortest + room


@given(weights=st.lists(st.floats(0, 5), min_size=1, max_size=6), count=st.integers(1, 60), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=60)
def test_weights_are_kept_to_within_one(weights: list[float], count: int, seed: int) -> None:
    table = dict(enumerate(weights))
    if sum(weights) <= 1e-6:
        return
    drawn = Counter(allotted(np.random.default_rng(seed), table, count))
    assert drawn.total() == count
    for name, weight in table.items():
        assert abs(drawn[name] - count * weight / sum(weights)) <= 1.0 + 1e-6


def test_ranges_of_equal_sequences_are_equally_spaced() -> None:
    ranges = spread_ranges(np.random.default_rng(5), [10] * 4, (100.0, 500.0))
    assert sorted(ranges) == [150.0, 250.0, 350.0, 450.0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "mine"', 'name = "mine"\ncolour = 1', r"mine\.toml: colour: unknown key"),
        ("clear = 1", "rain = 1", r"mine\.toml: picture\.weather\.rain: .*'clear'"),
        ("frames = 30", "frames = 3000", r"mine\.toml: .*splits\.test: 3000 frames cannot be cut into 3"),
        ('name = "mine"', "", r"mine\.toml: name: is missing"),
        ("[picture]", "[airframes]\nonly = ['zeppelin']\n[picture]", r"airframes: only: .*'zeppelin'; there are male"),
        (
            "[picture]",
            "[airframes]\nonly = ['glider']\ninvented = 5\n[picture]",
            r"mine\.toml: there are no 5 invented aircraft of so few parts, but 4",
        ),
        ("[picture]", "[picture", r"mine\.toml: not valid TOML"),
        ("clear = 1", "clear = -1", r"picture\.weather\.clear: must be at least 0"),
        (
            'name = "mine"',
            'name = "mine"\nrange_m = [50.0, 300.0]',
            r"mine\.toml: range_m must lie within 95 and 510 m",
        ),
        ('name = "mine"', 'name = "mine"\nrange_m = [100, 900]', r"mine\.toml: range_m must lie within 95 and 510 m"),
        ("[picture]", "[[compression]]\nh264_kbps = [100, 200]\n[picture]", r"size_wh_px must be even where"),
        (
            "[picture]",
            "[picture]\nexposure_ms = [1, 40]",
            r"exposure_ms must not exceed a frame's 33\.3333 ms at fps 30",
        ),
    ],
)
def test_a_bad_preset_is_named_with_its_key(old: str, new: str, said: str) -> None:
    text = "sequence_frames = [5, 15]\nsize_wh_px = [321, 200]\n" + MINIMAL
    assert parse_preset("mine.toml", text).name == "mine"
    with pytest.raises(InputError, match=said):
        parse_preset("mine.toml", text.replace(old, new, 1))


def test_the_ranges_that_a_preset_may_ask_for_are_those_that_are_flown() -> None:
    low_m, high_m = RANGE_LIMITS_M
    for range_m in (low_m - 0.1, high_m + 0.1):
        with pytest.raises(ValueError, match=f"range_m must lie between {low_m:.0f} and {high_m:.0f}"):
            fly_encounter(EncounterPlan(1, 5, 10.0, range_m, ("light_aircraft",), (0.3, 0.2)))


def test_a_preset_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no preset is called 'fw-uav'; there are fw-uav6d, unseen, stress"):
        load_preset("fw-uav")
    with pytest.raises(InputError, match=r"absent\.toml: cannot be read"):
        load_preset(str(tmp_path / "absent.toml"))
