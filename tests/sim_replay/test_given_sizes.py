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

GLIDER = Model(18.0, low_m=(-3.0, -9.0, -1.0), size_m=(7.0, 18.0, 1.5))
BARE = Model(18.0)
POINT = Model(18.0, low_m=(0.0, 0.0, 0.0), size_m=(0.0, 0.0, 0.0))


def scene(*objects: int) -> BopScene:
    made = BopScene(Path("scene"))
    targets = tuple(BopTarget(one, np.eye(3), np.array([0.0, 0.0, 200.0])) for one in objects)
    made.__dict__["frames"] = (BopFrame(0, np.eye(3), targets), BopFrame(1, np.eye(3), targets[:1]))
    return made


def test_a_scene_of_one_type_has_its_model_s_size() -> None:
    size_of = sizes_of({1: GLIDER, 2: BARE, 3: GLIDER, 5: POINT})
    assert size_of(scene(1)) == size_of(scene(1, 1)) == TargetSize(wingspan_m=18.0, length_m=7.0)
    assert size_of(scene(1, 3)) is None, "of two types"
    assert [size_of(scene(*objects)) for objects in ((2,), (4,), (5,), ())] == [None] * 4


@pytest.mark.parametrize("airframe", ["jet_trainer", "hybrid_quadplane"])
def test_the_range_of_an_aircraft_that_was_not_trained_on_is_right_once_its_size_is_given(airframe: str) -> None:
    """The one the model takes for smaller than it is, the other for larger."""
    number = airframe_id(airframe)
    estimator = Estimator(load_model(SHIPPED_MODEL, threads=1))
    size = TargetSize(AIRFRAMES[number].span_m, AIRFRAMES[number].length_m)
    off: dict[bool, list[float]] = {False: [], True: []}
    within = []
    for seed in range(8):
        scene = frame_scene(np.random.default_rng(seed), [number])
        frame = Frame(FrameMeta(0, 0, 0), render_frame(scene).image_bgr, scene.camera.K)
        t_m = scene.targets[0].pose_in(scene.camera)[1]
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
