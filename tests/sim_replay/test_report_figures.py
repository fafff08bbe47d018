"""Figures of what a peer received: known losses, names, ages and covariances, and what is then told of them."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.font_manager import FontEntry
from scipy.stats import chi2

from msgs.geometry import R_FORWARD_CAM, so3_exp
from sim_replay import lettering
from sim_replay.evaluation.figures import error_by_range, sequence
from sim_replay.evaluation.instances import instances
from sim_replay.golden.run import CASES
from sim_replay.ground_truth import read_scene_truth
from sim_replay.report import plots
from sim_replay.report.continuity import continuity
from sim_replay.report.peer import (
    CHI2_95,
    longest_silence_s,
    nees,
    peer_figures,
    range_error_m,
    rmse,
    tracks,
)
from sim_replay.score import Match, TargetPose, Truth

FPS = 10.0


def matches(pattern: str, object_id: int = 1, first_frame: int = 0) -> list[Match]:
    """One frame a character: a digit is a pose of that track, `-` none, a space a frame without the target."""
    made = []
    for frame, mark in enumerate(pattern, first_frame):
        truth = Truth(frame, np.eye(3), np.array([0.0, 0.0, 200.0]), object_id, 12.0)
        pose = None if mark == "-" else TargetPose(frame, np.eye(3), np.array([0.0, 0.0, 190.0]), track=f"t{mark}")
        if mark != " ":
            made.append(Match(truth, pose))
    return made


def test_a_target_that_is_held_has_no_losses() -> None:
    held = continuity(matches("0000000000"), FPS)
    assert (held["identity_switches"], held["fragments"], held["reacquired"], held["never_reacquired"]) == (0, 0, 0, 0)
    assert held["time_to_acquire_s"] == {"median": 0.0, "max": 0.0}


def test_losses_names_and_times_are_told() -> None:
    held = continuity(matches("---00---0011-1--"), FPS)
    assert held["time_to_acquire_s"]["median"] == pytest.approx(0.3)
    assert held["identity_switches"] == 1
    assert held["fragments"] == held["reacquired"] == 2
    assert held["never_reacquired"] == 1
    assert held["time_to_reacquire_s"] == {"median": pytest.approx(0.2), "max": pytest.approx(0.3)}
    assert held["targets"][0]["tracks"] == ["t0", "t1"]
    assert [loss["frame"] for loss in held["targets"][0]["losses"]] == [5, 12, 14]


def test_out_of_view_is_no_loss_and_coming_back_is_a_reacquisition() -> None:
    held = continuity(matches("0000     --00"), FPS)
    assert held["fragments"] == 0
    assert held["reacquired"] == 1
    assert held["time_to_reacquire_s"]["max"] == pytest.approx(0.2)


def test_a_loss_that_ends_out_of_view_is_regained_by_nothing_that_comes_after() -> None:
    """Lost in frames 2 and 3, out of view in 4, back in 5 and found in 6."""
    held = continuity(matches("00-- -00"), FPS)
    (target,) = held["targets"]
    assert target["losses"] == [
        {"frame": 2, "lasted_s": 0.2, "regained": False, "while_in_view": True},
        {"frame": 5, "lasted_s": 0.1, "regained": True, "while_in_view": False},
    ]
    assert (held["fragments"], held["reacquired"], held["never_reacquired"]) == (0, 1, 1)


def test_the_time_to_acquire_is_that_in_view() -> None:
    """Missed in two frames, out of view for twenty, found in the second frame after that."""
    held = continuity(matches(f"--{20 * ' '}-00"), FPS)
    assert held["time_to_acquire_s"]["max"] == pytest.approx(0.3)
    assert (held["never_acquired"], held["reacquired"], held["never_reacquired"]) == (0, 0, 0)


@pytest.mark.parametrize(("unrecorded", "lines"), [(range(0), 2), (range(11, 36), 1)])
def test_no_line_is_drawn_where_a_target_flew_out_of_view(unrecorded: range, lines: int) -> None:
    """It is from frame 11 to 35. Over frames that no camera recorded, lines run on."""
    scene = replace(read_scene_truth(CASES["away_and_back"].folder), unrecorded=frozenset(unrecorded))
    held = [Match(truth, truth) for truth in scene.truths if truth.visible]
    svg = plots.trajectory(held, scene)
    for color in (plots.TRUTH_COLOR, plots.ESTIMATE_COLOR):
        drawn = re.findall(rf'<path d="([^"]*)" clip-path[^>]*stroke: {color}', svg)
        assert [path.count("M") for path in drawn] == [lines, lines], "in 3-D and from above"


def test_a_target_that_flies_towards_the_camera_has_every_pose_drawn_and_no_line_from_180_to_minus_180() -> None:
    """Its yaw goes to and fro across ±180°: each crossing hid a pose, as if its rotation were not known."""
    towards = [so3_exp([0.0, yaw_rad, 0.0]) @ R_FORWARD_CAM.T for yaw_rad in (3.1, 3.2, 3.1, 3.2, 3.0)]
    turned = [replace(m.truth, R_cam_target=R) for m, R in zip(matches("00000"), towards, strict=True)]
    svg = plots.pose_over_time([Match(truth, truth) for truth in turned], len(turned), FPS)
    assert len(re.findall(rf"<use [^>]*stroke: {plots.ESTIMATE_COLOR}", svg)) == 6 * len(turned)
    lines = re.findall(rf'<path d="([^"]*)" clip-path[^>]*stroke: {plots.ESTIMATE_COLOR}', svg)
    assert [path.count("M") for path in lines] == [1, 1, 1, 1, 1, 5]


def test_a_target_that_banks_as_no_other_does_is_within_the_axes() -> None:
    """Axes of ten degrees about the first target's roll would cut off those of the second."""
    level, banked = matches("00000"), matches("11111", object_id=2)
    R_banked = R_FORWARD_CAM.T @ so3_exp([np.radians(60.0), 0.0, 0.0])
    flown = [replace(m.truth, R_cam_target=R_FORWARD_CAM.T) for m in level]
    flown += [replace(m.truth, R_cam_target=R_banked) for m in banked]
    svg = plots.pose_over_time([Match(truth, truth) for truth in flown], len(level), FPS)
    assert len(re.findall(rf"<use [^>]*stroke: {plots.ESTIMATE_COLOR}", svg)) == 6 * len(flown)


def test_figures_are_over_all_targets_each_from_when_it_came_into_view() -> None:
    late, at_once, last = "--0-0", "1-1", "-----2"
    held = continuity(
        [m for k, pattern in enumerate((late, at_once, last)) for m in matches(pattern, k, first_frame=7 * k)], FPS
    )
    assert held["time_to_acquire_s"] == {"median": 0.2, "max": 0.5}
    assert held["fragments"] == 2


@pytest.mark.parametrize("pattern", ["---00---0011-1--", "0000     --00", "0-0 -0"])
def test_what_was_not_recorded_is_no_loss_and_ends_none(pattern: str) -> None:
    """Every third frame has an image, as a recording of 10 out of 30 a second has them."""

    def third(match: Match) -> Match:
        return Match(replace(match.truth, frame=3 * match.truth.frame), match.estimate)

    seen = matches(pattern)
    few, between = [third(match) for match in seen], {frame for frame in range(3 * len(pattern)) if frame % 3}
    all_of_them, told = continuity(seen, FPS), continuity(few, 3 * FPS, between)
    for name in all_of_them.keys() - {"targets"}:
        assert told[name] == all_of_them[name], name
    ages = [(match.truth.frame, 20.0) for match in seen if match.estimate is not None]
    tripled = [(3 * frame, age_ms) for frame, age_ms in ages]
    silence_s = longest_silence_s(few, tripled, 3 * FPS, between)
    assert silence_s == pytest.approx(longest_silence_s(seen, ages, FPS), abs=0.07)  # two frames at the end


def test_two_targets_that_swap_names_are_two_switches() -> None:
    swapped = matches("000111", object_id=1) + matches("111000", object_id=2)
    assert continuity(swapped, FPS)["identity_switches"] == 2


def test_two_of_one_airframe_are_told_apart_when_one_leaves_and_comes_back() -> None:
    """A flies on the left, B on the right, C comes late, all by 2 m a frame; the files hold those in view, A first."""
    truths, expected = [], []
    for frame, present in enumerate(["AB", "AB", "B", "B", "AB", "A", "", "B", "", "AB", "ABC", "BAC"]):
        for name in present:
            place_m = np.array([{"A": -30.0, "B": 30.0, "C": 90.0}[name], 2.0 * frame, 200.0])
            truths.append(Truth(frame, np.eye(3), place_m, 1, 12.0))
            # In one frame order is all there is: who stands where A stood is A.
            expected.append(present.index(name) if frame == 11 else "ABC".index(name))
    numbers = instances(truths, [truth.t_cam_target_m for truth in truths])
    assert numbers == expected
    other = [replace(truth, object_id=2) for truth in truths]
    assert instances([*truths, *other], [t.t_cam_target_m for t in [*truths, *other]]) == [*expected, *expected]


@pytest.mark.parametrize(
    ("x_m", "expected"),
    [
        ({0: (-30.0, 30.0), 2: (30.0, 90.0)}, [0, 1, 0, 1]),  # a frame without any, and all are back
        ({0: (-30.0, 30.0), 1: (30.0,), 2: (-30.0,)}, [0, 1, 1, 1]),  # the left one has gone
    ],
)
def test_where_as_many_are_in_view_as_before_their_order_tells_them_apart_however_the_camera_turns(
    x_m: dict[int, tuple[float, ...]], expected: list[int]
) -> None:
    places = [(frame, np.array([x, 0.0, 200.0])) for frame, row in x_m.items() for x in row]
    truths = [Truth(frame, np.eye(3), place_m, 1, 12.0) for frame, place_m in places]
    assert instances(truths, [place_m for _, place_m in places]) == expected


def test_one_that_is_never_found_is_counted_and_has_no_time() -> None:
    held = continuity(matches("0000") + matches("----", object_id=2), FPS)
    assert held["never_acquired"] == 1
    assert held["time_to_acquire_s"] == {"median": 0.0, "max": 0.0}


def drawn(count: int, honesty: float) -> list[Match]:
    """Truths scattered about estimates by a correlated covariance that is told `honesty` times as large."""
    chance = np.random.default_rng(7)
    root = np.array([0.5, 0.5, 4.0, 0.02, 0.02, 0.02])[:, None] * np.tril(chance.normal(size=(6, 6)))
    P = root @ root.T + np.diag([0.1, 0.1, 1.0, 1e-4, 1e-4, 1e-4])
    made = []
    for frame, error in enumerate(chance.multivariate_normal(np.zeros(6), P, size=count)):
        R_est, t_est = so3_exp(chance.normal(size=3)), np.array([3.0, -2.0, 250.0])
        truth = Truth(frame, so3_exp(error[3:]) @ R_est, t_est + error[:3], 1, 12.0)
        made.append(Match(truth, TargetPose(frame, R_est, t_est, covariance=honesty * P)))
    return made


def test_nees_of_an_honest_covariance_is_its_degrees_of_freedom() -> None:
    told = nees(drawn(3000, 1.0))
    assert told is not None
    for part, dof in (("pose", 6), ("position", 3), ("rotation", 3)):
        assert told[part]["mean"] == pytest.approx(dof, rel=0.1)
        assert told[part]["median"] == pytest.approx(chi2.median(dof), rel=0.05)
        assert told[part]["within_95pct"] == pytest.approx(0.95, abs=0.02)
        assert told[part]["singular"] == 0
    boastful = nees(drawn(3000, 0.25))
    assert boastful is not None
    assert boastful["pose"]["mean"] == pytest.approx(4 * told["pose"]["mean"], rel=1e-3)
    assert nees(matches("000")) is None


def test_the_bounds_are_those_of_chi_square() -> None:
    assert {dof: pytest.approx(chi2.ppf(0.95, dof), abs=1e-3) for dof in CHI2_95} == CHI2_95


def test_rmse_and_bias_of_a_pose_that_is_short_and_turned_about_the_optical_axis() -> None:
    turned = []
    for frame, roll_rad in enumerate((0.1, -0.1)):
        truth = Truth(frame, np.eye(3), np.array([0.0, 0.0, 200.0]), 1, 12.0)
        R_est = so3_exp([0.0, 0.0, roll_rad])
        turned.append(Match(truth, TargetPose(frame, R_est, np.array([3.0, 0.0, 180.0]))))
    told = rmse(turned)
    assert (told["x_m"], told["y_m"], told["z_m"]) == (3.0, 0.0, 20.0)
    angles = [told[name] for name in ("roll_deg", "pitch_deg", "yaw_deg")]
    assert max(value for value in angles if value is not None) == pytest.approx(np.rad2deg(0.1), rel=1e-3)
    bias = range_error_m(turned)["mean"]
    assert bias == pytest.approx(np.hypot(3, 180) - 200, abs=1e-3)


def test_range_errors_of_a_hand_worked_case() -> None:
    """10 m of 200 m too near, 30 m of 400 m too far."""
    pairs = [(np.array([0.0, 120.0, 160.0]), 0.95), (np.array([240.0, 0.0, 320.0]), 1.075)]
    seen = [
        Match(Truth(k, np.eye(3), t_m, 1, 12.0), TargetPose(k, np.eye(3), t_m * stretched))
        for k, (t_m, stretched) in enumerate(pairs)
    ]
    rms = pytest.approx(500.0**0.5, abs=1e-5)
    assert range_error_m(seen) == {"mean": 10.0, "rms": rms, "mean_rel": 0.0125}


def test_angles_are_compared_the_short_way_round() -> None:
    """Yaw of 179 and -178 degrees: 3 apart; of -179 and 179: 2."""
    yawed = lambda deg: R_FORWARD_CAM.T @ so3_exp([0.0, 0.0, np.deg2rad(deg)])  # noqa: E731
    t_m = np.array([0.0, 0.0, 200.0])
    seen = [
        Match(Truth(k, yawed(true), t_m, 1, 12.0), TargetPose(k, yawed(told), t_m))
        for k, (true, told) in enumerate([(179.0, -178.0), (-179.0, 179.0)])
    ]
    assert rmse(seen)["yaw_deg"] == pytest.approx(6.5**0.5, abs=1e-4)


def test_rotations_that_are_not_known_are_in_no_figure_of_rotations() -> None:
    """Turned by 0.2 rad with a standard deviation of 0.1 on each axis: e' P^-1 e is 4, with 1 m of 1 m sideways 5."""
    P = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
    told_m = np.array([1.0, 0.0, 200.0])
    seen = [
        TargetPose(0, so3_exp([0.0, 0.0, 0.2]), told_m, covariance=P, track="t0"),
        TargetPose(1, so3_exp([2.0, 0.0, 0.0]), told_m, covariance=1e6 * P, track="t0", rotation_known=False),
    ]
    level = R_FORWARD_CAM.T
    followed = [
        Match(Truth(pose.frame, level, np.array([0.0, 0.0, 200.0]), 1, 12.0), replace(pose, R_cam_target=R @ level))
        for pose in seen
        for R in [pose.R_cam_target]
    ]
    told = peer_figures(2, FPS, followed, [], [])
    assert told["rmse"]["x_m"] == 1.0
    assert told["rmse"]["roll_deg"] == pytest.approx(np.rad2deg(0.2), abs=1e-4)
    assert told["rmse"]["pitch_deg"] == pytest.approx(0.0, abs=1e-4)
    assert told["nees"]["rotation"]["mean"] == pytest.approx(4.0)
    assert told["nees"]["pose"]["mean"] == pytest.approx(5.0)
    assert told["nees"]["position"]["mean"] == pytest.approx(0.5, abs=1e-4)
    assert told["tracks"]["t0"]["rotation_error_deg"] == pytest.approx(np.rad2deg(0.2), abs=1e-4)
    unturned = peer_figures(2, FPS, followed[1:], [], [])
    assert (unturned["rmse"]["roll_deg"], unturned["nees"]["rotation"], unturned["nees"]["pose"]) == (None, None, None)
    assert json.loads(json.dumps(unturned, allow_nan=False)) == unturned


@pytest.mark.parametrize(
    ("pattern", "silence_s"),
    [("00---", 0.5 - 0.12), ("00000          ---00", 1.82 - 1.5)],  # to the end of the view, from where it begins anew
)
def test_silence_is_from_a_poses_arrival_or_the_beginning_of_a_view_to_the_next_or_its_end(
    pattern: str, silence_s: float
) -> None:
    seen = matches(pattern)
    received = [(m.truth.frame, 20.0) for m in seen if m.estimate is not None]
    assert longest_silence_s(seen, received, FPS) == pytest.approx(silence_s)


def test_a_pose_of_no_target_is_silence_about_those_in_view() -> None:
    """A target is lost in frames 2 to 4, in which something else was taken for one."""
    everywhere = [(frame, 0.0) for frame in range(7)]
    assert longest_silence_s(matches("00---00"), everywhere, FPS) == pytest.approx(0.4)
    assert longest_silence_s(matches("-------"), everywhere, FPS) is None


def test_silence_counts_only_while_a_target_is_to_be_seen() -> None:
    seen = matches("00000-----00000     00000")
    received = [(m.truth.frame, 20.0) for m in seen if m.estimate is not None]
    assert longest_silence_s(seen, received, FPS) == pytest.approx(0.6)
    unbroken = matches("00000") + matches("00000", first_frame=15)
    assert longest_silence_s(unbroken, [(m.truth.frame, 20.0) for m in unbroken], FPS) == pytest.approx(0.1, abs=0.005)
    assert longest_silence_s(seen, [], FPS) is None
    assert longest_silence_s(matches("-0"), [(1, 150.0)], FPS) == 0.0  # arrived when the target was out of view again


def test_tracks_tell_what_they_followed_and_what_was_false() -> None:
    seen = matches("0011")
    false = [TargetPose(2, np.eye(3), np.array([90.0, 0.0, 200.0]), track="t7")]
    told = tracks(seen, false)
    assert {name: (track["poses"], track["false_poses"]) for name, track in told.items()} == {
        "t0": (2, 0),
        "t1": (2, 0),
        "t7": (1, 1),
    }
    assert (told["t1"]["first_frame"], told["t1"]["last_frame"]) == (2, 3)
    assert told["t1"]["range_error_m"] == -10.0


def test_ages_are_told_by_their_percentiles() -> None:
    told = peer_figures(1, FPS, matches("0"), [], [(0, float(ms)) for ms in range(101)])
    assert told["age_ms"] == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}


def test_nothing_received_is_told_with_nulls_and_not_nan() -> None:
    told = peer_figures(4, FPS, matches("----"), [], [])
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert told["rmse"]["z_m"] is None
    assert told["age_ms"]["p99"] is None


def test_names_in_other_scripts_and_with_dollar_signs_are_drawn_and_nothing_is_complained_of(
    caplog: pytest.LogCaptureFixture, recwarn: pytest.WarningsRecorder
) -> None:
    """No font has the second character, so its number is shown; the third is in one that comes with matplotlib."""
    name = "鷹 \U0010fffd ⎰ cost $x_{$"
    seen = [replace(match, truth=replace(match.truth, airframe=name)) for match in matches("00")]
    svg = plots.timeline([], seen, 2, FPS)
    (shown,) = re.findall("<!-- (.*): in view -->", svg)
    assert shown.endswith(r" \U0010fffd ⎰ cost $x_{$")
    assert shown[0] == "鷹" or shown.startswith(r"\u9df9 ")
    picture = io.BytesIO()
    sequence(name, []).savefig(picture)
    error_by_range({"by_range": {}, "method": {"file": name}, "dataset": name}).savefig(picture)
    assert caplog.text == ""
    assert not list(recwarn)


def test_fonts_that_were_removed_or_are_spoiled_hinder_no_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """matplotlib lists them still, and looks into a font's file only to draw with it."""
    removed, spoiled = tmp_path / "Removed.ttf", tmp_path / "Spoiled.ttf"
    spoiled.write_bytes(b"no font")
    for file in (removed, spoiled):
        font = FontEntry(fname=str(file), name=f"{file.stem} Sans", style="normal", weight=400)
        monkeypatch.setattr(lettering.fontManager, "ttflist", [*lettering.fontManager.ttflist, font])
        lettering._upright_fonts.cache_clear()
        try:
            assert lettering.lettering(["\U0010fffd"])[0] == [r"\U0010fffd"]
        finally:
            lettering._upright_fonts.cache_clear()
