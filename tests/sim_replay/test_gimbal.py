"""A sequence filmed from a gimbal is played true to geometry: what the autopilot gets holds the camera's attitude."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from edge.errors import InputError
from sim_replay.gimbal import GimbalTrack, looped, read_gimbal, track_of, write_gimbal
from sim_replay.ground_truth import read_sequence
from sim_replay.play import PlaySettings, play
from sim_replay.telemetry import Telemetry, TelemetryError, write_telemetry
from tests.edge.toy_model import write_toy_model
from tests.edge.toy_scene import FOCAL_PX, draw

FRAMES, FPS = 60, 10.0
SIZE_WH = (640, 384)
K = np.array([[FOCAL_PX, 0.0, 319.5], [0.0, FOCAL_PX, 191.5], [0.0, 0.0, 1.0]])
R_AHEAD_CAM = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
TO_TARGET_NED = np.array([0.6, -0.75, -0.1])


def R_ned_body(t_s: np.ndarray) -> Rotation:
    """It yaws and rolls far more than the picture does."""
    angles = [0.3 * np.sin(1.1 * t_s), 0.05 + 0.0 * t_s, 0.5 * np.sin(1.7 * t_s)]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=-1))


def R_ned_cam(t_s: np.ndarray) -> Rotation:
    """At the target, but for a degree or so."""
    heading, pitch = np.arctan2(TO_TARGET_NED[1], TO_TARGET_NED[0]), 0.1
    angles = [heading + 0.02 * np.sin(1.5 * t_s), pitch + 0.01 * np.cos(1.9 * t_s), 0.05 * np.sin(t_s)]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=-1)) * R_AHEAD_CAM


@pytest.fixture
def gimbal_sequence(tmp_path: Path) -> Path:
    """A still target seen by a toy: the own ship stays in place, turns and rolls, and its gimbal makes up for it."""
    folder = tmp_path / "dataset" / "test" / "000000"
    (folder / "rgb").mkdir(parents=True)
    (tmp_path / "dataset" / "models").mkdir()
    (tmp_path / "dataset" / "models" / "models_info.json").write_text("{}")
    cameras = {}
    for frame, turned in enumerate(R_ned_cam(np.arange(FRAMES) / FPS)):
        ray = K @ turned.inv().apply(TO_TARGET_NED)
        center = np.floor(ray[:2] / ray[2]) + 0.5
        cv2.imwrite(str(folder / "rgb" / f"{frame:06d}.png"), draw((center[0], center[1]), SIZE_WH))
        R_w2c = turned.inv().as_matrix().ravel().tolist()
        cameras[str(frame)] = {
            "cam_K": K.ravel().tolist(),
            "depth_scale": 1.0,
            "cam_R_w2c": R_w2c,
            "cam_t_w2c": [0] * 3,
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps({str(frame): [] for frame in range(FRAMES)}))
    t_s = np.arange(-1.0, FRAMES / FPS + 1.0, 0.02)
    values = np.zeros((len(t_s), 16))
    values[:, :4] = np.roll(R_ned_body(t_s).as_quat(), 1, axis=1)
    values[:, 13:] = (47.0, 8.0, 500.0)
    write_telemetry(folder / "telemetry.csv", Telemetry(np.round(t_s * 1e9).astype(np.int64), values))
    first = (R_ned_body(np.zeros(1))[0].inv() * R_ned_cam(np.zeros(1))[0]).as_matrix().tolist()
    (folder / "sequence.toml").write_text(
        f'fps = {FPS}\nt0_ns = 0\nmount = "gimbal"\nR_body_cam = {first}\nt_body_cam_m = [0.0, 0.0, 0.0]\n'
    )
    return folder


def test_the_autopilot_gets_the_cameras_attitude_of_each_frame(gimbal_sequence: Path, tmp_path: Path) -> None:
    model = write_toy_model(tmp_path / "toy.onnx")
    recording = play(PlaySettings(read_sequence(gimbal_sequence), tmp_path / "out", model), lambda *_: None)
    with_attitude = [one for one in recording.targets if any(one["q_ned_cam_wxyz"])]
    assert len(with_attitude) > 5, f"{len(recording.targets)} of them without"
    t_s = np.array([(recording.capture_ns(one) - recording.start_at_ns) / 1e9 for one in with_attitude])
    told = Rotation.from_quat(np.roll([one["q_ned_cam_wxyz"] for one in with_attitude], -1, axis=1))
    assert np.degrees((told.inv() * R_ned_cam(t_s)).magnitude()).max() < 0.5
    # Seen with the own ship's attitude alone, the target would swing with it.
    seen = np.array([one["t_cam_target_m"] for one in with_attitude])
    directions = told.apply(seen / np.linalg.norm(seen, axis=1, keepdims=True))
    away = np.degrees(np.arccos(np.clip(directions @ (TO_TARGET_NED / np.linalg.norm(TO_TARGET_NED)), -1.0, 1.0)))
    assert np.median(away) < 0.5


def test_a_gimbal_sequence_without_the_cameras_attitude_is_refused(gimbal_sequence: Path) -> None:
    path = gimbal_sequence / "scene_camera.json"
    cameras = json.loads(path.read_text())
    del cameras["3"]["cam_R_w2c"]
    path.write_text(json.dumps(cameras))
    with pytest.raises(InputError, match=f"{path}: 'cam_R_w2c' is missing"):
        read_sequence(gimbal_sequence)


def test_over_frames_that_were_not_recorded_it_turns_on(gimbal_sequence: Path) -> None:
    with (gimbal_sequence / "sequence.toml").open("a") as file:
        file.write('source = "flight.mcap"\n')
    for frame in range(FRAMES):
        if frame % 3:
            (gimbal_sequence / "rgb" / f"{frame:06d}.png").unlink()
    track = read_sequence(gimbal_sequence).gimbal
    assert track is not None
    t_s = np.linspace(0.0, (FRAMES - 3) / FPS, 200)
    told = np.array([np.roll(track.at(round(t * 1e9)), -1) for t in t_s])
    turned = R_ned_cam(t_s) * R_AHEAD_CAM.inv()
    assert np.degrees((Rotation.from_quat(told).inv() * turned).magnitude()).max() < 0.1


@settings(deadline=None)
@given(st.integers(2, 12), st.integers(0, 10**9), st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
def test_between_frames_it_turns_as_scipy_says(count: int, frame0_ns: int, place: float, seed: int) -> None:
    R_cam_ned = Rotation.random(count, random_state=seed)
    track = track_of(list(R_cam_ned.as_matrix()), frame0_ns, FPS)
    t_ns = frame0_ns + round(place * (count - 1) / FPS * 1e9)
    expected = Slerp(track.t_ns, R_cam_ned.inv() * R_AHEAD_CAM.inv())(np.clip(t_ns, track.t_ns[0], track.t_ns[-1]))
    told = Rotation.from_quat(np.roll(track.at(t_ns), -1))
    steps = (R_cam_ned[:-1] * R_cam_ned[1:].inv()).magnitude()
    if steps.max() < np.pi - 1e-2:  # half a turn has no one way
        assert (told.inv() * expected).magnitude() < 1e-6


def test_it_is_written_read_and_looped(tmp_path: Path) -> None:
    track = track_of(list(Rotation.random(5, random_state=3).as_matrix()), 7_000_000, FPS)
    write_gimbal(tmp_path / "gimbal.csv", track)
    read = read_gimbal(tmp_path / "gimbal.csv")
    np.testing.assert_array_equal(read.t_ns, track.t_ns)
    np.testing.assert_allclose(read.q_ned_gimbal_wxyz, track.q_ned_gimbal_wxyz, atol=1e-8)
    twice = looped(track, 7_000_000, 0.5, 2)
    np.testing.assert_allclose(twice.at(600_000_000), track.at(107_000_000))
    assert isinstance(twice, GimbalTrack)
    (tmp_path / "gimbal.csv").write_text("t_ns\n1\n")
    with pytest.raises(TelemetryError, match=r"gimbal\.csv"):
        read_gimbal(tmp_path / "gimbal.csv")
