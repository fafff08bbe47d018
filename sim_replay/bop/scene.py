"""A BOP scene on disk: frame records are read on first use, images and masks one at a time."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import PIL.TiffImagePlugin
from numpy.typing import NDArray

from edge.cameras.picture_file import read_8_bits, read_pixels
from edge.cameras.sequence import DISTORTION_KEY, PICTURE_SUFFIXES
from edge.errors import InputError
from sim_replay.bop.fields import by_number, load_json, load_object, matrix
from sim_replay.bop.frames import Source, frame_of
from sim_replay.bop.model_frame import ModelFrames
from sim_replay.bop.records import BopError, BopFrame

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
PICTURE_FOLDERS = ("gray", "rgb")  # the later one is used if a frame has both
IMAGEWISE_CAMERA = ".camera.json"
_ENDS = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}  # how JPEG and PNG end, by how they begin
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TAIL_BYTES = 512  # of a file, where its end is, unless something follows it


@dataclass(frozen=True, eq=False)
class BopScene:
    """A scene folder: scene_camera.json, scene_gt.json, scene_gt_info.json, rgb/ or gray/, mask/, mask_visib/.

    Only camera and images are required. A scene without scene_camera.json uses the dataset's camera.json.
    """

    folder: Path
    scene_id: int = 0
    split: str | None = None  # the parent folder of the scene, if the dataset has splits
    root: Path | None = None  # of the dataset: models, camera.json
    models: ModelFrames = field(default_factory=ModelFrames)

    @cached_property
    def frames(self) -> tuple[BopFrame, ...]:
        """By increasing image id. Raises BopError, naming file and key."""
        gt, gt_info = self.folder / "scene_gt.json", self.folder / "scene_gt_info.json"
        poses, info = (by_number(path, load_object(path, optional=True)) for path in (gt, gt_info))
        camera_file, cameras = self._cameras(poses)
        source = Source(camera_file, gt, gt_info)
        unlisted: list[Any] | None = [] if gt.is_file() else None  # an image that the file omits shows no target
        return tuple(
            frame_of(
                source, image_id, cameras[image_id], poses.get(image_id, unlisted), info.get(image_id), self.models
            )
            for image_id in sorted(cameras)
        )

    @property
    def pictured(self) -> tuple[BopFrame, ...]:
        """The frames that have an image: an index may list more than exist. Raises BopError if none has."""
        frames = tuple(frame for frame in self.frames if frame.image_id in self._pictures)
        if self.frames and not frames:
            raise BopError(f"{self.folder} holds no picture of those that it lists in rgb/ or gray/")
        return frames

    @property
    def pictures_without_camera(self) -> int:
        """Number of images that are not among the frames, as nothing gives their K. Raises BopError."""
        return len(self._pictures.keys() - {frame.image_id for frame in self.frames})

    def image_path(self, frame: BopFrame) -> Path:
        """Path of the frame's image. Raises BopError if there is none."""
        path = self._pictures.get(frame.image_id)
        if path is None:
            raise BopError(f"{self.folder / 'rgb'} holds no picture {frame.image_id:06d}")
        return path

    def image_bgr(self, frame: BopFrame) -> Image:
        """The frame's image [H, W, 3]; a grey one has three equal channels. Raises BopError."""
        return read_picture_bgr(self.image_path(frame))

    def mask(self, frame: BopFrame, target_index: int) -> Mask | None:
        """The visible mask [H, W] of a target, or None if the dataset has no masks. Raises BopError."""
        return self._mask("mask_visib", frame, target_index)

    @property
    def mask_files(self) -> tuple[Path, ...]:
        """Of mask(); none where masks are in JSON files."""
        return tuple(path for (kind, *_), path in self._masks.items() if kind == "mask_visib")

    def whole_mask(self, frame: BopFrame, target_index: int) -> Mask | None:
        """The mask [H, W] of a target's whole silhouette inside the image, or None. Raises BopError."""
        return self._mask("mask", frame, target_index)

    def _cameras(self, poses: dict[int, Any]) -> tuple[Path, dict[int, Any]]:
        path = self.folder / "scene_camera.json"
        shared = None if self.root is None else self.root / "camera.json"
        if path.is_file() or shared is None or not shared.is_file() or not poses:
            return path, by_number(path, load_object(path))
        entry = load_object(shared)
        fx, fy, cx, cy = (float(matrix(shared, "camera", entry, name, ())) for name in ("fx", "fy", "cx", "cy"))
        camera = {"cam_K": [fx, 0, cx, 0, fy, cy, 0, 0, 1]} | {k: entry[k] for k in (DISTORTION_KEY,) if k in entry}
        return shared, dict.fromkeys(poses, camera)

    @cached_property
    def _pictures(self) -> dict[int, Path]:
        found = {}
        for name in PICTURE_FOLDERS:
            for path in sorted(_listed(self.folder / name), reverse=True):  # of 7.jpg and 7.png the first is used
                if path.stem.isdecimal() and path.suffix.lower() in PICTURE_SUFFIXES:
                    found[int(path.stem)] = path
        return found

    @cached_property
    def _masks(self) -> dict[tuple[str, int, int], Path]:
        """By kind, image and target: IMAGE_TARGET.png; IMAGE.png if an image shows only one target."""
        found = {}
        for kind in ("mask", "mask_visib"):
            for path in _listed(self.folder / kind):
                name = re.fullmatch(r"(\d+)(?:_(\d+))?", path.stem)
                if name and path.suffix.lower() in PICTURE_SUFFIXES:
                    found[kind, int(name[1]), int(name[2] or 0)] = path
        return found

    def _mask(self, kind: str, frame: BopFrame, target_index: int) -> Mask | None:
        path = self._masks.get((kind, frame.image_id, target_index))
        if path is None:
            return None
        try:
            values = read_pixels(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        except InputError as error:
            raise BopError(str(error)) from error
        return values > values.max() // 2  # the format defines 255 as set; some datasets write 1


@dataclass(frozen=True, eq=False)
class ImagewiseScene(BopScene):
    """The images of one scene in a BOP-imagewise folder: KEY.rgb.jpg, KEY.camera.json, KEY.gt.json, ..."""

    keys: tuple[tuple[int, str], ...] = ()  # image id and KEY, as 000001_000023

    @cached_property
    def frames(self) -> tuple[BopFrame, ...]:
        """By increasing image id. Raises BopError, naming file and key."""
        return tuple(self._frame(image_id, key) for image_id, key in sorted(self.keys))

    def _frame(self, image_id: int, key: str) -> BopFrame:
        source = Source(*(self.folder / f"{key}.{kind}.json" for kind in ("camera", "gt", "gt_info")))
        poses, info = (load_json(path) if path.is_file() else None for path in source[1:])
        return frame_of(source, image_id, load_json(source.camera), poses, info, self.models)

    @cached_property
    def _pictures(self) -> dict[int, Path]:
        ids = {key: image_id for image_id, key in self.keys}
        found = {}
        for kind in PICTURE_FOLDERS:
            for path in sorted(self.folder.glob(f"*.{kind}.*"), reverse=True):
                key = path.name.split(".")[0]
                if key in ids and path.suffix.lower() in PICTURE_SUFFIXES:
                    found[ids[key]] = path
        return found

    def _mask(self, kind: str, frame: BopFrame, target_index: int) -> Mask | None:
        path = self.folder / f"{dict(self.keys)[frame.image_id]}.{kind}.json"
        if not path.is_file():
            return None
        entry = load_object(path).get(str(target_index))
        return None if entry is None else _mask_of_runs(path, target_index, entry)


def _listed(folder: Path) -> list[Path]:
    """What is in it, or nothing if it is not there. Raises BopError; `glob` takes a closed folder for an empty one."""
    try:
        return list(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise BopError(f"{folder}: cannot be listed: {error.strerror}") from error


def imagewise_keys(folder: Path) -> dict[int, tuple[tuple[int, str], ...]]:
    """Image ids and keys of a BOP-imagewise folder by scene id; empty for any other folder."""
    scenes: dict[int, list[tuple[int, str]]] = {}
    for path in sorted(folder.glob("*" + IMAGEWISE_CAMERA)):
        name = re.fullmatch(r"(?:(\d+)_)?(\d+)", path.name.removesuffix(IMAGEWISE_CAMERA))
        if name:
            scenes.setdefault(int(name[1] or 0), []).append((int(name[2]), name[0]))
    return {scene_id: tuple(keys) for scene_id, keys in scenes.items()}


def _mask_of_runs(path: Path, target_index: int, entry: Any) -> Mask:
    """COCO's uncompressed run lengths: alternately unset and set, starting with unset, column by column."""
    try:
        height, width = entry["size"]
        if sum(entry["counts"]) != height * width:  # before so many pixels are made
            raise ValueError("another number of pixels")
        counts = np.asarray(entry["counts"], dtype=np.int64)
        flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        return flat.reshape(width, height).T
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BopError(f"{path}: '{target_index}' does not hold 'size' and 'counts' of one mask") from error


def read_picture_bgr(path: Path) -> Image:
    """The image [H, W, 3]; of 16 bits the upper eight. Raises BopError."""
    try:
        return read_8_bits(path, cv2.IMREAD_COLOR)  # never turned: labels refer to the pixels as stored
    except InputError as error:
        raise BopError(str(error)) from error


def refuse_broken(path: Path) -> None:
    """Raises BopError for a file that is no picture, or is truncated.

    There may be tens of thousands: a JPEG or PNG is read as a whole only if its end is not where it is expected.
    """
    if header_size_wh(path) is None or not _ends_as_it_should(path):
        read_picture_bgr(path)


def _ends_as_it_should(path: Path) -> bool:
    with path.open("rb") as file:
        end = _ENDS.get(file.read(2))
        file.seek(max(path.stat().st_size - _TAIL_BYTES, 0))
        return end is not None and end in file.read()


def picture_size_wh(path: Path) -> tuple[int, int]:
    """Width and height of an image as stored, from its header if possible. Raises BopError."""
    size_wh = header_size_wh(path)
    if size_wh is None:
        height, width = read_picture_bgr(path).shape[:2]
        return width, height
    return size_wh


def header_size_wh(path: Path) -> tuple[int, int] | None:
    """The same if the header tells it; None: the whole image must be read, by OpenCV."""
    try:
        with PIL.Image.open(path) as picture:
            if isinstance(picture, PIL.TiffImagePlugin.TiffImageFile):  # its size is that of the picture once turned
                return picture.tag_v2[_TIFF_WIDTH], picture.tag_v2[_TIFF_HEIGHT]
            return picture.size
    except (OSError, ValueError, KeyError, PIL.Image.DecompressionBombError):
        return None
