"""Encounters: what a plan asks for is what is flown, and the camera sees it."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs.geometry import R_from_q_wxyz, rotation_angle
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.flight import Encounter, EncounterPlan, fly_encounter
from sim_replay.flight.track import Array
from sim_replay.telemetry import read_telemetry, write_telemetry

WIDTH_PX, HEIGHT_PX = 1920, 1080
NAMES = ("male_v_tail", "twin_boom_inverted_v", "light_aircraft", "glider", "tailless_swept", "loitering_delta")


def plan(seed: int, focal_px: float = 2500.0, **changes: object) -> EncounterPlan:
    """A plan of 60 frames at 15 fps; range, airframe, gusts and mount go round with the seed."""
    values: dict[str, object] = {
        "seed": seed,
        "frames": 60,
        "fps": 15.0,
        "range_m": 100.0 + 400.0 * ((seed * 0.381966) % 1.0),
        "airframes": (NAMES[seed % len(NAMES)],),
        "half_fov_rad": (float(np.arctan(WIDTH_PX / 2 / focal_px)), float(np.arctan(HEIGHT_PX / 2 / focal_px))),
        "mount": ("gimbal", "fixed")[seed % 2],
        "jitter_rad": 3e-4,
        "gust": ("calm", "light", "moderate")[seed % 3],
    }
    return EncounterPlan(**(values | changes))  # type: ignore[arg-type]


def sights_m(encounter: Encounter, target: int = 0) -> Array:
    """From camera to target [F, 3] in NED."""
    return encounter.targets[target].at(encounter.frame_t_s).t_ned_body_m - encounter.t_ned_cam_m


def corners_px(encounter: Encounter, focal_px: float, target: int = 0) -> Array:
    """Wing tips, nose and tail [F, 4, 2] in the picture, by OpenCV."""
    shape = AIRFRAMES[airframe_id(encounter.plan.airframes[target])]
    half_span, half_length = shape.span_m / 2, shape.length_m / 2
    corners = np.array([[0, half_span, 0], [0, -half_span, 0], [half_length, 0, 0], [-half_length, 0, 0]])
    K = np.array([[focal_px, 0, (WIDTH_PX - 1) / 2], [0, focal_px, (HEIGHT_PX - 1) / 2], [0, 0, 1]])
    track = encounter.targets[target].at(encounter.frame_t_s)
    out = []
    for R_ned_cam, t_ned_cam_m, R, t in zip(
        encounter.R_ned_cam, encounter.t_ned_cam_m, track.R_ned_body, track.t_ned_body_m, strict=True
    ):
        rvec, _ = cv2.Rodrigues(R_ned_cam.T @ R)
        out.append(cv2.projectPoints(corners, rvec, R_ned_cam.T @ (t - t_ned_cam_m), K, None)[0][:, 0])
    return np.array(out)


def inside(points_px: Array) -> Array:
    """Which frames [F] have all of their points [F, P, 2] in the picture."""
    return np.all((points_px >= -0.5) & (points_px <= np.array([WIDTH_PX, HEIGHT_PX]) - 0.5), axis=(1, 2))


@pytest.mark.parametrize("seed", range(12))
def test_range_height_and_picture_are_as_planned(seed: int) -> None:
    wanted = plan(seed)
    encounter = fly_encounter(wanted)
    middle = np.array([encounter.frame_t_s[-1] / 2])
    apart = encounter.targets[0].at(middle).t_ned_body_m - encounter.own.at(middle).t_ned_body_m
    assert np.linalg.norm(apart) == pytest.approx(wanted.range_m, abs=1e-6)
    sights = sights_m(encounter)
    range_m = np.linalg.norm(sights, axis=1)
    assert range_m.min() > 90.0
    assert range_m.max() < 520.0
    assert np.abs(np.degrees(np.arcsin(sights[:, 2] / range_m))).max() < 40.0
    for track in (encounter.own, *encounter.targets):
        assert track.t_s[0] <= -1.0
        assert track.t_s[-1] >= encounter.frame_t_s[-1] + 1.0
        assert np.all(-track.at(encounter.frame_t_s).t_ned_body_m[:, 2] > 60.0)
    assert inside(corners_px(encounter, 2500.0)).all()


def test_a_bolted_camera_keeps_its_place_on_the_ship_and_a_gimbal_does_not() -> None:
    fixed, gimbal = fly_encounter(plan(1, mount="fixed")), fly_encounter(plan(1, mount="gimbal"))
    assert (fixed.plan.mount, gimbal.plan.mount) == ("fixed", "gimbal")
    assert rotation_angle(fixed.R_body_cam[0], fixed.R_body_cam).max() < 10 * 3e-4
    assert rotation_angle(gimbal.R_body_cam[0], gimbal.R_body_cam).max() > 0.01


def test_a_lens_too_long_for_a_bolted_camera_gets_a_gimbal() -> None:
    narrow = plan(3, mount="fixed", half_fov_rad=(0.075, 0.06), frames=300, fps=10.0, range_m=130.0, gust="moderate")
    encounter = fly_encounter(narrow)
    assert encounter.plan.mount == "gimbal"


@pytest.mark.parametrize("seed", range(6))
def test_a_target_that_leaves_is_gone_for_a_while_and_comes_back(seed: int) -> None:
    encounter = fly_encounter(plan(seed, leaves=True, frames=90))
    points = corners_px(encounter, 2500.0)
    centre = points[:, :2].mean(axis=1, keepdims=True)
    gone = ~inside(centre)
    assert 0.10 <= gone.mean() <= 0.30
    assert inside(points)[[0, -1]].all()
    edges = np.flatnonzero(np.diff(gone.astype(int)))
    assert len(edges) == 2  # out once, back once


@pytest.mark.parametrize("seed", range(4))
def test_three_targets_share_the_picture_and_keep_apart(seed: int) -> None:
    encounter = fly_encounter(plan(seed, airframes=("light_aircraft", "tailless_swept", "glider"), range_m=300.0))
    tracks = [track.at(encounter.frame_t_s).t_ned_body_m for track in encounter.targets]
    span_m = AIRFRAMES[airframe_id("glider")].span_m
    for a in range(3):
        for b in range(a):
            assert np.linalg.norm(tracks[a] - tracks[b], axis=1).min() > 1.5 * span_m
        assert inside(corners_px(encounter, 2500.0, a)).mean() > 0.8
        range_m = np.linalg.norm(sights_m(encounter, a), axis=1)
        assert range_m.min() > 90.0
        assert range_m.max() < 550.0


def test_aspects_come_from_all_round_and_from_above_and_below() -> None:
    seen = []
    for seed in range(32):
        encounter = fly_encounter(plan(seed, frames=40, mount="gimbal"))
        R = encounter.targets[0].at(encounter.frame_t_s[20:21]).R_ned_body[0]
        body = R.T @ -sights_m(encounter)[20]
        seen.append((np.arctan2(body[1], body[0]), np.arcsin(-body[2] / np.linalg.norm(body))))
    azimuth, elevation = np.degrees(np.array(seen)).T
    quarters = np.histogram((azimuth + 45.0) % 360.0, [0, 90, 180, 270, 360])[0]  # ahead, right, behind, left
    assert quarters.min() >= 3
    assert (elevation > 12.0).sum() >= 3
    assert (elevation < -12.0).sum() >= 3


def test_frames_are_what_the_camera_gives_at_their_times() -> None:
    encounter = fly_encounter(plan(5))
    R_ned_cam, t_ned_cam_m = encounter.camera_pose_at(encounter.frame_t_s)
    np.testing.assert_array_equal(R_ned_cam, encounter.R_ned_cam)
    np.testing.assert_array_equal(t_ned_cam_m, encounter.t_ned_cam_m)
    own = encounter.own.at(encounter.frame_t_s)
    np.testing.assert_allclose(own.R_ned_body @ encounter.R_body_cam, R_ned_cam, atol=1e-12)
    np.testing.assert_allclose(t_ned_cam_m - own.t_ned_body_m, own.R_ned_body @ encounter.t_body_cam_m, atol=1e-9)
    opened, closed = (encounter.camera_pose_at(encounter.frame_t_s + dt)[0] for dt in (-0.002, 0.002))
    assert 0.0 < rotation_angle(opened, closed).max() < 0.02


def test_telemetry_says_where_the_own_ship_is(tmp_path: Path) -> None:
    encounter = fly_encounter(plan(4))
    write_telemetry(tmp_path / "telemetry.csv", encounter.telemetry())
    read = read_telemetry(tmp_path / "telemetry.csv")
    assert np.all(np.diff(read.t_ns) == 20_000_000)
    t_ns = int(encounter.frame_t_s[30] * 1e9)
    state, own = read.at(t_ns), encounter.own.at(encounter.frame_t_s[30:31])
    assert rotation_angle(R_from_q_wxyz(state.q_ned_body_wxyz), own.R_ned_body[0]) < 1e-4
    np.testing.assert_allclose(state.t_ned_body_m, own.t_ned_body_m[0], atol=0.02)
    np.testing.assert_allclose(state.v_ned_body_mps, own.v_ned_body_mps[0], atol=0.05)
    assert state.alt_m == pytest.approx(488.0 - own.t_ned_body_m[0, 2], abs=0.02)


HASH = """
import hashlib, sys
from sim_replay.flight import EncounterPlan, fly_encounter
fly_encounter(EncounterPlan(99, 40, 10.0, 200.0, ("glider",), (0.3, 0.2)))
e = fly_encounter(EncounterPlan(7, 40, 10.0, 300.0, ("light_aircraft", "tailless_swept"), (0.3, 0.2), "gimbal", 3e-4,
                                "moderate"))
arrays = [e.R_ned_cam, e.t_ned_cam_m, e.own.rates_body_radps, *(t.t_ned_body_m for t in e.targets)]
print(hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest())
"""


def test_the_same_plan_gives_the_same_bytes_in_another_process_whatever_was_flown_before() -> None:
    e = fly_encounter(
        EncounterPlan(7, 40, 10.0, 300.0, ("light_aircraft", "tailless_swept"), (0.3, 0.2), "gimbal", 3e-4, "moderate")
    )
    arrays = [e.R_ned_cam, e.t_ned_cam_m, e.own.rates_body_radps, *(t.t_ned_body_m for t in e.targets)]
    here = hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()
    there = subprocess.run([sys.executable, "-c", HASH], capture_output=True, text=True, check=True)
    assert there.stdout.strip() == here
    assert there.stderr == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"range_m": 40.0}, "range_m"), ({"frames": 1}, "at least 2 frames"), ({"airframes": ("zeppelin",)}, "zeppelin")],
)
def test_a_plan_that_cannot_be_is_refused_in_words(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fly_encounter(plan(0, **changes))
