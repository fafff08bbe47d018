"""`uavpose-edge calibrate` on boards rendered through cameras that are known exactly."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML  # as rosbags reads what ROS writes

from edge.calibrate_board import DRAWN_SQUARE_PX, BoardSettings, draw_board
from edge.cameras.intrinsics import load_intrinsics
from edge.config_camera import IntrinsicsSettings

from .conftest import Cli

SIZE_WH = (960, 600)
K = np.array([[820.0, 0, 471.3], [0, 826.0, 309.8], [0, 0, 1]])
DISTORTION = np.array([-0.21, 0.06, 0.0012, -0.0009, 0.0])
SQUARES = (9, 6)
FINE = 2
HELD_FRAMES = 3  # of a video, of each view


@cache
def rays_xy() -> np.ndarray:
    """Of FINE x FINE points in every pixel [H, W, 2], through the lens."""
    columns, rows = np.meshgrid(np.arange(SIZE_WH[0] * FINE), np.arange(SIZE_WH[1] * FINE))
    pixels = (np.stack([columns, rows], axis=-1).reshape(-1, 1, 2) + 0.5) / FINE - 0.5
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 1e-7)
    straight = cv2.undistortPoints(pixels.astype(np.float64), K, DISTORTION, criteria=criteria)
    return np.asarray(straight).reshape(*columns.shape, 2)


def rendered(board: np.ndarray, rvec_rad: np.ndarray, t_cam_board: np.ndarray) -> np.ndarray:
    """The picture [H, W] of a drawn board, one square a unit, its middle at t: a homography of straight rays."""
    R, _ = cv2.Rodrigues(rvec_rad)
    px_per_square = DRAWN_SQUARE_PX
    from_drawn = np.diag([1 / px_per_square, 1 / px_per_square, 1.0])
    from_drawn[:2, 2] = [0.5 / px_per_square - side / 2 / px_per_square for side in (board.shape[1], board.shape[0])]
    to_drawn = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], t_cam_board]) @ from_drawn).astype(np.float32)
    at = cv2.perspectiveTransform(rays_xy().astype(np.float32), to_drawn)
    picture = cv2.remap(board, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    return np.asarray(cv2.resize(picture, SIZE_WH, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def poses(tilt_rad: float, moved: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Twelve: the board tilted to all sides and held to all places."""
    found = []
    for k in range(12):
        angle = 2 * np.pi * k / 12
        axis = np.array([np.cos(angle), np.sin(angle), 0.2])
        place = moved * np.array([3.2 * np.cos(2.3 * angle), 2.0 * np.sin(2.3 * angle), 0.0])
        found.append((tilt_rad * axis, place + np.array([0.0, 0.0, 11.0 + moved * (k % 3)])))
    return found


def film(folder: Path, pattern: str, views: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    board = draw_board(BoardSettings(pattern, SQUARES, "5X5_100", 0.75))  # type: ignore[arg-type]
    blurred = cv2.GaussianBlur(board, (0, 0), 1.2)
    folder.mkdir()
    noise = np.random.default_rng(1)
    for index, (rvec, t) in enumerate(views):
        picture = rendered(np.asarray(blurred, dtype=np.uint8), rvec, t)
        noisy = np.clip(picture + noise.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), noisy)
    return folder


@pytest.mark.parametrize("pattern", ["charuco", "chessboard"])
def test_a_known_camera_is_found_again_and_its_file_flies(cli: Cli, tmp_path: Path, pattern: str) -> None:
    pictures = film(tmp_path / "board", pattern, poses(0.55, 1.0))
    done = cli("calibrate", pictures, "--pattern", pattern, "--out", "nose.yaml", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["rms_px"] < 0.3
    assert said["views"] >= 8
    found = load_intrinsics(IntrinsicsSettings(file=tmp_path / "nose.yaml"))
    assert found.image_size_wh == SIZE_WH
    np.testing.assert_allclose(np.diag(found.K)[:2], np.diag(K)[:2], rtol=0.005)
    np.testing.assert_allclose(found.K[:2, 2], K[:2, 2], atol=3.0)
    # What counts of a distortion is where it puts the rays, not its numbers.
    rays = np.array([[x, y, 1.0] for x in (-0.5, -0.2, 0.2, 0.5) for y in (-0.3, 0.1, 0.3)])
    true_px, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, DISTORTION)
    found_px, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), found.K, np.array(found.distortion))
    assert np.abs(found_px - true_px).max() < 1.0


def test_a_video_of_a_board_becomes_a_file_and_a_person_is_told_how_good_it_is(cli: Cli, tmp_path: Path) -> None:
    pictures = film(tmp_path / "board", "charuco", poses(0.55, 1.0))
    name = "2026-11-29T10:15.mp4"
    video = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SIZE_WH)
    for picture in sorted(pictures.iterdir()):
        for _ in range(HELD_FRAMES):
            video.write(cv2.imread(str(picture)))
    video.release()
    done = cli("calibrate", name, "--out", "nose.yaml", "--name", '[nose: "left" #1')
    assert done.returncode == 0, done.stderr
    told = re.search(r"reprojection error ([\d.]+) px RMS over \d+ views", done.stdout)
    assert told is not None
    assert 0 < float(told[1]) < 0.5
    assert f"Reprojection {told[1]} px RMS" in (tmp_path / "nose.yaml").read_text()
    found = load_intrinsics(IntrinsicsSettings(file=tmp_path / "nose.yaml"))
    np.testing.assert_allclose(np.diag(found.K)[:2], np.diag(K)[:2], rtol=0.01)
    assert YAML(typ="safe").load(tmp_path / "nose.yaml")["camera_name"] == '[nose: "left" #1'


def test_a_file_that_cannot_be_written_is_told_before_the_pictures_are_looked_at(cli: Cli, tmp_path: Path) -> None:
    for out in (tmp_path, tmp_path / "none" / "nose.yaml"):
        done = cli("calibrate", "no-such-video.mp4", "--out", out)
        assert (done.returncode, done.stderr) == (2, f"{out} cannot be written\n")


NO_ROOT_CALIBRATES = """
import os, sys
from edge import calibrate, cli
if os.geteuid() == 0:  # who may everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
sys.exit(cli.main(["calibrate", *sys.argv[1:]]))
"""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["board.mp4", "--out", "home/nose.yaml"], "home/nose.yaml cannot be written\n"),
        (["home/board.mp4"], "home/board.mp4 cannot be read: Permission denied\n"),
        (["closed.mp4"], "closed.mp4 cannot be read: Permission denied\n"),
    ],
)
def test_what_lies_in_a_folder_that_may_not_be_entered_is_told_without_a_traceback(
    arguments: list[str], said: str
) -> None:
    with tempfile.TemporaryDirectory() as folder:  # whoever is not root may enter this one, and write there
        Path(folder).chmod(0o777)
        (Path(folder) / "home").mkdir(mode=0o000)
        (Path(folder) / "closed.mp4").touch(mode=0o000)
        command = [sys.executable, "-c", NO_ROOT_CALIBRATES, *arguments]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, said)


def test_pictures_of_a_deep_camera_that_were_not_scaled_are_warned_of(cli: Cli, tmp_path: Path) -> None:
    pictures = film(tmp_path / "board", "charuco", poses(0.55, 1.0)[:1])
    (path,) = pictures.iterdir()
    cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) * 16)
    done = cli("calibrate", "board", "--out", "nose.yaml")
    assert done.returncode == 2
    assert "board: holds pictures of 16 bits that do not use the upper two" in done.stderr


def test_views_that_do_not_differ_are_refused_with_a_sentence(cli: Cli, tmp_path: Path) -> None:
    still = film(tmp_path / "still", "charuco", poses(0.5, 1.0)[:2] * 3)
    done = cli("calibrate", still)
    assert done.returncode == 2
    told = "images show the board, but only 2 views of it differ; 8 are needed:"
    assert f"6 of 6 {told} move and tilt the board more\n" in done.stderr
    for index in range(6, 14):
        cv2.imwrite(str(still / f"{index}.png"), np.full(SIZE_WH[::-1], 120, np.uint8))
    done = cli("calibrate", still)
    assert f"6 of 14 {told} keep all of it in the image, check --squares, and move" in done.stderr
    assert not (tmp_path / "camera.yaml").exists()


def test_a_board_that_is_never_tilted_is_refused_with_a_sentence(cli: Cli, tmp_path: Path) -> None:
    flat = film(tmp_path / "flat", "charuco", poses(0.0, 1.0))
    done = cli("calibrate", flat)
    assert done.returncode == 2
    assert "too similar to separate focal length and distance (0 of" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "calibrate needs a video, a folder of images"),
        (["nowhere"], "nowhere does not exist"),
        (["notes.txt"], "neither a folder of images nor a readable video"),
        (["grey"], "no image shows the whole board"),
        (["grey", "--squares", "9 by 6"], "--squares: '9 by 6' is not COLUMNSxROWS"),
        (["grey", "--dictionary", "3X3_7"], "--dictionary: OpenCV has no 3X3_7"),
        (["grey", "--squares", "30x30", "--dictionary", "4X4_50"], "fewer markers than the 450"),
        (["mixed"], "is 320x240, earlier images 640x480"),
        (["grey", "--pattern", "chessboard", "--squares", "3x9"], "a chessboard needs at least 4x4 squares"),
        (["grey", "--squares", "4x3"], "a board of 4x3 squares has 6 inner corners, and a view needs 8"),
        (["--draw", "board.xyz"], "--draw board.xyz: the board is a PNG; its name must end in .png"),
        (["--draw", "board.png", "--squares", "4x3"], "a board of 4x3 squares has 6 inner corners"),
        (["--draw", "board.png", "--squares", "2x9"], "a ChArUco board needs at least 3x3 squares"),
    ],
)
def test_what_is_wrong_is_said(cli: Cli, tmp_path: Path, arguments: list[str], sentence: str) -> None:
    (tmp_path / "notes.txt").write_text("no video")
    for name, sizes in (("grey", [(640, 480)]), ("mixed", [(640, 480), (320, 240)])):
        (tmp_path / name).mkdir()
        for index, (width, height) in enumerate(sizes):
            cv2.imwrite(str(tmp_path / name / f"{index}.png"), np.full((height, width), 90, np.uint8))
    done = cli("calibrate", *arguments)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(("pattern", "squares"), [("charuco", "7x5"), ("charuco", "5x3"), ("chessboard", "4x4")])
def test_a_drawn_board_is_one_that_is_found(cli: Cli, tmp_path: Path, pattern: str, squares: str) -> None:
    board = ("--pattern", pattern, "--squares", squares)
    assert cli("calibrate", "--draw", "board.png", *board).returncode == 0
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    small = cv2.resize(picture, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(tmp_path / "board.png"), small)
    (tmp_path / "one").mkdir()
    (tmp_path / "board.png").rename(tmp_path / "one" / "board.png")
    done = cli("calibrate", "one", *board)
    assert "1 of 1 images show the board" in done.stderr
