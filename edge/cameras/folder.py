"""A folder of pictures by one camera, played in the order of their names."""

from __future__ import annotations

import re
from pathlib import Path

from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.sequence import PICTURE_SUFFIXES, ScenePicture, SequenceSource
from edge.config_camera import FolderCamera
from edge.errors import InputError

DECIMALS = 20  # more than any clock tells


class FolderSource(SequenceSource):
    """Picture k counts as exposed at start + k / fps; those that a late reader missed are skipped, as with a camera."""

    def __init__(self, settings: FolderCamera) -> None:
        super().__init__(settings)
        self._intrinsics = load_intrinsics(settings.intrinsics)

    def _list(self, folder: Path) -> list[ScenePicture]:
        return [ScenePicture(path, self._intrinsics.K, self._intrinsics.distortion) for path in list_pictures(folder)]


def list_pictures(folder: Path) -> list[Path]:
    """The folder's pictures in the order of `_place`, but no hidden ones: macOS writes `._2.png` beside `2.png`.

    Raises InputError when there are none.
    """
    try:
        files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}") from error
    paths = [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
    if not paths:
        raise InputError(f"{folder} has no pictures ({', '.join(sorted(PICTURE_SUFFIXES))})")
    return sorted(paths, key=lambda path: _place(path.name))


def _place(name: str) -> list[tuple[int, str]]:
    """Sorts `2.png` before `10.png`, and times in seconds since 1970 by their decimals: `1764415083.25.png` before
    `1764415083.5.png`, as Python writes them."""
    in_full = re.sub(r"(?<=\d{9}\.)\d+", lambda decimals: decimals[0].ljust(DECIMALS, "0"), name)
    return [(int(number or 0), text) for number, text in re.findall(r"(\d*)(\D*)", in_full)]
