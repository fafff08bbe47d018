"""What golden files hold and what they let pass: differences in fields, in words that name them."""

from __future__ import annotations

import copy
import itertools
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_replay.golden.compare import POSITION, ROTATION_DEG, differences, reduced
from sim_replay.golden.run import CASES, read_golden
from sim_replay.lockstep.player import Outputs
from sim_replay.play import Recording

S = math.sqrt(0.5)
START_NS = 5_000_000_000
POSE = {
    "frame": 7,
    "t_ns": 700_000_000,
    "target": "t0",
    "rotation_known": True,
    "t_cam_target_m": [-12.0, 5.0, 200.0],
    "q_cam_target_wxyz": [S, 0.0, S, 0.0],
    "covariance": [[4.0 if row == column else 0.1 for column in range(6)] for row in range(6)],
}
STATUSTEXT = {
    "t_ns": 700_000_000,
    "message": "STATUSTEXT",
    "system": 1,
    "component": 191,
    "severity": 6,
    "text": "target 0 acquired at 200 m",
}


def held(**changed: Any) -> list[dict[str, Any]]:
    pose = {**copy.deepcopy(POSE), **changed}
    return reduced(Outputs([pose], [STATUSTEXT], Recording(0, 0, 0, "")))


def told(expected: list[dict[str, Any]], actual: list[dict[str, Any]]) -> list[str]:
    return [str(difference) for difference in differences(expected, actual)]


def test_the_same_outputs_do_not_differ_and_a_quaternion_has_two_names() -> None:
    assert told(held(), held()) == []
    assert told(held(), held(q_cam_target_wxyz=[-S, 0.0, -S, 0.0])) == []


@given(st.floats(0, 20), st.sampled_from([0, 1, 2]), st.sampled_from([-1, 1]))
def test_a_position_may_be_off_by_its_tolerance_and_no_more(off_m: float, axis: int, sign: int) -> None:
    t_m = list(POSE["t_cam_target_m"])  # type: ignore[call-overload]
    t_m[axis] += sign * off_m
    allowed_m = POSITION.allows(POSE["t_cam_target_m"])[0]  # type: ignore[arg-type]
    found = told(held(), held(t_cam_target_m=t_m))
    if off_m > allowed_m + 1e-6:
        assert len(found) == 1
        assert found[0].startswith("+0.700 s pose frame 7 t0: t_cam_target_m is ")
        assert f"{allowed_m:.4g} allowed" in found[0]
    elif off_m < allowed_m - 1e-6:
        assert found == []


@given(st.floats(0, 179))
def test_a_rotation_is_judged_by_its_angle(angle_deg: float) -> None:
    turned = math.radians(90.0 + angle_deg) / 2
    found = told(held(), held(q_cam_target_wxyz=[math.cos(turned), 0.0, math.sin(turned), 0.0]))
    if abs(angle_deg - ROTATION_DEG) > 1e-3:
        assert bool(found) == (angle_deg > ROTATION_DEG)
        assert all(f"{angle_deg:.2f}° apart" in text for text in found)


@pytest.mark.parametrize(
    "changed",
    [
        {"t_cam_target_m": [-12.0, math.nan, 200.0]},
        {"q_cam_target_wxyz": [math.nan] * 4},
        {"q_cam_target_wxyz": [5.0 * S, 0.0, 5.0 * S, 0.0]},
        {"covariance": [[math.nan] * 6] * 6},
    ],
)
def test_what_is_no_number_and_a_quaternion_that_is_no_rotation_are_differences(changed: dict[str, Any]) -> None:
    assert len(told(held(), held(**changed))) == 1


def with_std(std: list[float]) -> list[dict[str, Any]]:
    covariance = [[std[row] ** 2 if row == column else 0.0 for column in range(6)] for row in range(6)]
    return held(covariance=covariance)


@given(st.integers(0, 5), st.floats(-0.3, 0.3))
def test_each_standard_deviation_is_held_by_itself(number: int, share: float) -> None:
    """However large the depth's is."""
    std = [0.9, 0.12, 30.0, 0.08, 0.07, 0.07]
    other = std.copy()
    other[number] *= 1 + share
    least = 0.02 if number < 3 else 0.005
    off, allowed = abs(share) * std[number], least + 0.1 * std[number]
    found = told(with_std(std), with_std(other))
    if off > allowed + 1e-6:
        assert [text.split(" is ")[0] for text in found] == ["+0.700 s pose frame 7 t0: std"]
        assert f"{allowed:.4g} allowed" in found[0]
    elif off < allowed - 1e-6:
        assert found == []


def test_a_covariance_of_nothing_but_depth_is_found_at_both_peers() -> None:
    assert len(told(with_std([0.9, 0.12, 30.0, 0.08, 0.07, 0.07]), with_std([0.0, 0.0, 30.0, 0.0, 0.0, 0.0]))) == 1
    told_relative = {**held()[1], "kind": "TARGET_RELATIVE", "id": 0, "pos_std": [0.9, 0.12, 30.0]}
    (found,) = told([told_relative], [{**told_relative, "pos_std": [0.0, 0.0, 30.0]}])
    assert found.startswith("+0.700 s TARGET_RELATIVE from 1/191: pos_std is [0 0 30], expected [0.9 0.12 30]: 0.9 off")


def test_what_is_missing_and_what_is_new_is_named_in_the_order_of_time() -> None:
    later = held(frame=8, t_ns=800_000_000)
    assert told([*held(), later[0]], held(target="t1")) == [
        "+0.700 s pose frame 7 t0: expected, but missing",
        "+0.700 s pose frame 7 t1: present, but not expected",
        "+0.800 s pose frame 8 t0: expected, but missing",
    ]


def test_a_direction_that_is_lost_and_one_that_points_elsewhere_are_told() -> None:
    recording = Recording(START_NS, 0, 0, "")
    for target, ray_cam in (("t1", [0.6, 0.0, 0.8]), ("t2", [0.0, 0.6, 0.8])):
        seen = {"event": "direction", "target": target, "capture_utc_ns": START_NS + 700_000_000, "ray_cam": ray_cam}
        recording.take("subscriber", seen)
    expected = reduced(Outputs([], [], recording))
    assert told(expected, expected) == []
    recording.directions[1]["ray_cam"] = [0.0, 0.58, 0.81]
    del recording.directions[0]
    assert told(expected, reduced(Outputs([], [], recording))) == [
        "+0.700 s direction t1: expected, but missing",
        "+0.700 s direction t2: ray_cam is [0 0.58 0.81], expected [0 0.6 0.8]: 0.02 off, 0.011 allowed",
    ]


def test_words_are_held_and_the_numbers_in_them_are_not() -> None:
    expected, other = held(), held()
    other[1]["text"] = "target 0 acquired at 198 m"
    assert told(expected, other) == []
    other[1]["text"] = "target 0 lost"
    assert told(expected, other) == [
        "+0.700 s STATUSTEXT from 1/191: text is target 0 lost, expected target 0 acquired at 200 m"
    ]


def test_a_count_is_exact_and_a_field_that_goes_is_told() -> None:
    expected, other = held(), held()
    other[1]["severity"] = 4
    del other[0]["std"]
    assert told(expected, other) == [
        "+0.700 s STATUSTEXT from 1/191: severity is 4, expected 6",
        "+0.700 s pose frame 7 t0: std is missing",
    ]


@pytest.mark.parametrize("case", CASES)
def test_the_golden_files_show_what_their_cases_are_for(case: str) -> None:
    records = read_golden(case)[1]
    poses = [record for record in records if record["kind"] == "pose"]
    seen = {name: [pose["frame"] for pose in poses if pose["target"] == name] for name in ("t0", "t1")}
    if case == "crossing":
        assert len(seen["t0"]) > 40
    elif case == "away_and_back":  # the picture is empty from frame 11 to 35
        frames = sorted({pose["frame"] for pose in poses})
        assert frames[0] < 8
        assert frames[-1] > 45
        assert max(b - a for a, b in itertools.pairwise(frames)) > 15
    elif case == "two_targets":
        assert min(len(frames) for frames in seen.values()) > 20
    else:
        assert len([record for record in records if record["kind"] == "direction"]) > 8
        assert poses == []
