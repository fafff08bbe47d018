"""Calibrations: reading, and scaling to the image size."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edge.config_camera import SIDE_MAX_PX, IntrinsicsSettings
from edge.errors import InputError
from edge.estimator.lens import Lens
from edge.types import Array

INTRINSICS_KEY = ("camera", "intrinsics")
DISTORTION_MODELS = ("", "plumb_bob", "rational_polynomial")  # OpenCV's own files name none
FOCAL_RATIO_MAX = 2.0  # pixels are square, or nearly so in anamorphic video
ACROSS_MAX_DEG = 150.0  # wider than any lens that is not a fisheye
OUTSIDE_MAX_SHARE = 0.5  # how far, in its sides, the principal point may lie outside the image, which may be cropped
CLEAR_SHARE = 0.5  # share of the sides, in the middle, in which the lens model must not fold
ROUNDING = 1e-6  # tolerance for the zeros and the one of K, from tools that multiply matrices


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with plumb-bob distortion, for images of one size."""

    K: Array  # [3, 3], pixel centres at integers
    image_size_wh: tuple[int, int]
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty: none

    def scaled_to(self, image_size_wh: tuple[int, int], said_by: str = "the camera gives") -> Intrinsics:
        """The same lens for images of another size. Raises InputError unless both sides scale by exactly the same."""
        (w, h), (new_w, new_h) = self.image_size_wh, image_size_wh
        if new_w * h != new_h * w:
            raise InputError(
                f"these intrinsics are for {w}x{h} pixels, but {said_by} {new_w}x{new_h}, "
                "which is not the same picture scaled",
                INTRINSICS_KEY,
            )
        scale = new_w / w
        K = self.K.copy()
        K[:2, :2] *= scale
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
        return Intrinsics(K, image_size_wh, self.distortion)


def load_intrinsics(settings: IntrinsicsSettings) -> Intrinsics:
    """From the numbers in the configuration or the file it names. Raises InputError, also for impossible values."""
    intrinsics = read_calibration(settings.file) if settings.file is not None else _from_numbers(settings)
    reason = _no_camera(intrinsics)
    if reason is not None:
        raise InputError(f"{settings.file or 'these intrinsics'}: {reason}", INTRINSICS_KEY)
    return intrinsics


def _no_camera(intrinsics: Intrinsics) -> str | None:
    """Why no camera can have these values; None: possible."""
    K, sides = intrinsics.K, np.array(intrinsics.image_size_wh)
    if not 1 / FOCAL_RATIO_MAX <= K[0, 0] / K[1, 1] <= FOCAL_RATIO_MAX:
        return f"fx {K[0, 0]:g} and fy {K[1, 1]:g} cannot be of one camera"
    across_deg = np.degrees(2.0 * np.arctan(0.5 * sides[0] / K[0, 0]))
    if across_deg > ACROSS_MAX_DEG:
        return f"fx {K[0, 0]:g} px shows {across_deg:.0f} degrees across {sides[0]} px: are these millimetres?"
    if (np.abs(K[:2, 2] - 0.5 * (sides - 1)) > (0.5 + OUTSIDE_MAX_SHARE) * sides).any():
        return f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is far outside the picture of {sides[0]}x{sides[1]}"
    if any(intrinsics.distortion):
        corners = 0.5 * (sides - 1) + 0.5 * CLEAR_SHARE * sides * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        if not Lens(K, intrinsics.distortion).shows(corners).all():
            return "the distortion folds the picture over itself in its middle half: is a coefficient wrong?"
    return None


def _from_numbers(settings: IntrinsicsSettings) -> Intrinsics:
    numbers = (settings.fx, settings.fy, settings.cx, settings.cy)
    fx, fy, cx, cy = (float(n) for n in numbers if n is not None)
    assert settings.width is not None
    assert settings.height is not None
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Intrinsics(K, (settings.width, settings.height), tuple(settings.distortion))


def read_calibration(path: Path) -> Intrinsics:
    """A calibration YAML: image_width, image_height, camera_matrix, distortion_coefficients.

    Both ROS camera_calibration and OpenCV write these keys. Raises InputError.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"calibration {path} cannot be read: {reason}", INTRINSICS_KEY) from error
    try:
        storage = cv2.FileStorage(_as_opencv_reads(text), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        size_wh = (_side_px(storage, path, "image_width"), _side_px(storage, path, "image_height"))
        K = pinhole(_matrix(storage, path, "camera_matrix"), f"calibration {path}: camera_matrix", INTRINSICS_KEY)
        if storage.getNode("distortion_coefficients").empty():
            missing = "distortion_coefficients is missing; a camera without distortion says data: []"
            raise InputError(f"calibration {path}: {missing}", INTRINSICS_KEY)
        distortion = _matrix(storage, path, "distortion_coefficients")
        model = storage.getNode("distortion_model").string()
        fisheye = storage.getNode("fisheye_model")
    except (cv2.error, SystemError) as error:  # OpenCV's constructor wraps its error in SystemError
        hint = f"not YAML as OpenCV reads it{_opencv_reason(error)}; lists stand in brackets, as data: [1.0, 0.0]"
        raise InputError(f"calibration {path} is {hint}", INTRINSICS_KEY) from error
    if model not in DISTORTION_MODELS:
        raise InputError(
            f"calibration {path}: distortion_model {model} is not one of plumb_bob, rational_polynomial", INTRINSICS_KEY
        )
    if not fisheye.empty() and not (fisheye.isInt() and fisheye.real() == 0):
        raise InputError(
            f"calibration {path}: fisheye_model is not 0: fisheye lenses are not supported", INTRINSICS_KEY
        )
    if distortion.size not in (0, 4, 5, 8) or not np.all(np.isfinite(distortion)):
        raise InputError(
            f"calibration {path}: distortion_coefficients takes 4, 5 or 8 numbers (plumb bob)", INTRINSICS_KEY
        )
    return Intrinsics(K, size_wh, tuple(float(d) for d in distortion))


def _as_opencv_reads(text: str) -> str:
    """The same YAML, with the same lines, without parts that OpenCV cannot read and that are not needed: comments after
    values, the camera's name."""
    plain = re.sub(r"(?m)(?:^|[ \t]+)#.*$", "", text)
    return re.sub(r"(?m)^camera_name[ \t]*:.*$(?:\n[ \t]+\S.*$)*", lambda name: "\n" * name[0].count("\n"), plain)


def _opencv_reason(error: Exception) -> str:
    """`, line N: OpenCV's message`; empty if there is none."""
    said = re.search(r"\((\d+)\): (.+)", str(error.__cause__ or error))
    if said is None:
        return ""
    words = said[2].partition(" in function")[0].strip()
    if words.count("'") % 2:
        words = words.removesuffix("'")  # OpenCV 5 quotes the whole message
    return f", line {said[1]}: {words.rstrip('!')}"


def pinhole(numbers: Array, named: str, key: tuple[str, ...] = ()) -> Array:
    """K [3, 3] from its numbers, row by row. Raises InputError that begins with `named` (their file and key)."""
    if numbers.size != 9 or not np.isfinite(numbers).all():
        raise InputError(f"{named} is not 9 finite numbers", key)
    K = numbers.reshape(3, 3)
    if min(K[0, 0], K[1, 1]) <= 0:
        raise InputError(f"{named} has no positive focal lengths", key)
    if np.abs(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]).max() > ROUNDING:
        raise InputError(f"{named} is not, row by row, fx 0 cx, 0 fy cy, 0 0 1", key)
    return K


def _side_px(storage: cv2.FileStorage, path: Path, name: str) -> int:
    """Raises InputError."""
    node, named = storage.getNode(name), f"calibration {path}: {name}"
    side_px = 0.0 if node.empty() else _number(node, named)
    if not (0 < side_px <= SIDE_MAX_PX and side_px.is_integer()):
        raise InputError(f"{named} is missing or no whole number from 1 to {SIDE_MAX_PX}", INTRINSICS_KEY)
    return int(side_px)


def _matrix(storage: cv2.FileStorage, path: Path, name: str) -> Array:
    """Flat numbers of a matrix in OpenCV's or ROS's form (rows, cols, data). Raises InputError."""
    node, named = storage.getNode(name), f"calibration {path}: {name}"
    if not node.isMap() or not node.getNode("data").isSeq():
        raise InputError(f"{named} has no list of data", INTRINSICS_KEY)
    data = node.getNode("data")
    return np.array([_number(data.at(i), named) for i in range(data.size())], dtype=np.float64)


def _number(node: cv2.FileNode, named: str) -> float:
    """Raises InputError. OpenCV itself reads text, such as O.1 with a letter O, as the largest possible number."""
    if not (node.isInt() or node.isReal()):
        text = repr(node.string()) if node.isString() else "a list"
        raise InputError(f"{named} holds {text} in place of a number", INTRINSICS_KEY)
    return float(node.real())
