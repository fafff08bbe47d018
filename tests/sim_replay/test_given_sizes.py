"""What size is given for a scene, and what the shipped model makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge.config import SHIPPED_MODEL
from edge.estimator.estimator import Estimator
from edge.estimator.given_size import TargetSize
from edge.estimator.model import load_model
from edge.types import Frame, FrameMeta
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.bop import BopFrame, BopScene, BopTarget, Model
from sim_replay.evaluation.given_sizes import sizes_of
from sim_replay.render.frame import render_frame
from sim_replay.render.placing import frame_scene

from .test_shipped_failures import frame_of, scene_at

GLIDER = Model(18.0, low_m=(-3.0, -9.0, -1.0), size_m=(7.0, 18.0, 1.5))
BARE = Model(18.0)
POINT = Model(18.0, low_m=(0.0, 0.0, 0.0), size_m=(0.0, 0.0, 0.0))


def bop_scene(*objects: int) -> BopScene:
    made = BopScene(Path("scene"))
    targets = tuple(BopTarget(one, np.eye(3), np.array([0.0, 0.0, 200.0])) for one in objects)
    made.__dict__["frames"] = (BopFrame(0, np.eye(3), targets), BopFrame(1, np.eye(3), targets[:1]))
    return made


def test_a_scene_of_one_type_has_its_model_s_size() -> None:
    size_of = sizes_of({1: GLIDER, 2: BARE, 3: GLIDER, 5: POINT})
    assert size_of(bop_scene(1)) == size_of(bop_scene(1, 1)) == TargetSize(wingspan_m=18.0, length_m=7.0)
    assert size_of(bop_scene(1, 3)) is None, "of two types"
    assert [size_of(bop_scene(*objects)) for objects in ((2,), (4,), (5,), ())] == [None] * 4


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator(load_model(SHIPPED_MODEL, threads=1))


def seen(seed: int, number: int) -> tuple[Frame, np.ndarray]:
    """A frame with that airframe, and where it is, t_cam_target_m."""
    scene = frame_scene(np.random.default_rng(seed), [number])
    frame = Frame(FrameMeta(0, 0, 0), render_frame(scene).image_bgr, scene.camera.K)
    return frame, scene.targets[0].pose_in(scene.camera)[1]


@pytest.mark.parametrize("airframe", ["jet_trainer", "hybrid_quadplane"])
def test_the_range_of_an_aircraft_that_was_not_trained_on_is_right_once_its_size_is_given(
    estimator: Estimator, airframe: str
) -> None:
    """The one the model takes for smaller than it is, the other for larger."""
    number = airframe_id(airframe)
    size = TargetSize(AIRFRAMES[number].span_m, AIRFRAMES[number].length_m)
    off: dict[bool, list[float]] = {False: [], True: []}
    within = []
    for seed in range(8):
        frame, t_m = seen(seed, number)
        for given in off:
            estimator.target_size = size if given else None
            for found in estimator.acquire(frame)[:1]:
                log_off = np.log(np.linalg.norm(found.t_cam_target_m) / np.linalg.norm(t_m))
                off[given].append(abs(float(log_off)))
                if given:
                    sigma = np.sqrt(t_m @ found.covariance[:3, :3] @ t_m) / (t_m @ t_m)
                    within.append(abs(log_off) < 2.5 * sigma)
    assert min(len(found) for found in off.values()) >= 6
    assert np.median(off[True]) < 0.12
    assert np.median(off[False]) > 2.0 * np.median(off[True])
    assert np.mean(within) > 0.8


def test_another_unit_is_told_of_for_an_aircraft_whose_range_the_model_is_sure_of(estimator: Estimator) -> None:
    feet_per_m = 3.28
    told: dict[float, list[float | None]] = {1.0: [], feet_per_m: [], 1.0 / feet_per_m: []}
    for seed in range(6):
        scene = scene_at(seed, 250.0, 140.0)
        frame, airframe = frame_of(scene), AIRFRAMES[scene.targets[0].airframe_id]
        estimator.target_size = None
        if not any(np.sqrt(one.covariance[2, 2]) < 0.12 * one.t_cam_target_m[2] for one in estimator.acquire(frame)):
            continue
        for unit, oversizes in told.items():
            estimator.target_size = TargetSize(unit * airframe.span_m, unit * airframe.length_m)
            (found,) = estimator.acquire(frame)
            oversizes.append(found.oversize)
    assert len(told[1.0]) >= 3
    assert set(told.pop(1.0)) == {None}
    for unit, oversizes in told.items():
        assert [oversize for oversize in oversizes if oversize is not None] == pytest.approx(
            [1.0 / unit] * len(oversizes), rel=0.25
        )
