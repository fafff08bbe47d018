"""Sequences through the daemon's tracker: what is withheld, what is held, and what own attitude is good for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.config_estimator import EstimatorSettings
from edge.errors import InputError
from edge.estimator.pace import Pace
from edge.links import outgoing
from msgs.contract import ScoreCalibration
from sim_replay import metrics
from sim_replay.bop import read_scene
from sim_replay.datasets import open_dataset
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.evaluation import tracked
from sim_replay.evaluation.judge import JudgedFrame, judge_frames
from sim_replay.evaluation.own_ship import OwnShipErrors
from sim_replay.evaluation.tracked import tracker_answers
from sim_replay.offline import SHIPPED_MODEL, load_model
from trainer.graph import read_contract, write_contract

FRAMES = 14
FOCAL_PX, CX_PX, CY_PX = 2400.0, 959.5, 539.5
SPOT_Z_M, SPOT_SIZE_M = 200.0, 12.0  # as the network of the dark_spot_model fixture says of every spot
K = np.array([[FOCAL_PX, 0, CX_PX], [0, FOCAL_PX, CY_PX], [0, 0, 1]])


def write_scene(
    folder: Path, yaws_deg: list[float], east_m: float = 0.0, step_m: float = 0.0, joined_in: int | None = None
) -> None:
    """A spot before a camera that stands at (10, 20, -30) in ned and turns about the vertical.

    It stands still, at first so far east of north, or flies east by so much a frame. From the image `joined_in` on
    there is another, clearer one, 40 m east of it.
    """
    (folder / "rgb").mkdir(parents=True)
    t_ned_cam_m = np.array([10.0, 20.0, -30.0])
    cameras, poses = {}, dict[str, list[dict[str, object]]]()
    for image, yaw_deg in enumerate(yaws_deg):
        R_ned_cam = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
        picture, poses[str(image)] = np.full((1080, 1920, 3), 240, np.uint8), []
        for apart_m in (0.0, 40.0) if joined_in is not None and image >= joined_in else (0.0,):
            t_m = R_ned_cam.T @ np.array([SPOT_Z_M, east_m + image * step_m + apart_m, 0.0])
            u, v, _ = K @ t_m / t_m[2]
            cv2.ellipse(picture, (round(u), round(v)), (70, 14), 0, 0, 360, (90, 90, 90), -1, cv2.LINE_AA)
            cv2.circle(picture, (round(u), round(v)), 6 if apart_m else 2, (5, 5, 5), -1, cv2.LINE_AA)
            pose = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": (1e3 * t_m).tolist()}
            poses[str(image)].append(pose)
        cv2.imwrite(str(folder / "rgb" / f"{image:06d}.png"), picture)
        cameras[str(image)] = {
            "cam_K": K.ravel().tolist(),
            "cam_R_w2c": R_ned_cam.T.ravel().tolist(),
            "cam_t_w2c": (-1e3 * R_ned_cam.T @ t_ned_cam_m).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(poses))
    models = folder.parents[1] / "models"
    models.mkdir(exist_ok=True)
    (models / "models_info.json").write_text(json.dumps({"1": {"diameter": SPOT_SIZE_M * 1e3}}))


def flown(dataset_folder: Path, model: Path) -> list[JudgedFrame]:
    dataset = open_dataset(dataset_folder)
    answers = tracker_answers(load_model(model, threads=1), own_ship="exact")
    return judge_frames(list(dataset.frames()), dataset.models, answers)


def told(results: list[JudgedFrame]) -> list[bool]:
    return [frame.matches[0].estimate is not None for frame in results]


def test_each_scene_begins_anew_with_what_is_not_confirmed_yet(
    tmp_path: Path, dark_spot_model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for scene in ("000000", "000001"):
        write_scene(tmp_path / "data" / "test" / scene, [0.5] * 5)
    results = flown(tmp_path / "data", dark_spot_model)
    assert told(results) == [False, False, True, True, True] * 2
    assert all(frame.measured[0].estimate is not None for frame in results)
    (guessed,) = [record.getMessage() for record in caplog.records if "sequence.toml" in record.getMessage()]
    assert "000000 (and each other scene without sequence.toml): taken as 30 frames a second" in guessed


def test_a_model_whose_scores_were_not_calibrated_tells_its_targets_all_the_same(tmp_path: Path) -> None:
    raw = Path(shutil.copy(SHIPPED_MODEL, tmp_path))
    uncalibrated = {"acquire_score": ScoreCalibration(), "track_score": ScoreCalibration()}
    lenient = {"acquire_score_min": 0.3, "track_score_min": 0.3}
    write_contract(raw, read_contract(raw).model_copy(update=uncalibrated | lenient))
    answer = tracker_answers(load_model(raw, threads=2))
    answers = [
        answer(i, picture) for i, picture in zip(range(6), open_dataset(BUNDLED_SEQUENCE, None).frames(), strict=False)
    ]
    assert len(answers[-1].poses) == 1


@pytest.mark.parametrize(
    ("score", "sent"),
    [(0.6, [False, False, False, False]), (0.9, [False, False, True, True]), (0.97, [False, True, True, True])],
)
def test_a_track_is_told_where_its_score_is_high_enough_to_be_sent(
    tmp_path: Path, dark_spot_model: Path, score: float, sent: list[bool]
) -> None:
    write_scene(tmp_path / "data" / "test" / "000000", [0.5] * 4)
    model = Path(shutil.copy(dark_spot_model, tmp_path))
    always = ScoreCalibration(offset=float(np.log(score / (1.0 - score))), slope=1e-6, size_slope=0.0)
    calibrated = {"acquire_score": always, "track_score": always}
    write_contract(model, read_contract(model).model_copy(update=calibrated))
    assert told(flown(tmp_path / "data", model)) == sent


def test_a_rotation_that_no_link_would_tell_is_not_known(
    tmp_path: Path, dark_spot_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scene(tmp_path / "data" / "test" / "000000", [0.5] * 4)
    monkeypatch.setattr(outgoing, "UNSURE_ROTATION_RAD", 0.0)
    last = flown(tmp_path / "data", dark_spot_model)[-1].matches[0].estimate
    assert last is not None
    assert not last.rotation_known
    monkeypatch.undo()
    results = flown(tmp_path / "data", dark_spot_model)
    assert [m.estimate is not None and m.estimate.rotation_known for m in results[-1].matches] == [True]


def test_a_target_that_leaves_its_window_between_two_frames_is_tracked(
    tmp_path: Path, dark_spot_model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It flies 90 m/s across five pictures a second: how fast, no window around its first place can tell."""
    scene = tmp_path / "data" / "test" / "000000"
    write_scene(scene, [0.0] * 8, east_m=-63.0, step_m=18.0)
    (scene / "sequence.toml").write_text("fps = 5.0\n")
    assert told(flown(tmp_path / "data", dark_spot_model)) == [False, False, *[True] * 6]
    assert "taken as" not in caplog.text


def test_one_that_joins_is_examined_in_the_frame_after_the_search_as_in_the_daemon(
    tmp_path: Path, dark_spot_model: Path
) -> None:
    """The search for more targets only proposes places."""
    searched = EstimatorSettings().acquire_every_n
    write_scene(tmp_path / "data" / "test" / "000000", [0.5] * (searched + 2), joined_in=searched - 3)
    results = flown(tmp_path / "data", dark_spot_model)
    measured = [[match.estimate is not None for match in frame.measured] for frame in results]
    assert measured[searched - 4 :] == [[True], *[[True, False]] * 4, [True, True]]


def test_own_attitude_takes_the_cameras_shaking_out_of_the_track(tmp_path: Path, dark_spot_model: Path) -> None:
    """The camera swings by 4 degrees between frames; a sequence.toml says that the scene's world is ned."""
    scene = tmp_path / "data" / "test" / "000000"
    write_scene(scene, [2.0 * (-1) ** k for k in range(FRAMES)])

    def worst_deg() -> float:
        matches = [frame.matches[0] for frame in flown(tmp_path / "data", dark_spot_model)[2:]]
        assert all(match.estimate is not None for match in matches)
        return max(
            float(metrics.bearing_error_deg(match.estimate.t_cam_target_m, match.truth.t_cam_target_m))
            for match in matches
            if match.estimate is not None
        )

    (scene / "sequence.toml").write_text("fps = 30.0\n")
    assert worst_deg() < 0.1
    (scene / "sequence.toml").unlink()
    blind = flown(tmp_path / "data", dark_spot_model)
    errors_deg = [
        float(metrics.bearing_error_deg(pose.t_cam_target_m, frame.matches[0].truth.t_cam_target_m))
        for frame in blind
        for pose in (*frame.false_poses, *(m.estimate for m in frame.matches if m.estimate is not None))
    ]
    assert not all(told(blind)[2:]) or max(errors_deg) > 0.1


def test_the_own_ship_is_told_as_an_autopilot_would_with_a_flights_errors_at_the_cameras_own_rates(
    tmp_path: Path,
) -> None:
    """It flies north at 30 m/s and turns right by 20 degrees a second, seen ten times a second."""
    scene = tmp_path / "data" / "test" / "000003"
    write_scene(scene, [2.0 * image for image in range(4)])
    cameras = json.loads((scene / "scene_camera.json").read_text())
    true = []
    for image, camera in enumerate(cameras.values()):
        R_cam_ned, t_ned_m = np.reshape(camera["cam_R_w2c"], (3, 3)), np.array([3.0 * image, 20.0, -30.0])
        camera["cam_t_w2c"] = (-1e3 * R_cam_ned @ t_ned_m).tolist()
        true.append((R_cam_ned.T, t_ned_m))
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "sequence.toml").write_text("fps = 10.0\n")
    errors = OwnShipErrors.of_flight("000003")
    exact, usual = (tracked._Sequence.of(read_scene(scene), told) for told in ("exact", "usual"))
    for image, (R_ned_cam, t_ned_m) in enumerate(true):
        seen = exact.own_ship(image)
        np.testing.assert_allclose(seen.R_ned_body, R_ned_cam, atol=1e-9)
        np.testing.assert_allclose(seen.t_ned_body_m, t_ned_m, atol=1e-9)
        off = usual.own_ship(image)
        R = errors.attitude(R_ned_cam, np.array([0.0, 0.0, np.deg2rad(20.0)]))
        np.testing.assert_allclose(off.R_ned_body, R, atol=1e-9)
        np.testing.assert_allclose(off.t_ned_body_m, errors.position(t_ned_m, np.array([30.0, 0.0, 0.0])), atol=1e-9)


@pytest.mark.parametrize("text", ["", "fps = 0\n", "fps = 'fast'\n", "fps = "])
def test_a_sequence_without_a_frame_rate_is_named(tmp_path: Path, dark_spot_model: Path, text: str) -> None:
    scene = tmp_path / "data" / "test" / "000000"
    write_scene(scene, [0.0])
    (scene / "sequence.toml").write_text(text)
    with pytest.raises(InputError, match=r"sequence\.toml: 'fps'"):
        flown(tmp_path / "data", dark_spot_model)


def write_gapped_scene(folder: Path, numbers: list[int], frames: list[int]) -> None:
    """A spot that flies east by 4 m a frame, of another's making: the pictures of those frames, so numbered."""
    write_scene(folder, [0.5] * (frames[-1] + 1), east_m=-10.0, step_m=4.0)
    for path in sorted((folder / "rgb").iterdir()):
        path.rename(path.with_stem(f"frame_{int(path.stem)}"))
    for number, frame in zip(numbers, frames, strict=True):
        (folder / "rgb" / f"frame_{frame}.png").rename(folder / "rgb" / f"{number:06d}.png")
    for name in ("scene_camera.json", "scene_gt.json"):
        entries = json.loads((folder / name).read_text())
        kept = {str(number): entries[str(frame)] for number, frame in zip(numbers, frames, strict=True)}
        (folder / name).write_text(json.dumps(kept))


FRAMES_KEPT = [*range(8), *range(14, 20)]


@pytest.mark.parametrize(
    "numbers",
    [
        FRAMES_KEPT,
        [12 * frame for frame in FRAMES_KEPT],
        [1_700_000_000_000_000 + 33_333 * frame + 7 * (frame % 3) for frame in FRAMES_KEPT],  # microseconds
    ],
)
def test_frames_left_out_of_a_scene_are_time_that_passed(
    tmp_path: Path, dark_spot_model: Path, numbers: list[int]
) -> None:
    """Without it a target jumps where pictures are missing, and the tracker is blamed for it."""
    write_gapped_scene(tmp_path / "data" / "test" / "000000", numbers, FRAMES_KEPT)
    results = flown(tmp_path / "data", dark_spot_model)
    errors_m = [frame.matches[0].translation_error_m for frame in results]
    assert all(error_m is not None and error_m < 3.0 for error_m in errors_m[3:]), errors_m
    assert told(results)[8:] == [True] * 6


def test_the_tracker_sees_the_images_between_those_that_are_evaluated_too(
    tmp_path: Path, dark_spot_model: Path
) -> None:
    """BOP's lists of targets leave out most images of a sequence; on every fourth alone no track is confirmed."""
    write_scene(tmp_path / "data" / "test" / "000000", [0.5] * 8)
    names = [{"scene_id": 0, "im_id": image, "obj_id": 1, "inst_count": 1} for image in (3, 7)]
    (tmp_path / "data" / "test_targets_bop19.json").write_text(json.dumps(names))
    results = flown(tmp_path / "data", dark_spot_model)
    assert [frame.picture.image_id for frame in results] == [3, 7]
    assert told(results) == [True, True]


def test_where_frames_are_missing_the_camera_is_as_fast_as_elsewhere(
    tmp_path: Path, dark_spot_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon evaluates each target twice if the camera is slow, not where frames were dropped."""
    unhurried, noted = Pace.unhurried, []
    monkeypatch.setattr(Pace, "unhurried", lambda pace, meta: noted.append(unhurried(pace, meta)) or noted[-1])
    numbers = [*range(5), 11, 14]
    write_gapped_scene(tmp_path / "data" / "test" / "000000", numbers, numbers)
    flown(tmp_path / "data", dark_spot_model)
    assert noted == [False] * len(numbers)


@pytest.mark.parametrize("apart", [1, 12])
def test_of_frames_of_which_fewer_than_half_were_kept_no_time_is_lost(apart: int) -> None:
    kept = np.flatnonzero(np.random.default_rng(3).random(400) < 0.4)
    assert tracked._by_number([apart * int(frame) for frame in kept]) == (kept - kept[0]).tolist()
