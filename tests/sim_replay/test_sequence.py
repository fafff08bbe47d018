"""The bundled sequence tells one story in its pictures, poses and telemetry."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import sim_replay
from msgs.geometry import R_from_q_wxyz, euler_from_R, rotation_angle, so3_log
from sim_replay.bop import BopScene, ModelFrames, read_models, read_scene
from sim_replay.render.frame import render_frame
from sim_replay.sequence import FPS, SENSOR, crossing
from sim_replay.telemetry import Telemetry, read_telemetry

FOLDER = Path(sim_replay.__file__).parent / "data" / "crossing"
SETTINGS = tomllib.loads((FOLDER / "sequence.toml").read_text(encoding="utf-8"))
GRAVITY_MPS2 = 9.80665


@pytest.fixture(scope="module")
def scene() -> BopScene:
    return read_scene(FOLDER)


@pytest.fixture(scope="module")
def telemetry() -> Telemetry:
    return read_telemetry(FOLDER / "telemetry.csv")


def _target_in_ned(scene: BopScene) -> tuple[np.ndarray, np.ndarray]:
    R, t = [], []
    for frame in scene.frames:
        assert frame.R_cam_world is not None
        assert frame.t_cam_world_m is not None
        R.append(frame.R_cam_world.T @ frame.targets[0].R_cam_target)
        t.append(frame.R_cam_world.T @ (frame.targets[0].t_cam_target_m - frame.t_cam_world_m))
    return np.array(R), np.array(t)


def test_it_is_small_and_whole(scene: BopScene) -> None:
    assert 120 <= len(scene.frames) <= 150
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) <= 7.5e6
    assert scene.image_bgr(scene.frames[0]).shape == (1080, 1920, 3)
    assert all(scene.image_path(frame).is_file() for frame in scene.frames)
    size_m = read_models(FOLDER, ModelFrames())[scene.frames[0].targets[0].object_id].size_m
    assert size_m is not None
    assert size_m[1] == pytest.approx(12.0)


def test_the_target_opens_from_150_m_to_beyond_300_m_in_full_view(scene: BopScene) -> None:
    ranges = [float(np.linalg.norm(frame.targets[0].t_cam_target_m)) for frame in scene.frames]
    assert 140 < ranges[0] < 160
    assert ranges[-1] > 300
    for frame in scene.frames:
        box = frame.targets[0].box_visible_xyxy_px
        assert box is not None
        assert box.min() > 50
        assert box[2] < 1870
        assert box[3] < 1030
        assert max(box[2:] - box[:2]) > 75


def test_telemetry_and_mount_give_the_pose_of_the_camera(scene: BopScene, telemetry: Telemetry) -> None:
    R_body_cam, lever = np.array(SETTINGS["R_body_cam"]), np.array(SETTINGS["t_body_cam_m"])
    for frame in scene.frames:
        own = telemetry.at(SETTINGS["t0_ns"] + round(frame.image_id * 1e9 / SETTINGS["fps"]))
        R_ned_body = R_from_q_wxyz(own.q_ned_body_wxyz)
        assert frame.R_cam_world is not None
        assert frame.t_cam_world_m is not None
        assert np.degrees(rotation_angle(R_ned_body @ R_body_cam, frame.R_cam_world.T)) < 0.02
        camera = -frame.R_cam_world.T @ frame.t_cam_world_m
        np.testing.assert_allclose(own.t_ned_body_m + R_ned_body @ lever, camera, atol=0.01)


def test_telemetry_agrees_with_itself(telemetry: Telemetry) -> None:
    dt = np.diff(telemetry.t_ns)[:, None] * 1e-9
    np.testing.assert_allclose(dt, 0.02)
    assert telemetry.t_ns[0] == -1_000_000_000
    assert telemetry.t_ns[-1] >= round(150 / FPS * 1e9) + 900_000_000
    R = R_from_q_wxyz(telemetry.values[:, :4])
    middle = lambda a: 0.5 * (a[1:] + a[:-1])  # noqa: E731
    turned = so3_log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) / dt
    np.testing.assert_allclose(turned, middle(telemetry.values[:, 4:7]), atol=2e-3)
    position, velocity = telemetry.values[:, 7:10], telemetry.values[:, 10:13]
    np.testing.assert_allclose(np.diff(position, axis=0) / dt, middle(velocity), atol=0.1)
    north_m = np.radians(telemetry.values[:, 13] - telemetry.values[0, 13]) * 6_367_000
    np.testing.assert_allclose(north_m, position[:, 0] - position[0, 0], rtol=0.005, atol=0.05)
    np.testing.assert_allclose(telemetry.values[:, 15] + position[:, 2], SETTINGS["origin_lat_lon_alt"][2], atol=2e-3)


def test_the_target_flies_coordinated_turns(scene: BopScene) -> None:
    R, t = _target_in_ned(scene)
    velocity = np.gradient(t, 1 / SETTINGS["fps"], axis=0)[2:-2]
    speed = np.linalg.norm(velocity, axis=1)
    np.testing.assert_allclose(speed, speed.mean(), rtol=0.005)
    nose = R[2:-2, :, 0]
    assert np.degrees(np.arccos(np.sum(nose * velocity, axis=1) / speed)).max() < 4
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    rate = np.gradient(heading, 1 / SETTINGS["fps"])[2:-2]
    bank = euler_from_R(R[2:-2])[0][2:-2]
    expected = np.arctan(rate * speed[2:-2] / GRAVITY_MPS2)
    assert np.degrees(np.abs(bank - expected)).max() < 2.0
    assert np.degrees(np.ptp(bank)) > 8


def test_the_seed_makes_the_same_pictures(scene: BopScene) -> None:
    rendered = render_frame(crossing(SETTINGS["seed"]).scenes()[77], SENSOR)
    stored = scene.image_bgr(scene.frames[77])
    assert np.abs(rendered.image_bgr.astype(np.int16) - stored).mean() < 2.0
    mask = scene.mask(scene.frames[77], 0)
    assert mask is not None
    assert np.mean(mask[rendered.targets[0].mask_visib]) > 0.98
    assert mask.sum() == pytest.approx(rendered.targets[0].mask_visib.sum(), rel=0.02)
