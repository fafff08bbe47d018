"""Windows with the poses and cameras of flown datasets: true to their labels, different in all else."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.airframes.invented import Invention
from sim_replay.bop import BopError, BopFrame, find_scenes
from sim_replay.cli import main
from sim_replay.render.flown import FlownShare, read_flown
from sim_replay.sampler import WindowSampler

PRESET = """
name = "flown"
sequence_frames = [4, 5]
fps = [10.0]
[splits]
train = { sequences = 3, frames = 13 }
[airframes]
only = ["light_aircraft", "male_v_tail"]
[lens]
distorted_share = 1.0
[targets]
two_share = 0.34
[picture]
weather = { clear = 1 }
quality = { ordinary = 1 }
"""
FLEET = range(len(AIRFRAMES))


def fly(folder: Path, *more: str) -> Path:
    (folder / "flown.toml").write_text(PRESET)
    words = ["generate", "--preset", str(folder / "flown.toml"), "--out", str(folder / "data"), "--seed", "3"]
    assert main([*words, "--labels-only", *more]) == 0
    return folder / "data"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"), "--undistorted")


def _frames(dataset: Path) -> list[BopFrame]:
    return [frame for scene in find_scenes(dataset) for frame in scene.frames]


def test_each_window_shows_a_frame_as_its_labels_say(flown: Path) -> None:
    """The box of the drawn pixels, moved back to the frame by both camera matrices, is the labels' box."""
    share = FlownShare(1.0, read_flown([flown], FLEET))
    batch = WindowSampler(11, 96, FLEET, acquire_share=0.0, empty_share=0.0, flown=share).batch(0, 48)
    labelled, shown, off_px = _frames(flown), set(), []
    for k in np.flatnonzero(batch.present):
        gap = [np.abs(frame.targets[0].t_cam_target_m - batch.t_cam_target_m[k]).max() for frame in labelled]
        frame = labelled[int(np.argmin(gap))]
        target = frame.targets[0]
        np.testing.assert_allclose(batch.t_cam_target_m[k], target.t_cam_target_m, atol=1e-3)
        np.testing.assert_allclose(batch.R_cam_target[k], target.R_cam_target, atol=1e-5)
        assert batch.airframe_id[k] == target.object_id - 1
        to_frame = frame.K @ np.linalg.inv(batch.K[k].astype(np.float64))
        low, high = (np.append(corner, 1.0) @ to_frame.T for corner in np.split(batch.box_xyxy_px[k], 2))
        box = target.box_visible_xyxy_px
        assert box is not None
        shown.add(id(frame))
        if np.all(np.abs(batch.box_xyxy_px[k] - 47.5) < 46.0):  # a window's edge may cut the aircraft
            off_px.append(float(np.abs(np.array([*low[:2], *high[:2]]) - box).max()))
    assert len(shown) > 8
    assert len(off_px) > 20
    assert np.percentile(off_px, 75) < 2.5  # a cloud may hide part of the others


def test_the_same_frame_is_drawn_with_other_light_and_livery(flown: Path) -> None:
    frames = read_flown([flown], [airframe_id("male_v_tail")])
    rng = np.random.default_rng(5)
    scenes = [frames.scene(rng) for _ in range(60)]
    assert {scene.targets[0].airframe_id for scene in scenes} == {airframe_id("male_v_tail")}
    assert len({scene.targets[0].livery_seed for scene in scenes}) == 60
    assert len({scene.environment.sun_ned.tobytes() for scene in scenes}) == 60
    assert len({scene.camera.R_ned_cam.tobytes() for scene in scenes}) < 14


def test_a_share_of_the_windows_is_flown(flown: Path) -> None:
    """The flown cameras have square pixels, which none of the others has."""
    share = FlownShare(0.3, read_flown([flown], FLEET))
    K = WindowSampler(2, 32, FLEET, acquire_share=0.0, flown=share).batch(0, 400).K
    assert 0.23 < np.mean(np.abs(K[:, 0, 0] / K[:, 1, 1] - 1.0) < 1e-6) < 0.37


def test_a_share_of_the_flown_aircraft_is_exchanged_for_invented_ones(flown: Path) -> None:
    share = FlownShare(1.0, read_flown([flown], FLEET))
    drawn = [0.0, 0.0, Invention(0.4), "crop", share]
    batch = WindowSampler(3, 32, FLEET, *drawn).batch(0, 300)
    assert 0.3 < np.mean(batch.airframe_id[batch.present] >= len(AIRFRAMES)) < 0.5
    flew = np.stack([frame.targets[0].t_cam_target_m for frame in _frames(flown)])
    gap_m = np.linalg.norm(flew - batch.t_cam_target_m[batch.present][:, None], axis=-1).min(1)
    assert gap_m.max() < 1e-3, "each is where one flew"


def test_an_airframe_given_twice_is_drawn_twice_as_often(flown: Path) -> None:
    light, male = airframe_id("light_aircraft"), airframe_id("male_v_tail")
    once, twice = (read_flown([flown], ids).airframe_id for ids in ([light, male], [light, male, male]))
    assert np.sum(twice == light) == np.sum(once == light) > 0
    assert np.sum(twice == male) == 2 * np.sum(once == male) > 0


def test_of_a_whole_dataset_only_training_flights_are_drawn(flown: Path, tmp_path: Path) -> None:
    """The others are there to validate and to test on; whoever wants one of them gives its folder."""
    whole = tmp_path / "whole"
    shutil.copytree(flown, whole)
    for split in ("val", "test"):
        shutil.copytree(flown / "train", whole / split)
    frames = len(read_flown([flown], FLEET).airframe_id)
    assert len(read_flown([whole], FLEET).airframe_id) == frames
    assert len(read_flown([whole / "val"], FLEET).airframe_id) == frames
    shutil.rmtree(whole / "train")
    with pytest.raises(
        BopError, match=r"whole: has no training split, but test, val; to train on one, give its folder"
    ):
        read_flown([whole], FLEET)


def test_what_cannot_be_drawn_anew_is_refused(flown: Path, tmp_path: Path) -> None:
    with pytest.raises(BopError, match="shows one of the airframes"):
        read_flown([flown], [airframe_id("glider")])
    with pytest.raises(BopError, match="--undistorted"):
        read_flown([fly(tmp_path)], FLEET)
    changed = {
        "scene_gt.json": (r'"obj_id": \d+', '"obj_id": 99', "obj_id 99"),
        "scene_camera.json": (r'"cam_R_w2c"', '"elsewhere"', "cam_R_w2c"),
        "camera.json": ('"width": 1920', '"width": 3840', "3840 x 1080 pixels"),
    }
    for name, (old, new, told) in changed.items():
        folder = tmp_path / name.removesuffix(".json")
        shutil.copytree(flown, folder)
        for path in folder.rglob(name):
            path.write_text(re.sub(old, new, path.read_text()))
        with pytest.raises(BopError, match=f"{folder}.*{told}"):
            read_flown([folder], FLEET)
    for path in folder.rglob("camera.json"):
        path.unlink()
    with pytest.raises(BopError, match=r"has no camera\.json"):  # some other tool's dataset
        read_flown([folder], FLEET)
