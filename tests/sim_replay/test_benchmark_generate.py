"""Datasets made by real processes: whole, labelled truly, the same however often they were stopped."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs.geometry import R_from_q_wxyz, rotation_angle, so3_log
from sim_replay.bop import BopFrame, BopScene, read_ply_vertices_m, read_scene
from sim_replay.cli import main
from sim_replay.ground_truth import read_sequence
from sim_replay.telemetry import read_telemetry
from tests.waiting import until

PRESET = """
name = "tiny"
size_wh_px = [480, 270]
sequence_frames = [4, 5]
fps = [10.0]
[splits]
train = { sequences = 2, frames = 8 }
test = { sequences = 1, frames = 5 }
[airframes]
only = ["light_aircraft", "male_v_tail"]
[lens]
focal_px = [300, 2000]
box_share = 0.02
distorted_share = 0.5
[flight]
gimbal_share = 0.5
[targets]
two_share = 0.34
[picture]
weather = { clear = 1, overcast = 1 }
quality = { ordinary = 1 }
[[compression]]
jpeg_quality = [80, 90]
[[compression]]
h264_kbps = [400, 400]
"""
# Workers import what was started anew: of `python -m sim_replay.cli` all, of the command little.
PROGRAM = (str(Path(sys.executable).parent / "uavpose-replay"), "generate")
SCENES = ("train/000000", "train/000001", "test/000002")
WITHIN_S = 150.0  # a dataset is drawn in software, by a machine that may be busy


@pytest.fixture(scope="module")
def preset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("preset") / "tiny.toml"
    path.write_text(PRESET)
    return path


def _generate(preset: Path, out: Path, *more: str) -> int:
    words = [*PROGRAM, "--preset", str(preset), "--out", str(out), "--seed", "3", *more]
    return subprocess.run(words, stderr=subprocess.DEVNULL, timeout=200).returncode


@pytest.fixture(scope="module")
def dataset(preset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made in one go by one worker."""
    out = tmp_path_factory.mktemp("whole") / "tiny"
    assert _generate(preset, out, "--workers", "1") == 0
    return out


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    until(lambda: path.exists() or process.poll() is not None, what=str(path), within_s=WITHIN_S)
    assert process.poll() is None, "it ended before it was stopped"


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_files_are_those_of_the_format(dataset: Path) -> None:
    manifest = tomllib.loads((dataset / "dataset.toml").read_text())
    assert manifest["complete"] is True
    assert manifest["splits"] == {"train": {"sequences": 2, "frames": 8}, "test": {"sequences": 1, "frames": 5}}
    assert "--seed 3" in manifest["command"]
    assert manifest["packages"]["jsbsim"]
    for name in SCENES:
        scene = read_scene(dataset / name)
        assert not (dataset / name / ".part").exists()
        for frame in scene.frames:
            assert scene.image_bgr(frame).shape == (270, 480, 3)
            assert len(frame.targets) >= 1
        rgb = sorted(path.stem for path in (dataset / name / "rgb").iterdir())
        assert rgb == [f"{frame.image_id:06d}" for frame in scene.frames]


def test_every_sequence_can_be_flown(dataset: Path) -> None:
    for name in SCENES:
        played = read_sequence(dataset / name)
        telemetry = read_telemetry(played.telemetry_csv)
        assert np.diff(telemetry.t_ns).max() <= 20_000_001
        last_ns = (len(played.scene.images) - 1) / played.fps * 1e9
        assert telemetry.t_ns[0] <= -1e9
        assert telemetry.t_ns[-1] >= last_ns + 1e9


def test_a_bolted_cameras_pose_is_the_own_ships_through_its_mount(dataset: Path) -> None:
    fixed = 0
    for name in SCENES:
        settings = tomllib.loads((dataset / name / "sequence.toml").read_text())
        if settings["mount"] != "fixed":
            continue
        fixed += 1
        telemetry = read_telemetry(dataset / name / "telemetry.csv")
        R_body_cam, lever = np.array(settings["R_body_cam"]), np.array(settings["t_body_cam_m"])
        for frame in read_scene(dataset / name).frames:
            assert frame.R_cam_world is not None
            assert frame.t_cam_world_m is not None
            own = telemetry.at(round(frame.image_id / settings["fps"] * 1e9))
            R_ned_body = R_from_q_wxyz(own.q_ned_body_wxyz)
            # The camera trembles on its mount.
            assert rotation_angle(R_ned_body @ R_body_cam, frame.R_cam_world.T) < 2e-3
            t_ned_cam_m = -frame.R_cam_world.T @ frame.t_cam_world_m
            np.testing.assert_allclose(t_ned_cam_m, own.t_ned_body_m + R_ned_body @ lever, atol=0.02)
    assert fixed >= 1


def test_the_mount_of_a_bolted_camera_is_what_it_trembles_about(tmp_path: Path) -> None:
    text = (
        PRESET.replace("[4, 5]", "[60, 60]").replace("frames = 8", "frames = 120").replace("frames = 5", "frames = 60")
    )
    preset = tmp_path / "long.toml"
    preset.write_text(text.replace("gimbal_share = 0.5", "gimbal_share = 0.0"))
    out = tmp_path / "long"
    assert _generate(preset, out, "--labels-only", "--split", "train", "--workers", "1") == 0
    for name in ("train/000000", "train/000001"):
        settings = tomllib.loads((out / name / "sequence.toml").read_text())
        assert settings["mount"] == "fixed"
        telemetry = read_telemetry(out / name / "telemetry.csv")
        trembling = []
        for frame in read_scene(out / name).frames:
            own = telemetry.at(round(frame.image_id / settings["fps"] * 1e9))
            assert frame.R_cam_world is not None
            R_body_cam = R_from_q_wxyz(own.q_ned_body_wxyz).T @ frame.R_cam_world.T
            trembling.append(so3_log(np.array(settings["R_body_cam"]).T @ R_body_cam))
        rms_rad = np.sqrt(np.mean(np.square(trembling), axis=0))
        assert np.all(np.abs(np.mean(trembling, axis=0)) < 0.35 * rms_rad)


def _projected(dataset: Path, frame: BopFrame, k: int) -> np.ndarray:
    """OpenCV's projection of the exported model's vertices, [V, 2]."""
    target = frame.targets[k]
    points = read_ply_vertices_m(dataset / "models" / f"obj_{target.object_id:06d}.ply").astype(np.float64)
    rvec = cv2.Rodrigues(target.R_cam_target)[0]
    lens = np.zeros(5) if frame.distortion is None else np.array(frame.distortion)
    return cv2.projectPoints(points, rvec, target.t_cam_target_m, frame.K, lens)[0].reshape(-1, 2)


def _mask_box(scene: BopScene, frame: BopFrame, k: int) -> np.ndarray:
    mask = scene.mask(frame, k)
    assert mask is not None
    rows, columns = np.nonzero(mask)
    return np.array([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])


def test_labels_agree_with_opencv_and_with_the_masks(dataset: Path) -> None:
    distorted = 0
    for name in SCENES:
        scene = read_scene(dataset / name)
        for frame in scene.frames:
            distorted += frame.distortion is not None
            for k, target in enumerate(frame.targets):
                box, mask_box = target.box_visible_xyxy_px, _mask_box(scene, frame, k)
                assert box is not None
                np.testing.assert_allclose(box, mask_box, atol=2.0)  # thin tips cover less than a quarter of a pixel
                assert target.visible_px == scene.mask(frame, k).sum()  # type: ignore[union-attr]
                pixels = _projected(dataset, frame, k)
                # The propeller's disc is in the model but in no mask: the outline holds the box, not the reverse.
                assert (pixels.min(axis=0) <= box[:2] + 1.0).all()
                assert (pixels.max(axis=0) >= box[2:] - 1.0).all()
    assert distorted >= 1


def test_boxes_are_as_large_as_the_preset_says(dataset: Path) -> None:
    shares = []
    for name in SCENES:
        for frame in read_scene(dataset / name).frames:
            box = frame.targets[0].box_visible_xyxy_px
            assert box is not None
            shares.append(np.prod(box[2:] - box[:2]) / (480 * 270))
    assert np.mean(shares) == pytest.approx(0.02, abs=0.002)


def test_killed_and_resumed_by_more_workers_it_has_the_same_bytes(preset: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny"
    words = [*PROGRAM, "--preset", str(preset), "--out", str(out), "--seed", "3", "--workers", "2"]
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    _wait_for(out / "train" / "000000" / "rgb" / "000001.jpg", process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    until(lambda: not any(_runs(int(child)) for child in children), what="its workers to end")
    # What was finished is readable and has its labels, whatever the instant.
    scene = read_scene(out / "train" / "000000")
    assert len(scene.frames) >= 1
    assert all(frame.targets for frame in scene.frames)
    assert all(scene.image_bgr(frame).shape == (270, 480, 3) for frame in scene.frames)
    assert _generate(preset, out) == 2  # not without --resume
    assert _generate(preset, out, "--resume", "--workers", "2") == 0
    assert _digests(out) == _digests(dataset)


def test_interrupted_it_ends_its_frames_and_leaves_no_process(preset: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny"
    words = [*PROGRAM, "--preset", str(preset), "--out", str(out), "--seed", "3", "--sequences", "0"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE)
    _wait_for(out / "train" / "000000" / "rgb" / "000000.jpg", process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGTERM)
    assert b"--resume goes on" in process.communicate(timeout=WITHIN_S)[1]
    assert process.returncode == 130
    assert children
    until(lambda: not any(_runs(int(child)) for child in children), what="its workers to end")
    assert tomllib.loads((out / "dataset.toml").read_text())["complete"] is False
    scene = read_scene(out / "train" / "000000")
    assert len(list((out / "train" / "000000" / "rgb").iterdir())) == len(scene.frames) < 4


def test_labels_alone_are_the_same_labels(preset: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "labels"
    chosen = ("--labels-only", "--split", "train", "--sequences", "1-2", "--workers", "1")
    assert main(["generate", "--preset", str(preset), "--out", str(out), "--seed", "3", *chosen]) == 0
    assert [path.name for path in out.glob("*/*/") if path.parent.name != "models"] == ["000001"]
    for drawn, named in zip(read_scene(dataset / "train/000001").frames, read_scene(out / "train/000001").frames,
                            strict=True):  # fmt: skip
        np.testing.assert_array_equal(drawn.K, named.K)
        for a, b in zip(drawn.targets, named.targets, strict=True):
            np.testing.assert_array_equal(a.R_cam_target, b.R_cam_target)
            np.testing.assert_array_equal(a.t_cam_target_m, b.t_cam_target_m)
            assert a.box_visible_xyxy_px is not None
            assert b.box_visible_xyxy_px is not None
            np.testing.assert_allclose(a.box_visible_xyxy_px, b.box_visible_xyxy_px, atol=1.01)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--sequences", "0-99"], "--sequences: '0-99' is not within 0-2"),
        (["--sequences", "x"], "--sequences: 'x' is neither a number nor a range"),
        (["--split", "val"], "no sequence is in both"),
        (["--workers", "0"], "--workers: must be at least 1"),
        (["--resume", "--every", "2"], "dataset.toml: every is 1 there and 2 now"),
        (["--resume", "--seed", "4"], "dataset.toml: seed is 3 there and 4 now"),
        ([], "--resume goes on with it"),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(
    preset: Path, dataset: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    before = _digests(dataset)
    words = ["generate", "--preset", str(preset), "--out", str(dataset), *([] if "--seed" in more else ["--seed", "3"])]
    assert main([*words, *more]) == 2
    assert said in capsys.readouterr().err
    assert _digests(dataset) == before


def test_a_folder_of_something_else_is_left_alone(preset: Path, tmp_path: Path) -> None:
    (tmp_path / "letters.txt").write_text("dear")
    assert main(["generate", "--preset", str(preset), "--out", str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["letters.txt"]


def test_the_lenses_chosen_are_written_down(dataset: Path) -> None:
    focal_px = json.loads((dataset / "lenses.json").read_text())
    for number, name in enumerate(SCENES):
        assert read_scene(dataset / name).frames[0].K[0, 0] == pytest.approx(focal_px[str(number)], abs=1e-6)


def test_fewer_pictures_of_a_stream_are_no_clearer_than_all_of_them(tmp_path: Path) -> None:
    preset = tmp_path / "stream.toml"
    streamed = PRESET[: PRESET.index("[[compression]]")] + "[[compression]]\nh264_kbps = [100, 100]\n"
    streamed = streamed.replace("sequence_frames = [4, 5]", "sequence_frames = [9, 9]")
    streamed = streamed.replace("train = { sequences = 2, frames = 8 }", "train = { sequences = 1, frames = 9 }")
    preset.write_text(streamed.replace("test = { sequences = 1, frames = 5 }", "test = { sequences = 1, frames = 9 }"))
    for name, every in (("all", "1"), ("fourths", "4")):
        assert _generate(preset, tmp_path / name, "--split", "train", "--every", every, "--workers", "1") == 0

    def detail(name: str, number: int) -> float:
        picture = cv2.imread(str(next((tmp_path / name).glob(f"train/*/rgb/{number:06d}.*"))), cv2.IMREAD_GRAYSCALE)
        return float(np.abs(cv2.Laplacian(picture, cv2.CV_32F)).mean())

    for number in (4, 8):
        assert detail("fourths", number) < 1.3 * detail("all", number)
