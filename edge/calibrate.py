"""Intrinsics from pictures of a board: detect, select different views, fit, judge, write ROS's camera_info YAML."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Generator, Iterator
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from edge.calibrate_board import BoardSettings, Gray, Size, View, detector_of
from edge.calibrate_fit import VIEWS_MIN, Calibration, Coefficients, calibration_of
from edge.cameras.folder import list_pictures
from edge.cameras.picture_file import read_8_bits
from edge.cameras.video import check_file, grab_next, open_video
from edge.errors import InputError
from edge.types import Array

PICTURES_MAX = 150  # of a video, evenly spaced: more show nothing new
# With more, a fit takes long and gains little. They are chosen from all that differ: the first ones may all be of the
# image's middle.
VIEWS_MAX = 60
DIFFERENT_SHARE = 0.03  # of the image diagonal: mean movement of the corners from which on a view is different
TOLD_MIN = 0.0005  # of the image: shares that would be rounded to zero are not reported


def pictures_of(source: Path) -> Iterator[tuple[str, Gray]]:
    """Names and gray pictures of a folder, or of a video, evenly spaced. Raises InputError that names the file."""
    if os.path.isdir(source):  # Path.is_dir raises if a parent folder may not be entered
        for path in list_pictures(source):
            yield path.name, read_8_bits(path, cv2.IMREAD_GRAYSCALE)
        return
    check_file(source)
    opened = str(source.absolute())  # a relative path with a colon, as 2026-11-29T10:15.mp4, would be taken for a URL
    video = open_video(opened)
    if not video.isOpened():
        raise InputError(f"{source} is neither a folder of images nor a readable video")
    every = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)) // PICTURES_MAX, 1)
    frames = yield from _every(video, every)
    # Recorders that count in milliseconds may state 1000 frames a second, from which the number of frames is guessed.
    if frames // every < PICTURES_MAX // 2 and every > 1:
        yield from _every(open_video(opened), max(frames // PICTURES_MAX, 1), but=every)


def _every(video: cv2.VideoCapture, step: int, but: int | None = None) -> Generator[tuple[str, Gray], None, int]:
    """Names and gray pictures of each `step`th frame but those of each `but`th; returns the number of all frames."""
    index = 0
    while (undecodable := grab_next(video)) is not None:
        index += undecodable
        if index % step == 0 and (but is None or index % but != 0):
            read, image_bgr = video.retrieve()
            if read:
                yield f"frame {index}", np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        index += 1
    return index


def calibrate(source: Path, board: BoardSettings, coefficients: Coefficients) -> Calibration:
    """Calibrate the camera that took the pictures. Raises InputError with a sentence that says what to film instead."""
    detector, views, boards, pictures = detector_of(board), list[View](), 0, 0
    size_wh: Size | None = None
    for name, gray in pictures_of(source):
        seen_wh = (gray.shape[1], gray.shape[0])
        if size_wh is not None and seen_wh != size_wh:
            raise InputError(f"{source}: {name} is {seen_wh[0]}x{seen_wh[1]}, earlier images {size_wh[0]}x{size_wh[1]}")
        size_wh, pictures = seen_wh, pictures + 1
        view = detector.detect(gray)
        boards += view is not None
        if view is not None and all(differ(view, other, size_wh) for other in views):
            views.append(view)
        _tell_progress(pictures, boards, len(views))
    if size_wh is None or boards == 0:
        raise InputError(f"{source}: no image shows the whole board as described by --pattern and --squares")
    if len(views) < VIEWS_MIN:
        rarely = "keep all of it in the image, check --squares, and " if 2 * boards < pictures else ""
        raise InputError(
            f"{source}: {boards} of {pictures} images show the board, but only {len(views)} views of it differ; "
            f"{VIEWS_MIN} are needed: {rarely}move and tilt the board more"
        )
    found = calibration_of(spread(views), size_wh, coefficients, boards, pictures)
    if isinstance(found, str):
        raise InputError(f"{source}: {found}")
    return found


def differ(view: View, other: View, size_wh: Size) -> bool:
    """Whether the corners that both views show have moved."""
    _, mine, others = np.intersect1d(view.ids, other.ids, return_indices=True)
    if not len(mine):
        return True
    moved_px = np.linalg.norm(view.pixels[mine] - other.pixels[others], axis=1).mean()
    return bool(moved_px > DIFFERENT_SHARE * np.hypot(*size_wh))


def spread(views: list[View]) -> list[View]:
    """At most VIEWS_MAX of the views, evenly spaced from the first to the last."""
    if len(views) <= VIEWS_MAX:
        return views
    return [views[index] for index in np.linspace(0, len(views) - 1, VIEWS_MAX).round().astype(int)]


def camera_info_yaml(found: Calibration, name: str) -> str:
    """YAML as ROS camera_calibration writes and camera_info_manager reads it; comments state the quality."""

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
    lines = [
        f"{out}: {found.image_size_wh[0]}x{found.image_size_wh[1]}, focal length {fx:.1f} x {fy:.1f} px, "
        f"centre {cx:.1f}, {cy:.1f}",
        f"reprojection error {found.rms_px:.3f} px RMS over {found.views} views "
        f"({found.boards} of {found.pictures} images show the board)",
        f"focal length uncertainty {100 * found.focal_sigma:.2f} % (1 sigma); "
        f"the views cover {100 * found.covered:.0f} % of the image",
        f"distortion ({found.model}) " + " ".join(f"{value:.5f}" for value in found.distortion),
    ]
    if found.without_ray >= TOLD_MIN:
        lines.append(
            f"{100 * found.without_ray:.1f} % of the image, in its corners, cannot be undistorted, "
            "and nothing is detected there: more views of the board there may correct this"
        )
    return lines


def refuse_unwritable(out: Path) -> None:
    """Raises InputError if `out` cannot be written, before time is spent on the pictures."""
    folder = out.absolute().parent
    if os.path.isdir(out) or not os.access(out if os.path.exists(out) else folder, os.W_OK):
        raise InputError(f"{out} cannot be written")


def write_calibration(found: Calibration, name: str, out: Path) -> None:
    """Raises InputError if it cannot be written."""
    try:
        out.write_text(camera_info_yaml(found, name), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from error


def to_json(found: Calibration) -> str:
    return json.dumps(asdict(found))


def _tell_progress(pictures: int, boards: int, views: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{pictures} images, {boards} with the board, {views} different", end="", file=sys.stderr, flush=True)
