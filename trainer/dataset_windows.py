"""Training windows cut from the images of a BOP dataset as the daemon cuts them, mixed with rendered ones.

Missing labels are NaN: object coordinates always, the mask where the dataset has none.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.bop import BopError, BopTarget
from sim_replay.bop.scene import refuse_broken
from sim_replay.datasets import DatasetFrame, open_dataset
from sim_replay.sample import AcquireView, SampleBatch
from trainer.config import Z_RANGE_M, ConfigError
from trainer.data import DENSE_STRIDE, Sampler, TrainingBatch, training_batch

TRACK_SCALE = 1.8
TRACK_JITTER = 0.15  # of the window's side
TRACK_ZOOM = (0.75, 1.33)
ACQUIRE_WIDTH_PX = (640.0, 1280.0)  # of the whole frame, 16:9, when the acquire stage sees it
# Width by height of the acquire stage's image, of any network: a frame of another shape gets black bars in it.
ACQUIRE_ASPECT = (4 / 3, 16 / 9)
VISIBLE_MIN = 0.35  # least share of the box inside the window for the target to be trained on
Array = NDArray[np.float64]
_log = logging.getLogger(__name__)


class DatasetSampler:
    """Window i is a pure function of (seed, i, size) and the dataset.

    Raises ConfigError if the dataset is unreadable, lacks visible boxes, or has all targets out of range.
    """

    def __init__(
        self,
        root: Path,
        split: str | None,
        seed: int,
        size_px: int,
        acquire_share: float,
        acquire_view: AcquireView = "crop",
    ) -> None:
        self.seed, self.size_px, self.acquire_share, self.acquire_view = seed, size_px, acquire_share, acquire_view
        try:
            dataset = open_dataset(root, split)
            self._frames = dataset.boxed_frames()
            self._diameter_m = {key: model.diameter_m for key, model in dataset.models.items()}
        except BopError as error:
            raise ConfigError(str(error)) from error
        if not self._frames:
            raise ConfigError(f"{root}: contains no frames to train on")
        _judge_range(root, self.depths_m)

    @property
    def shows_targets(self) -> bool:
        """Whether any image shows a target."""
        return any(target.box_visible_xyxy_px is not None for frame in self._frames for target in frame.targets)

    @property
    def scene_folders(self) -> set[Path]:
        """Folders of the scenes, without links."""
        return {frame.scene.folder.resolve() for frame in self._frames}

    def refuse_broken_pictures(self) -> None:
        """Raises ConfigError, naming the first of the images and masks that are none or are truncated."""
        paths = [frame.image_path for frame in self._frames]
        for scene in dict.fromkeys(frame.scene for frame in self._frames):
            paths += scene.mask_files
        broken: list[str] = []
        for path in paths:
            try:
                refuse_broken(path)
            except BopError as error:
                broken.append(str(error))
        if broken:
            others = f" (and {len(broken) - 1} more)" if len(broken) > 1 else ""
            raise ConfigError(broken[0] + others)

    @property
    def depths_m(self) -> Array:
        """Z of all targets that an image shows."""
        seen = [target for frame in self._frames for target in frame.targets if target.box_visible_xyxy_px is not None]
        return np.array([target.t_cam_target_m[2] for target in seen])

    def batch(self, first_index: int, count: int) -> TrainingBatch:
        """Windows first_index .. first_index + count - 1."""
        return joined([self._window(i) for i in range(first_index, first_index + count)])

    def _window(self, index: int) -> TrainingBatch:
        rng = np.random.default_rng([self.seed, index, self.size_px])
        frame = self._frames[int(rng.integers(len(self._frames)))]
        try:
            picture = frame.undistorted_bgr()
        except BopError as error:
            raise ConfigError(str(error)) from error
        frame_wh = (picture.shape[1], picture.shape[0])
        boxes = frame.undistorted_boxes_xyxy_px(frame_wh)
        seen = [k for k, box in enumerate(boxes) if box is not None]
        chosen = int(rng.choice(seen)) if seen else None
        box = None if chosen is None else boxes[chosen]
        # If the image's pixels are not square, the window's are nevertheless, so that the aircraft is not distorted.
        aspect = np.array([1.0, frame.K[0, 0] / frame.K[1, 1]])
        low, sides, border = self._cut(
            rng, None if box is None else box * np.tile(aspect, 2), np.array(frame_wh) * aspect
        )
        low, scale = low / aspect, self.size_px * aspect / sides
        to_window = np.column_stack([np.diag(scale), (0.5 - low) * scale - 0.5])
        image = _resampled(picture, to_window, self.size_px, border)
        out = _blank(image, np.vstack([to_window, [0, 0, 1]]) @ frame.K)
        if chosen is not None and box is not None:
            mask = _mask(frame, chosen, frame_wh) if frame.distortion is None else None
            self._label(out, frame.targets[chosen], box, mask, to_window)
        for k, other in enumerate([*boxes, *frame.undistorted_boxes_xyxy_px(frame_wh, frame.unlisted)]):
            if other is not None and k != chosen:
                _mark(out.others[0], other, to_window)
        return out

    def _cut(self, rng: np.random.Generator, box_xyxy_px: Array | None, frame_wh: Array) -> tuple[Array, Array, int]:
        """Position of the first pixel [2] and sides [2] of the window, in the units of the box and the frame, and
        OpenCV's border mode, which says what is outside the frame."""
        if box_xyxy_px is not None and rng.random() >= self.acquire_share:
            low, side = _track_square(rng, box_xyxy_px)
            return low, np.full(2, side), cv2.BORDER_REPLICATE
        if self.acquire_view == "frame":
            return np.zeros(2), frame_wh, cv2.BORDER_REPLICATE
        low, side = _acquire_square(rng, box_xyxy_px, frame_wh, self.size_px)
        return low, np.full(2, side), cv2.BORDER_CONSTANT

    def _label(
        self,
        out: TrainingBatch,
        target: BopTarget,
        box_xyxy_px: Array,
        mask: NDArray[np.bool_] | None,
        to_window: Array,
    ) -> None:
        corners = box_xyxy_px.reshape(2, 2) @ to_window[:, :2].T + to_window[:, 2]
        inside = np.clip(corners, -0.5, self.size_px - 0.5)
        if np.prod(inside[1] - inside[0]) < VISIBLE_MIN * np.prod(corners[1] - corners[0]):
            _mark(out.others[0], box_xyxy_px, to_window)  # too little visible for a pose, but not background
            return
        out.present[0] = True
        out.R_cam_target[0], out.t_cam_target_m[0] = target.R_cam_target, target.t_cam_target_m
        out.center_px[0], out.size_px[0] = inside.mean(axis=0), inside[1] - inside[0]
        out.diameter_m[0] = self._diameter_m.get(target.object_id, 0.0)
        out.coverage[0] = np.nan if mask is None else _coverage(mask, to_window, self.size_px)


def _mask(frame: DatasetFrame, index: int, frame_wh: tuple[int, int]) -> NDArray[np.bool_] | None:
    """The visible mask of a target, if the dataset has masks. Raises ConfigError if it is unreadable or of another size
    than the image."""
    try:
        mask = frame.mask(index)
    except BopError as error:
        raise ConfigError(str(error)) from error
    if mask is not None and mask.shape != frame_wh[::-1]:
        sizes = "{} x {} pixels, its mask {} x {}".format(*frame_wh, *mask.shape[::-1])
        raise ConfigError(f"{frame.scene.folder}: picture {frame.image_id} has {sizes}")
    return mask


def _judge_range(root: Path, Z_m: Array) -> None:
    """Warn about targets whose depth the network cannot predict; raises ConfigError if that applies to all."""
    beyond = (Z_m < Z_RANGE_M[0]) | (Z_m > Z_RANGE_M[1])
    if not beyond.any():
        return
    told = "the network tells {:g} to {:g} m".format(*Z_RANGE_M)
    if beyond.all():
        lie = f"its targets lie {Z_m.min():g} to {Z_m.max():g} m before the camera"
        raise ConfigError(f"{root}: {lie}, but {told}; cam_t_m2c is in millimetres")
    _log.warning("%s: %d of %d targets lie where no depth can be learnt: %s", root, beyond.sum(), len(Z_m), told)


def _track_square(rng: np.random.Generator, box_xyxy_px: Array) -> tuple[Array, float]:
    """Position of the first pixel [2] and side, in frame pixels, of a jittered window around the box."""
    low, high = box_xyxy_px[:2], box_xyxy_px[2:]
    side = TRACK_SCALE * float((high - low).max()) * float(np.exp(rng.uniform(*np.log(TRACK_ZOOM))))
    centre = 0.5 * (low + high) + side * rng.uniform(-TRACK_JITTER, TRACK_JITTER, 2)
    return centre - side / 2 + 0.5, side


def _acquire_square(
    rng: np.random.Generator, box_xyxy_px: Array | None, frame_wh: Array, size_px: int
) -> tuple[Array, float]:
    """The same for a window of the reduced frame with its black bars: at random around the box, or anywhere if there is
    none."""
    # A narrower frame is letterboxed: its height decides how much it is reduced.
    width = max(frame_wh[0], frame_wh[1] * 16 / 9)
    side = size_px * width / float(np.exp(rng.uniform(*np.log(ACQUIRE_WIDTH_PX))))
    aspect = float(np.exp(rng.uniform(*np.log(ACQUIRE_ASPECT))))
    whole_wh = np.maximum(frame_wh, [frame_wh[1] * aspect, frame_wh[0] / aspect])
    first = (frame_wh - whole_wh) / 2  # where the bars begin
    anywhere = first + rng.uniform(0.0, 1.0, 2) * whole_wh
    around = anywhere if box_xyxy_px is None else box_xyxy_px.reshape(2, 2).mean(axis=0)
    low = around - rng.uniform(0.0, 1.0, 2) * side
    return np.where(whole_wh > side, np.clip(low, first, np.maximum(first + whole_wh - side, first)), low), side


def _resampled(picture: NDArray[np.uint8], to_window: Array, size_px: int, border: int) -> NDArray[np.uint8]:
    """Resample with anti-aliasing: when shrinking, the image is blurred to the window's pixel size first. `border`: how
    OpenCV fills what is outside the image."""
    scale = np.diag(to_window)
    if (scale < 1.0).any():
        margin = 2.0 / scale
        start = np.floor(-(to_window[:, 2] + 0.5) / scale - margin).astype(int)
        stop = start + np.ceil(size_px / scale + 2 * margin).astype(int) + 1
        start, stop = np.maximum(start, 0), np.minimum(stop, [picture.shape[1], picture.shape[0]])
        if (stop > start).all():
            crop = picture[start[1] : stop[1], start[0] : stop[0]]
            sigma_x, sigma_y = np.where(scale < 1.0, 0.4 / scale, 1e-3)
            picture = np.asarray(cv2.GaussianBlur(crop, (0, 0), sigma_x, sigmaY=sigma_y), np.uint8)
            to_window = to_window.copy()
            to_window[:, 2] += to_window[:, :2] @ start
    return np.asarray(
        cv2.warpAffine(picture, to_window, (size_px, size_px), flags=cv2.INTER_LINEAR, borderMode=border),
        np.uint8,
    )


def _coverage(mask: NDArray[np.bool_], to_window: Array, size_px: int) -> NDArray[np.float32]:
    """Share of visible target pixels [S/4, S/4]."""
    window = cv2.warpAffine(mask.astype(np.float32), to_window, (size_px, size_px), flags=cv2.INTER_LINEAR)
    side = size_px // DENSE_STRIDE
    return window.reshape(side, DENSE_STRIDE, side, DENSE_STRIDE).mean((1, 3))


def _mark(others: NDArray[np.bool_], box_xyxy_px: Array, to_window: Array) -> None:
    """Set the cells [S/4, S/4] that a box, in frame pixels, touches."""
    corners = box_xyxy_px.reshape(2, 2) @ to_window[:, :2].T + to_window[:, 2]
    first = np.floor((corners[0] + 0.5) / DENSE_STRIDE).astype(int).clip(min=0)
    stop = np.ceil((corners[1] + 0.5) / DENSE_STRIDE).astype(int).clip(min=0)
    others[first[1] : stop[1], first[0] : stop[0]] = True


def _blank(image_bgr: NDArray[np.uint8], K: Array) -> TrainingBatch:
    side = image_bgr.shape[0] // DENSE_STRIDE
    return TrainingBatch(
        image_bgr=image_bgr[None],
        K=K[None].astype(np.float32),
        present=np.zeros(1, np.bool_),
        R_cam_target=np.eye(3, dtype=np.float32)[None],
        t_cam_target_m=np.zeros((1, 3), np.float32),
        center_px=np.zeros((1, 2), np.float32),
        size_px=np.zeros((1, 2), np.float32),
        coverage=np.zeros((1, side, side), np.float32),
        noc=np.full((1, 3, side, side), np.nan, np.float32),
        others=np.zeros((1, side, side), np.bool_),
        diameter_m=np.zeros(1, np.float32),
        airframe_id=np.full(1, -1, np.int32),
    )


def joined(batches: Sequence[TrainingBatch]) -> TrainingBatch:
    """All batches concatenated."""
    return TrainingBatch(*(np.concatenate(values) for values in zip(*batches, strict=True)))


def spans(shares: Sequence[float], first: int, stop: int) -> list[tuple[int, int]]:
    """Range of each source's own samples that first .. stop - 1 of the mixed stream consists of; the last source gets
    the remainder."""
    left, found = Fraction(1), []
    for share in shares[:-1]:
        exact = Fraction(share).limit_denominator(10**6)
        of_rest = min(exact / left, Fraction(1))
        left -= left * of_rest
        found.append((int(of_rest * first), int(of_rest * stop)))
        first, stop = first - found[-1][0], stop - found[-1][1]
    return [*found, (first, stop)]


class MixedSampler:
    """Mixes several samplers, each with its share of the stream; the last one gets the remainder."""

    def __init__(self, samplers: Sequence[Sampler], shares: Sequence[float]) -> None:
        self._samplers, self._shares = tuple(samplers), tuple(shares)

    def batch(self, first_index: int, count: int) -> TrainingBatch:
        """Samples first_index .. first_index + count - 1 of the stream, sampler by sampler.

        Each sampler's own samples are consecutive, so batches that do not overlap share none. A share of less than one
        sample per batch appears in some batches only.
        """
        drawn = []
        own = spans(self._shares, first_index, first_index + count)
        for sampler, (first, stop) in zip(self._samplers, own, strict=True):
            if stop > first:
                one = sampler.batch(first, stop - first)
                drawn.append(training_batch(one) if isinstance(one, SampleBatch) else one)
        return joined(drawn)
