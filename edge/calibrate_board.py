"""The calibration board: its pattern, its detection in a picture, and its drawing for printing."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError

CORNERS_MIN = 8  # in one view
# OpenCV's chessboard detector needs at least three corners per side; corners in one row do not determine a plane.
SQUARES_MIN = {"charuco": ("ChArUco board", 3), "chessboard": ("chessboard", 4)}
DRAWN_SQUARE_PX = 120

Gray = NDArray[np.uint8]
Size = tuple[int, int]


@dataclass(frozen=True)
class BoardSettings:
    """The board's pattern. Its size in metres does not matter for intrinsics."""

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
            return None  # all in one row, which does not determine a plane
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
    """Raises InputError for a board that cannot be detected, or not well enough."""
    (name, least), (across, down) = SQUARES_MIN[settings.pattern], settings.squares
    if min(settings.squares) < least:
        raise InputError(f"--squares: a {name} needs at least {least}x{least} squares")
    if (corners := (across - 1) * (down - 1)) < CORNERS_MIN:
        raise InputError(
            f"--squares: a board of {across}x{down} squares has {corners} inner corners, and a view needs {CORNERS_MIN}"
        )
    return CharucoDetector(settings) if settings.pattern == "charuco" else ChessboardDetector(settings)


def charuco_board(settings: BoardSettings) -> cv2.aruco.CharucoBoard:
    """Raises InputError for an unknown dictionary, one with too few markers, or markers that fill their squares."""
    number = getattr(cv2.aruco, f"DICT_{settings.dictionary}", None)
    if number is None:
        raise InputError(f"--dictionary: OpenCV has no {settings.dictionary}; try 5X5_100")
    if not 0.3 <= settings.marker_share <= 0.95:
        raise InputError("--marker-share must be a number from 0.3 to 0.95")
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


def write_board(settings: BoardSettings, out: Path) -> None:
    """Raises InputError if `out` is not the name of a PNG or cannot be written."""
    if out.suffix.lower() != ".png":
        raise InputError(f"--draw {out}: the board is a PNG; its name must end in .png")
    _, data = cv2.imencode(".png", draw_board(settings))
    try:
        out.write_bytes(data.tobytes())
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from error


def board_squares(text: str) -> Size:
    """`9x6` as (9, 6). Raises InputError."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", text)
    if match is None:
        raise InputError(f"--squares: '{text}' is not COLUMNSxROWS, such as 9x6")
    return int(match[1]), int(match[2])
