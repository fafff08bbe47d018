"""Intrinsics from pictures of a board: detect, choose views that differ, fit, judge, write ROS's camera_info YAML.

The fit is OpenCV's (Z. Zhang, "A flexible new technique for camera calibration", 2000).
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.cameras.folder import list_pictures
from edge.errors import InputError
from edge.estimator.lens import Lens
from edge.types import Array

PICTURES_MAX = 150  # of a video, evenly spread: more show nothing new
CORNERS_MIN = 8  # of one view
VIEWS_MIN = 8
VIEWS_MAX = 60  # beyond, a fit takes long and gains little
DIFFERENT_SHARE = 0.03  # of the picture's diagonal that corners must have moved, on average, to be another view
RMS_MAX_PX = 1.5
OUTLIER_FACTOR = 3.0
FOCAL_SIGMA_MAX = 0.005  # relative; above it the views do not settle the focal length
# A board that always faces the camera leaves focal length and distance undecided, whatever the fit's own sigma says.
TILT_MIN_RAD, TILTED_MIN = np.deg2rad(15.0), 3
COVERED_MIN = 0.5  # share of the picture's 4x4 cells with a corner in one view or another
FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}
MODEL = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
DRAWN_SQUARE_PX = 120

Gray = NDArray[np.uint8]
Size = tuple[int, int]


@dataclass(frozen=True)
class BoardSettings:
    """What the board shows. Its size in metres does not matter to intrinsics."""

    pattern: Literal["charuco", "chessboard"]
    squares: Size  # across, down
    dictionary: str  # of a ChArUco board's markers, as OpenCV names it without DICT_
    marker_share: float  # marker's side / square's side


@dataclass(frozen=True, eq=False)
class View:
    """Corners seen in one picture."""

    ids: NDArray[np.int64]  # [n]
    board: NDArray[np.float32]  # [n, 3] squares
    pixels: NDArray[np.float32]  # [n, 2]


@dataclass(frozen=True)
class Calibration:
    """A camera as fitted."""

    image_size_wh: Size
    K: list[list[float]]  # 3x3, pixel centres at integers
    distortion: list[float]  # k1 k2 p1 p2 k3 [k4 k5 k6]
    model: str
    rms_px: float  # of all corners' reprojection
    focal_sigma: float  # relative 1-sigma of the focal length
    covered: float  # share of the picture that boards were seen in
    tilted: int  # views of a board that does not face the camera
    views: int  # used
    boards: int  # pictures that showed the board
    pictures: int  # looked at


class Detector(Protocol):
    def detect(self, gray: Gray) -> View | None:
        """The board in a picture [H, W], or None."""


class CharucoDetector:
    def __init__(self, settings: BoardSettings) -> None:
        self._board = charuco_board(settings)
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def detect(self, gray: Gray) -> View | None:
        pixels, ids, _, _ = self._detector.detectBoard(gray)
        if ids is None or len(ids) < CORNERS_MIN:
            return None
        numbers = np.asarray(ids).reshape(-1)
        corners = np.asarray(self._board.getChessboardCorners(), dtype=np.float32)[numbers]
        if np.linalg.matrix_rank(corners[:, :2] - corners[0, :2]) < 2:
            return None  # all in one row: no plane
        return View(numbers.astype(np.int64), corners, np.asarray(pixels, dtype=np.float32).reshape(-1, 2))


class ChessboardDetector:
    def __init__(self, settings: BoardSettings) -> None:
        self._inner = (settings.squares[0] - 1, settings.squares[1] - 1)
        grid = np.mgrid[0 : self._inner[0], 0 : self._inner[1]].T.reshape(-1, 2)
        self._board = np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)

    def detect(self, gray: Gray) -> View | None:
        found, pixels = cv2.findChessboardCornersSB(gray, self._inner, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
        return View(np.arange(len(self._board)), self._board, np.asarray(pixels, dtype=np.float32).reshape(-1, 2))


def detector_of(settings: BoardSettings) -> Detector:
    """Raises InputError for a board that cannot be."""
    if min(settings.squares) < 3:
        raise InputError("--squares: a board needs at least 3x3 squares")
    return CharucoDetector(settings) if settings.pattern == "charuco" else ChessboardDetector(settings)


def charuco_board(settings: BoardSettings) -> cv2.aruco.CharucoBoard:
    """Raises InputError for an unknown dictionary, one with too few markers, or markers that fill their squares."""
    number = getattr(cv2.aruco, f"DICT_{settings.dictionary}", None)
    if number is None:
        raise InputError(f"--dictionary: OpenCV has no {settings.dictionary}; try 5X5_100")
    if not 0.3 <= settings.marker_share <= 0.95:
        raise InputError("--marker-share takes a number from 0.3 to 0.95")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    markers = settings.squares[0] * settings.squares[1] // 2
    if markers > len(dictionary.bytesList):
        raise InputError(f"--dictionary: {settings.dictionary} has fewer markers than the {markers} of this board")
    return cv2.aruco.CharucoBoard(settings.squares, 1.0, settings.marker_share, dictionary)


def draw_board(settings: BoardSettings) -> Gray:
    """The board as a picture to print, with a margin of half a square."""
    detector_of(settings)
    size_wh = (settings.squares[0] * DRAWN_SQUARE_PX, settings.squares[1] * DRAWN_SQUARE_PX)
    if settings.pattern == "charuco":
        board = np.asarray(charuco_board(settings).generateImage(size_wh), dtype=np.uint8)
    else:
        columns, rows = np.meshgrid(np.arange(size_wh[0]), np.arange(size_wh[1]))
        board = (((columns // DRAWN_SQUARE_PX + rows // DRAWN_SQUARE_PX) % 2) * 255).astype(np.uint8)
    return np.pad(board, DRAWN_SQUARE_PX // 2, constant_values=255)


def pictures_of(source: Path) -> Iterator[tuple[str, Gray]]:
    """Names and gray pictures of a folder, or of a video evenly spread. Raises InputError, naming the file."""
    if source.is_dir():
        for path in list_pictures(source):
            gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            if gray is None:
                raise InputError(f"{path} is not a readable picture")
            yield path.name, np.asarray(gray, dtype=np.uint8)
        return
    if not source.is_file():
        raise InputError(f"{source} does not exist")
    video = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise InputError(f"{source} is neither a folder of pictures nor a readable video")
    every = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)) // PICTURES_MAX, 1)
    index = 0
    while video.grab():
        if index % every == 0:
            read, image_bgr = video.retrieve()
            if read:
                yield f"frame {index}", np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        index += 1


def calibrate(source: Path, board: BoardSettings, coefficients: Literal[4, 5, 8]) -> Calibration:
    """The camera that took the board's pictures. Raises InputError, a sentence that says what to film instead."""
    detector, views, boards, pictures = detector_of(board), list[View](), 0, 0
    size_wh: Size | None = None
    for name, gray in pictures_of(source):
        seen_wh = (gray.shape[1], gray.shape[0])
        if size_wh is not None and seen_wh != size_wh:
            raise InputError(f"{source}: {name} is {seen_wh[0]}x{seen_wh[1]}, those before {size_wh[0]}x{size_wh[1]}")
        size_wh, pictures = seen_wh, pictures + 1
        view = detector.detect(gray)
        boards += view is not None
        if view is not None and len(views) < VIEWS_MAX and all(differ(view, other, size_wh) for other in views):
            views.append(view)
        _tell_progress(pictures, boards, len(views))
    if size_wh is None or boards == 0:
        raise InputError(f"{source}: no picture shows the whole board as described by --pattern and --squares")
    if len(views) < VIEWS_MIN:
        raise InputError(
            f"{source}: {boards} of {pictures} pictures show the board, but only {len(views)} views of it differ; "
            f"{VIEWS_MIN} are needed: move and tilt the board more"
        )
    return _judged(_fit(views, size_wh, coefficients, boards, pictures), source)


def differ(view: View, other: View, size_wh: Size) -> bool:
    """Whether the corners that both show lie elsewhere."""
    _, mine, others = np.intersect1d(view.ids, other.ids, return_indices=True)
    if not len(mine):
        return True
    moved_px = np.linalg.norm(view.pixels[mine] - other.pixels[others], axis=1).mean()
    return bool(moved_px > DIFFERENT_SHARE * np.hypot(*size_wh))


def _fit(views: list[View], size_wh: Size, coefficients: int, boards: int, pictures: int) -> Calibration:
    """Twice: the second time without the views that the first did not agree with."""
    for _ in range(2):
        rms_px, K, distortion, rvecs, _, sigma, _, errors_px = cv2.calibrateCameraExtended(
            [view.board for view in views],
            [view.pixels for view in views],
            size_wh,
            np.eye(3),
            np.zeros(5),
            flags=FLAGS[coefficients],
        )
        errors = np.asarray(errors_px).reshape(-1)
        agreeing = [v for v, e in zip(views, errors, strict=True) if e <= OUTLIER_FACTOR * np.median(errors)]
        if len(agreeing) == len(views) or len(agreeing) < VIEWS_MIN:
            break
        views = agreeing
    sigma_f = np.asarray(sigma).reshape(-1)[:2] / np.diag(K)[:2]
    tilts_rad = [np.arccos(np.clip(abs(cv2.Rodrigues(rvec)[0][2, 2]), 0.0, 1.0)) for rvec in rvecs]
    cells = {tuple(cell) for view in views for cell in np.floor(4 * view.pixels / size_wh).astype(int)}
    return Calibration(
        image_size_wh=size_wh,
        K=np.asarray(K, dtype=np.float64).tolist(),
        distortion=np.asarray(distortion, dtype=np.float64).reshape(-1)[: 8 if coefficients == 8 else 5].tolist(),
        model=MODEL[coefficients],
        rms_px=float(rms_px),
        focal_sigma=float(np.max(np.abs(sigma_f))),
        covered=len(cells) / 16,
        tilted=int(np.sum(np.array(tilts_rad) > TILT_MIN_RAD)),
        views=len(views),
        boards=boards,
        pictures=pictures,
    )


def _judged(found: Calibration, source: Path) -> Calibration:
    if not np.all(np.isfinite([*found.distortion, *np.ravel(found.K), found.rms_px])) or found.rms_px > RMS_MAX_PX:
        raise InputError(
            f"{source}: the fit misses the corners by {found.rms_px:.2f} px; is the board flat, and --squares right?"
        )
    if found.covered < COVERED_MIN:
        raise InputError(
            f"{source}: the board was seen in {100 * found.covered:.0f} % of the picture; show it in the corners too"
        )
    if found.tilted < TILTED_MIN or not found.focal_sigma <= FOCAL_SIGMA_MAX:
        raise InputError(
            f"{source}: the views are too alike to tell focal length from distance ({found.tilted} of {found.views} "
            f"are tilted; 1 sigma {100 * found.focal_sigma:.1f} %): tilt the board by 30 degrees and more, to all sides"
        )
    width, height = found.image_size_wh
    lens = Lens(np.array(found.K), tuple(found.distortion))
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)
    straight = lens.to_pinhole(corners)
    radius = np.linalg.norm(lens.rays(straight)[:, :2], axis=1)
    if not (np.all(np.abs(lens.to_frame(straight) - corners) < 0.5) and np.all(radius < lens.radius_max)):
        raise InputError(
            f"{source}: the fitted distortion folds the picture's corners; show the board there, or fit fewer "
            "--coefficients"
        )
    return found


def camera_info_yaml(found: Calibration, name: str) -> str:
    """What ROS camera_calibration writes and camera_info_manager reads; the comments say how good it is."""

    def matrix(key: str, values: Array) -> str:
        numbers = ", ".join(f"{value:.10g}" for value in values.ravel())
        return f"{key}:\n  rows: {values.shape[0]}\n  cols: {values.shape[1]}\n  data: [{numbers}]\n"

    K = np.array(found.K)
    return (
        f"# Reprojection {found.rms_px:.3f} px RMS over {found.views} views; focal length to "
        f"{100 * found.focal_sigma:.2f} % (1 sigma)\n"
        f"image_width: {found.image_size_wh[0]}\nimage_height: {found.image_size_wh[1]}\n"
        f"camera_name: {json.dumps(name, ensure_ascii=False)}\n"
        + matrix("camera_matrix", K)
        + f"distortion_model: {found.model}\n"
        + matrix("distortion_coefficients", np.array([found.distortion]))
        + matrix("rectification_matrix", np.eye(3))
        + matrix("projection_matrix", np.hstack([K, np.zeros((3, 1))]))
    )


def report(found: Calibration, out: Path) -> list[str]:
    """Lines for a person."""
    (fx, _, cx), (_, fy, cy) = found.K[0], found.K[1]
    return [
        f"{out}: {found.image_size_wh[0]}x{found.image_size_wh[1]}, focal length {fx:.1f} x {fy:.1f} px, "
        f"centre {cx:.1f}, {cy:.1f}",
        f"reprojection error {found.rms_px:.3f} px RMS over {found.views} views "
        f"({found.boards} of {found.pictures} pictures show the board)",
        f"focal length to {100 * found.focal_sigma:.2f} % (1 sigma); "
        f"boards were seen in {100 * found.covered:.0f} % of the picture",
        f"distortion ({found.model}) " + " ".join(f"{value:.5f}" for value in found.distortion),
    ]


def refuse_unwritable(out: Path) -> None:
    """Raises InputError, before an hour of pictures is looked at for nothing."""
    folder = out.absolute().parent
    if out.is_dir() or not os.access(out if out.exists() else folder, os.W_OK):
        raise InputError(f"{out} cannot be written")


def write_calibration(found: Calibration, name: str, out: Path) -> None:
    """Raises InputError if it cannot be written."""
    try:
        out.write_text(camera_info_yaml(found, name), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from error


def write_board(settings: BoardSettings, out: Path) -> None:
    """Raises InputError if it cannot be written."""
    _, data = cv2.imencode(".png", draw_board(settings))
    try:
        out.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from error


def board_squares(text: str) -> Size:
    """`9x6` as (9, 6). Raises InputError."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", text)
    if match is None:
        raise InputError(f"--squares: '{text}' is not ACROSSxDOWN, as 9x6")
    return int(match[1]), int(match[2])


def to_json(found: Calibration) -> str:
    return json.dumps(asdict(found))


def _tell_progress(pictures: int, boards: int, views: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{pictures} pictures, {boards} with the board, {views} different", end="", file=sys.stderr, flush=True)
