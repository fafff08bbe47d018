"""A BOP dataset for evaluation and training: its frames, cameras, targets in body axes (FRD) and models.

    dataset = open_dataset(Path("FW-UAV6DPose"), "test")
    for frame in dataset.frames():
        picture = frame.undistorted_bgr()   # of the pinhole camera frame.K

What a dataset omits is derived: visible boxes from masks, otherwise from the projected model; diameters from the
meshes, otherwise from the targets' apparent size at their known depth.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.estimator.lens import Lens, lens_of
from edge.estimator.window import clipped
from sim_replay.bop import BopError, BopFrame, BopScene, BopTarget, Distortion, Model, find_scenes, read_models
from sim_replay.bop.layout import TARGETS_FILE, dataset_of
from sim_replay.bop.models import models_folder
from sim_replay.bop.records import lies_outside
from sim_replay.bop.scene import Image, Mask, header_size_wh, picture_size_wh, read_picture_bgr
from sim_replay.bop.target_list import Wanted, chosen_of, read_targets
from sim_replay.label_fit import Labelled, lie_beside_their_boxes, told_of_places, told_of_sizes

Array = NDArray[np.float64]
_MASKS_LOOKED_AT = 200  # masks that are read to estimate diameters if there are neither models nor boxes
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class DatasetFrame:
    """One image with its ground truth."""

    scene_id: int
    image_id: int
    K: Array  # [3, 3], pixel centres at integers
    distortion: Distortion | None  # k1, k2, p1, p2, k3 of the stored image; None: a pinhole camera
    image_path: Path
    targets: tuple[BopTarget, ...]  # poses of body axes (FRD); boxes in the stored image
    scene: BopScene = field(repr=False)
    target_indices: tuple[int, ...]  # of each target among all that the scene lists for this image
    truth_known: bool = True  # see sim_replay.bop.BopFrame
    unlisted: tuple[BopTarget, ...] = ()  # others that are present but not listed in test_targets_bop19.json

    def image_bgr(self) -> Image:
        """The image as stored [H, W, 3]. Raises BopError."""
        return read_picture_bgr(self.image_path)

    def undistorted_bgr(self) -> Image:
        """The image [H, W, 3] that the pinhole camera K would have taken. Raises BopError."""
        return read_undistorted_bgr(self.image_path, self.K, self.distortion)

    def undistorted_boxes_xyxy_px(
        self, frame_wh: tuple[int, int], targets: Sequence[BopTarget] | None = None
    ) -> list[Array | None]:
        """The visible box [4] of each target in undistorted_bgr() of size frame_wh; None: not visible there.

        The original image may show more than the undistorted one, so boxes are clipped to its edges. `targets`: whose
        boxes; None: those of `self.targets`.
        """
        boxes = [target.box_visible_xyxy_px for target in (self.targets if targets is None else targets)]
        lens = lens_of(self.K, self.distortion or ())
        return boxes if lens is None else [None if box is None else _straight(lens, box, frame_wh) for box in boxes]

    def mask(self, k: int) -> Mask | None:
        """The visible mask [H, W] of targets[k] in the stored image; None if the dataset has none."""
        return self.scene.mask(BopFrame(self.image_id, self.K), self.target_indices[k])


@dataclass(frozen=True, eq=False)
class Dataset:
    """Scenes of one dataset; indices are read scene by scene, images only on use."""

    name: str
    root: Path
    split: str | None  # None: it has no splits, or several of them were opened together
    scenes: tuple[BopScene, ...]
    one_scene: bool = False  # opened by a scene's folder: others that the dataset may have are not missing

    @cached_property
    def models(self) -> dict[int, Model]:
        """By object id; sizes in body axes, metres. Raises BopError.

        For a dataset without any model, diameters come from its boxes (or masks): the largest side at the target's
        depth over all its images. This exceeds the true diameter by at most the equivalent of one pixel.
        """
        frames = self.scenes[0].models
        models = read_models(self.root, frames)
        if models and models_folder(self.root) is not None:
            return models
        seen = {
            object_id: Model(frames.common.diameter_m or looks_m)
            for object_id, looks_m in _diameters_from_boxes(self.scenes).items()
            if frames.common.diameter_m or looks_m
        }
        return seen | models

    def frames(self) -> Iterator[DatasetFrame]:
        """Every frame that has an image, by scene and image id; of a test split those in test_targets_bop19.json.

        Raises BopError, naming file and key; also at the end if that file lists no existing image.
        """
        wanted = self._wanted
        passed_over, absent, met = 0, 0, set[tuple[int, int]]()
        for scene in self.scenes:
            frames = scene.pictured
            if len(frames) < len(scene.frames):
                _log.warning("%s: %d listed pictures are missing", scene.folder, len(scene.frames) - len(frames))
            if scene.pictures_without_camera:
                told = "%s: %d pictures are left out: no file gives their camera matrix"
                _log.warning(told, scene.folder, scene.pictures_without_camera)
            for frame in frames:
                listed = None
                if wanted is not None and _is_test(scene):
                    key = scene.scene_id, frame.image_id
                    if key not in wanted:
                        passed_over += 1
                        continue
                    met.add(key)
                    listed = wanted[key]
                    if frame.truth_known:
                        absent += (listed - Counter(target.object_id for target in frame.targets)).total()
                yield self._frame(scene, frame, listed)
        if passed_over and not met:
            raise BopError(f"{self.root / TARGETS_FILE}: lists none of the {passed_over} pictures of the test scenes")
        if absent:
            told = "%s: %d of the targets that it lists are not in the ground truth, and count nowhere"
            _log.warning(told, self.root / TARGETS_FILE, absent)
        if met and wanted is not None:
            self._warn_of_missing(wanted.keys() - met)

    def _warn_of_missing(self, pictures: Set[tuple[int, int]]) -> None:
        if self.one_scene:
            pictures = {key for key in pictures if key[0] == self.scenes[0].scene_id}
        if pictures:
            told = "%s: %d of the pictures that it lists are missing, and count nowhere, such as %d of scene %d"
            scene_id, image_id = min(pictures)
            _log.warning(told, self.root / TARGETS_FILE, len(pictures), image_id, scene_id)

    def pictured_frames(self) -> Iterator[DatasetFrame]:
        """Every frame that has an image, whatever test_targets_bop19.json lists. Raises BopError."""
        for scene in self.scenes:
            for frame in scene.pictured:
                yield self._frame(scene, frame)

    def labelled_frames(self) -> list[DatasetFrame]:
        """The frames() with known ground truth: some datasets do not publish that of their test splits.

        Warns of labels that do not fit each other. Raises BopError, also if the ground truth is known for none.
        """
        frames = list(self.frames())
        known = [frame for frame in frames if frame.truth_known]
        if frames and not known:
            raise BopError(f"{self.root}: no scene_gt.json (or KEY.gt.json) tells what its pictures show")
        told = "%s: %d pictures count nowhere: no scene_gt.json (or KEY.gt.json) tells what they show"
        for folder, number in Counter(frame.scene.folder for frame in frames if not frame.truth_known).items():
            _log.warning(told, folder, number)
        labelled = _labelled(known)
        diameters_m = {object_id: model.diameter_m for object_id, model in self.models.items()}
        for misfit in (told_of_places(labelled), told_of_sizes(labelled, diameters_m)):
            if misfit is not None:
                _log.warning("%s: %s", self.root, misfit)
        return known

    def boxed_frames(self) -> list[DatasetFrame]:
        """The labelled_frames(), each target with a visible box or known to be invisible.

        Raises BopError, also for a target of unknown visibility, and if most targets lie beside their boxes.
        """
        frames = self.labelled_frames()
        for frame in frames:
            for target in frame.targets:
                if _unseen(target):
                    raise BopError(
                        f"{frame.scene.folder}: nothing tells where picture {frame.image_id} shows its target of "
                        f"obj_id {target.object_id}: give scene_gt_info.json, masks, or a model with a mesh or a box"
                    )
        if lie_beside_their_boxes(_labelled(frames)):
            raise BopError(
                f"{self.root}: most poses project beside their boxes, farther than these are long: nothing can be "
                "learnt from such labels; is cam_K in pixels of these images, and do poses and boxes belong to the "
                "same targets?"
            )
        return frames

    @cached_property
    def _wanted(self) -> Wanted | None:
        return read_targets(self.root / TARGETS_FILE)

    def _frame(self, scene: BopScene, frame: BopFrame, listed: Counter[int] | None = None) -> DatasetFrame:
        """`listed`: how many instances of each object are to be found; None: all."""
        path = scene.image_path(frame)
        size_wh = header_size_wh(path)
        targets = [_with_box(scene, frame, index, size_wh) for index in range(len(frame.targets))]
        placed = [
            _as_projected(t, self.models.get(t.object_id), frame, picture_size_wh(path)) if _unseen(t) else t
            for t in targets
        ]
        if size_wh is not None:
            _refuse_boxes_outside(scene, frame, placed, size_wh)
            placed = [replace(t, whole_px=0) if t.is_beside(size_wh) else t for t in placed]
        indices = range(len(placed)) if listed is None else chosen_of(placed, listed)
        return DatasetFrame(
            scene.scene_id,
            frame.image_id,
            frame.K,
            frame.distortion,
            path,
            tuple(placed[index] for index in indices),
            scene,
            tuple(indices),
            frame.truth_known,
            tuple(target for index, target in enumerate(placed) if index not in indices),
        )


def open_dataset(path: Path, split: str | None = None) -> Dataset:
    """Open a BOP dataset, a split of it or one scene, scenewise or imagewise.

    Args:
        path: Any folder of the dataset that contains scenes or is one.
        split: Name of a split below `path`; `test` also finds `test_primesense` if it is the only one of its kind.
            None takes all splits in `path`.

    Raises:
        BopError: There is no scene, no such split, more than one dataset, or a file is invalid.
    """
    scenes = find_scenes(path)
    holders = {dataset_of(scene): scene for scene in scenes}
    if len(holders) > 1:
        told = ", ".join(str(root or f"that of {scene.folder}") for root, scene in holders.items())
        raise BopError(f"{path}: holds the scenes of more than one dataset: {told}; name one of them")
    splits = list(dict.fromkeys(scene.split for scene in scenes if scene.split))
    if split is not None:
        chosen = [split] if split in splits else [name for name in splits if name.startswith(f"{split}_")]
        if len(chosen) != 1:
            has = f"it has {', '.join(splits)}" if splits else "it has no splits"
            raise BopError(f"{path}: no split {split!r}; {has}")
        splits = chosen
        scenes = tuple(scene for scene in scenes if scene.split == chosen[0])
    root = scenes[0].root or path
    one_scene = len(scenes) == 1 and scenes[0].folder == path
    return Dataset(root.absolute().name, root, splits[0] if len(splits) == 1 else None, scenes, one_scene)


def _is_test(scene: BopScene) -> bool:
    return scene.split is not None and scene.split.startswith("test")


def _labelled(frames: Sequence[DatasetFrame]) -> list[Labelled]:
    every = ((frame, target) for frame in frames for target in frame.targets)
    return [Labelled(target, frame.K, frame.distortion, frame.scene.folder) for frame, target in every]


def _unseen(target: BopTarget) -> bool:
    """Whether its visibility is unknown (a target marked as hidden has visible_px 0)."""
    return target.box_visible_xyxy_px is None and target.visible_px is None


def _with_box(scene: BopScene, frame: BopFrame, index: int, size_wh: tuple[int, int] | None = None) -> BopTarget:
    """The target with a visible box from its mask, if the scene has a mask but no other information on visibility.

    Raises BopError if the mask is not of the size of the picture, where that is given.
    """
    target = frame.targets[index]
    if not _unseen(target):
        return target
    visible = scene.mask(frame, index)
    whole = scene.whole_mask(frame, index) if visible is None or not visible.any() else None
    mask = whole if visible is None else visible
    if mask is None:
        return target
    if size_wh is not None and mask.shape != size_wh[::-1]:
        raise BopError(
            f"{scene.folder}: picture {frame.image_id} has {size_wh[0]} x {size_wh[1]} pixels, but its mask has "
            f"{mask.shape[1]} x {mask.shape[0]}"
        )
    if mask.any() and target.t_cam_target_m[2] <= 0:
        raise BopError(
            f"{scene.folder}: a mask shows obj_id {target.object_id} in picture {frame.image_id}, "
            "but its cam_t_m2c lies behind the camera"
        )
    whole_px = None if whole is None else int(whole.sum())
    return replace(target, box_visible_xyxy_px=box_of_mask(mask), visible_px=int(mask.sum()), whole_px=whole_px)


def _straight(lens: Lens, box_xyxy_px: Array, frame_wh: tuple[int, int]) -> Array | None:
    straight = clipped(lens.box_to_pinhole(box_xyxy_px), frame_wh)
    return straight if (straight[:2] < straight[2:]).all() else None  # NaN if the distortion cannot be inverted


def box_of_mask(mask: Mask) -> Array | None:
    """Box (x, y, x, y) around the set pixels of a mask [H, W], edges half a pixel outside their centres; or None."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return np.array([columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5])


def _refuse_boxes_outside(
    scene: BopScene, frame: BopFrame, targets: Sequence[BopTarget], size_wh: tuple[int, int]
) -> None:
    for target in targets:
        box = target.box_visible_xyxy_px
        if box is not None and lies_outside(box, size_wh):
            raise BopError(
                f"{scene.folder}: picture {frame.image_id} has {size_wh[0]} x {size_wh[1]} pixels, but the visible box "
                f"of its obj_id {target.object_id} lies outside: "
                "are scene_gt_info.json and scene_camera.json for another size?"
            )


def _as_projected(target: BopTarget, model: Model | None, frame: BopFrame, size_wh: tuple[int, int]) -> BopTarget:
    """The target with boxes from its model's vertices, or its box's corners.

    Of a model that only its diameter tells of, it is known whether the target is beside the image, but not its box.
    """
    if model is None:
        return target
    if model.points_m is not None:
        return _with_projected_box(target, model.points_m, frame, size_wh)
    around_m = model.diameter_m * np.array(list(product((-1.0, 1.0), repeat=3)))  # wherever in it the origin is
    beside = _with_projected_box(target, around_m, frame, size_wh).visible_px == 0
    return replace(target, visible_px=0) if beside else target


def _with_projected_box(target: BopTarget, points: Array, frame: BopFrame, size_wh: tuple[int, int]) -> BopTarget:
    """The target with boxes from points [N, 3] that bound it in body axes, metres.

    A target behind the camera is hidden; one that extends behind it is left unchanged.
    """
    points_cam = points @ target.R_cam_target.T + target.t_cam_target_m
    if points_cam[:, 2].max() <= 0:
        return replace(target, visible_px=0)
    if points_cam[:, 2].min() <= 0:
        return target
    rays = points_cam / points_cam[:, 2:]
    lens = lens_of(frame.K, frame.distortion or ())
    if lens is not None:
        # Beyond this radius the lens's polynomial folds back: it would show the target where it is not.
        radius = np.linalg.norm(rays[:, :2], axis=1, keepdims=True)
        if radius.min() >= lens.radius_max:
            return replace(target, visible_px=0)
        rays[:, :2] *= lens.radius_max / np.maximum(radius, lens.radius_max)
    coefficients = np.array(frame.distortion or np.zeros(5))
    pixels, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), frame.K, coefficients)
    low, high = pixels.reshape(-1, 2).min(axis=0), pixels.reshape(-1, 2).max(axis=0)
    edge_low, edge_high = np.full(2, -0.5), np.array(size_wh) - 0.5
    inside = np.concatenate([np.maximum(low, edge_low), np.minimum(high, edge_high)])
    hidden = bool((inside[:2] >= inside[2:]).any())
    return replace(
        target,
        box_whole_xyxy_px=np.concatenate([low, high]),
        box_visible_xyxy_px=None if hidden else inside,
        visible_px=0 if hidden else None,
    )


def _diameters_from_boxes(scenes: Sequence[BopScene]) -> dict[int, float]:
    """By object id, metres; 0 for an object without any box or mask."""
    largest: dict[int, float] = {}
    bare: list[tuple[BopScene, BopFrame, int]] = []
    for scene in scenes:
        for frame in scene.frames:
            for index, target in enumerate(frame.targets):
                largest.setdefault(target.object_id, 0.0)
                box = target.box_whole_xyxy_px if target.box_whole_xyxy_px is not None else target.box_visible_xyxy_px
                _widen(largest, target, box, frame.K)
                if _unseen(target):
                    bare.append((scene, frame, index))
    for scene, frame, index in bare[:: max(1, len(bare) // _MASKS_LOOKED_AT)]:
        target = _with_box(scene, frame, index)
        _widen(largest, target, target.box_visible_xyxy_px, frame.K)
    return largest


def _widen(largest: dict[int, float], target: BopTarget, box_xyxy_px: Array | None, K: Array) -> None:
    if box_xyxy_px is not None:
        sides_m = (box_xyxy_px[2:] - box_xyxy_px[:2]) / np.array([K[0, 0], K[1, 1]]) * target.t_cam_target_m[2]
        largest[target.object_id] = max(largest[target.object_id], float(sides_m.max()))


def read_undistorted_bgr(path: Path, K: Array, distortion: Distortion | None) -> Image:
    """The image [H, W, 3] that the pinhole camera K would have taken without distortion. Raises BopError."""
    image_bgr = read_picture_bgr(path)
    if distortion is None:
        return image_bgr
    return np.asarray(cv2.undistort(image_bgr, K, np.array(distortion)), dtype=np.uint8)
