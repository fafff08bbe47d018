"""Lenses settled after the flights: the mean share is the preset's, and no lens is one that there is not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.errors import InputError
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.benchmark.filming import mean_box_area, pointing_focal_px
from sim_replay.benchmark.lenses import FILE, lenses_of, settle_lenses
from sim_replay.benchmark.plan import mean_box_area_m2, plan_dataset
from sim_replay.benchmark.preset import load_preset
from sim_replay.flight import EncounterPlan, fly_encounter

PRESET = load_preset("fw-uav6d")
PLANS = plan_dataset(PRESET, 5)
PICTURE_PX = 1920 * 1080


@given(scatter=st.lists(st.floats(-0.6, 0.6), min_size=161, max_size=161))
@settings(deadline=None, max_examples=25)
def test_whatever_aspects_were_flown_the_mean_share_is_the_presets(scatter: list[float]) -> None:
    areas = [mean_box_area_m2(p.airframes[0]) / p.range_m**2 * np.exp(s) for p, s in zip(PLANS, scatter, strict=True)]
    focal_px = settle_lenses(PRESET, PLANS, areas)
    for plan in PLANS:
        assert 1200 <= focal_px[plan.index] <= pointing_focal_px(plan, PRESET) + 0.01 <= 8000.01
    frames = np.array([plan.frames for plan in PLANS])
    share = np.array([focal_px[p.index] ** 2 * area / PICTURE_PX for p, area in zip(PLANS, areas, strict=True)])
    longest = np.array([pointing_focal_px(p, PRESET) ** 2 * a / PICTURE_PX for p, a in zip(PLANS, areas, strict=True)])
    reachable = np.average(longest, weights=frames)
    assert np.average(share, weights=frames) == pytest.approx(min(0.012, reachable), rel=1e-3)


def test_a_box_is_measured_as_a_camera_looking_straight_at_it_would() -> None:
    flown = fly_encounter(EncounterPlan(4, 20, 30.0, 250.0, ("glider",), (0.2, 0.11), "gimbal"))
    track = flown.targets[0].at(flown.frame_t_s)
    sight_m = track.t_ned_body_m - flown.t_ned_cam_m
    mesh = AIRFRAMES[airframe_id("glider")].mesh()
    areas = []
    for k in range(20):
        # Extents across the line of sight, along the camera's right and down as they are when it is turned there.
        z = sight_m[k] / np.linalg.norm(sight_m[k])
        turn, _ = Rotation.align_vectors(z, flown.R_ned_cam[k][:, 2])
        axes = turn.as_matrix() @ flown.R_ned_cam[k]
        across = mesh.vertices_m.astype(float) @ track.R_ned_body[k].T @ axes[:, :2]
        areas.append(np.prod(np.ptp(across, axis=0)) / (sight_m[k] @ sight_m[k]))
    # Perspective makes the nearer wing a little larger, a few per cent at this range.
    assert mean_box_area(flown) == pytest.approx(np.mean(areas), rel=0.06)


def test_lenses_once_written_are_kept(tmp_path: Path) -> None:
    kept = {plan.index: 1500.0 + plan.index for plan in PLANS}
    (tmp_path / FILE).write_text(json.dumps(kept))
    assert lenses_of(tmp_path, PRESET, PLANS, 1, lambda: None) == kept
    (tmp_path / FILE).write_text(json.dumps({"0": 1500.0}))
    with pytest.raises(InputError, match=r"lenses\.json: does not hold the 161 sequences"):
        lenses_of(tmp_path, PRESET, PLANS, 1, lambda: None)
    (tmp_path / FILE).write_text("[")
    with pytest.raises(InputError, match=r"lenses\.json: cannot be read"):
        lenses_of(tmp_path, PRESET, PLANS, 1, lambda: None)
