"""Training data: windows rendered on demand, each a pure function of (seed, index, size), with exact labels."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import AIRFRAMES, airframe_of
from sim_replay.airframes.invented import FLEET_ALONE, Invention
from sim_replay.render.distractors import add_decoy, add_distractors
from sim_replay.render.flown import NONE_FLOWN, FlownShare
from sim_replay.render.frame import MASK_COVERAGE_MIN, Box, is_inside, mask_extents_px, outline_px
from sim_replay.render.placing import VISIBLE_SHARE_MIN, Window, crop_K, draw_window
from sim_replay.render.projection import extents_px
from sim_replay.render.renderer import Rendered, Renderer
from sim_replay.render.scene import Camera, Target
from sim_replay.render.sensor import exposed, sensor_from
from sim_replay.sample import AcquireView, SampleBatch

TILES = (4, 4)


def _labels_blank(count: int, height_px: int, width_px: int) -> dict[str, NDArray]:
    return {
        "image_bgr": np.zeros((count, height_px, width_px, 3), np.uint8),
        "K": np.zeros((count, 3, 3), np.float32),
        "present": np.zeros(count, np.bool_),
        "R_cam_target": np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        "t_cam_target_m": np.zeros((count, 3), np.float32),
        "box_xyxy_px": np.zeros((count, 4), np.float32),
        "mask": np.zeros((count, height_px, width_px), np.bool_),
        "noc": np.zeros((count, height_px, width_px, 3), np.float16),
        "airframe_id": np.full(count, -1, np.int32),
        "diameter_m": np.zeros(count, np.float32),
    }


def _box(target: Target, camera: Camera, mask: NDArray[np.bool_], hidden: bool) -> Box | None:
    """The outline's box, exact to a fraction of a pixel, if neither truncated nor occluded; else the mask's box."""
    outline = extents_px(outline_px(target, camera))
    box = mask_extents_px(mask)
    whole = box is not None and not hidden and is_inside(outline, camera.width_px, camera.height_px)
    return outline if whole else box


def _write_target(
    out: dict[str, NDArray],
    k: int,
    window: Window,
    camera: Camera,
    mask: NDArray[np.bool_],
    noc: NDArray,
    hidden: bool,
) -> None:
    target = window.scene.targets[0]
    box = _box(target, camera, mask, hidden)
    if box is None:
        return
    out["present"][k] = True
    out["box_xyxy_px"][k] = box
    out["R_cam_target"][k], out["t_cam_target_m"][k] = target.pose_in(camera)
    out["mask"][k] = mask
    out["noc"][k][mask] = noc[mask]
    out["airframe_id"][k] = target.airframe_id
    out["diameter_m"][k] = airframe_of(target.airframe_id).diameter_m()


def _enlarged(
    coverage: NDArray[np.uint8], noc: NDArray[np.float16], size_px: int
) -> tuple[NDArray[np.uint8], NDArray[np.float16]]:
    """Coverage and coordinates [S, S, 3] at the window's size; coordinates are averaged over the aircraft only."""
    wide = cv2.resize(coverage, (size_px, size_px), interpolation=cv2.INTER_LINEAR)
    hit = (np.abs(noc).sum(axis=-1) > 0).astype(np.float32)
    weight = cv2.resize(hit, (size_px, size_px), interpolation=cv2.INTER_LINEAR)
    sums = cv2.resize(noc.astype(np.float32), (size_px, size_px), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, np.uint8), (sums / np.maximum(weight, 1e-3)[..., None]).astype(np.float16)


class WindowSampler:
    """Windows of `size_px` square, most of them with one aircraft. Create one in each worker process."""

    def __init__(
        self,
        seed: int,
        size_px: int,
        airframe_ids: Sequence[int] | None = None,
        acquire_share: float = 0.3,
        empty_share: float = 0.12,
        invention: Invention = FLEET_ALONE,
        acquire_view: AcquireView = "crop",
        flown: FlownShare = NONE_FLOWN,
    ) -> None:
        self.seed, self.size_px = seed, size_px
        self.airframe_ids = tuple(range(len(AIRFRAMES)) if airframe_ids is None else airframe_ids)
        self.acquire_share, self.empty_share = acquire_share, empty_share
        self.invention, self.acquire_view, self.flown = invention, acquire_view, flown
        self._renderer: Renderer | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_renderer": None}

    def batch(self, first_index: int, count: int) -> SampleBatch:
        """Windows first_index .. first_index + count - 1; independent of how they are divided into batches."""
        if self._renderer is None:
            self._renderer = Renderer(self.size_px, self.size_px, *TILES)
        out = _labels_blank(count, self.size_px, self.size_px)
        index, stop = first_index, first_index + count
        while index < stop:
            tile = index % self._renderer.capacity
            chunk = range(index, min(stop, index + self._renderer.capacity - tile))
            windows = [self._window(i) for i in chunk]
            rendered = self._renderer.draw([window.scene for window in windows], tile)
            for k, window in enumerate(windows):
                self._finish(out, index - first_index + k, window, rendered, k)
            index = chunk.stop
        return SampleBatch(**out)

    def _window(self, index: int) -> Window:
        shares = self.acquire_share, self.empty_share
        drawn = (
            self.seed,
            index,
            self.size_px,
            self.airframe_ids,
            *shares,
            self.invention,
            self.acquire_view,
            self.flown,
        )
        return draw_window(*drawn)

    def _finish(self, out: dict[str, NDArray], k: int, window: Window, rendered: Rendered, tile: int) -> None:
        side, size = window.scene.camera.width_px, self.size_px
        rng = np.random.default_rng([window.scene.sensor_seed, self.seed])
        image, coverage = rendered.image_bgr[tile, :side, :side], rendered.coverage[tile, :side, :side]
        noc = rendered.coordinate[tile, :side, :side]
        # Where cloud occludes the target, `target` keeps its number but `coverage` does not.
        whole_px = int(np.count_nonzero(rendered.target[tile, :side, :side]))
        clear = int(np.count_nonzero(coverage)) / max(whole_px, 1)
        if window.distractors:
            image = add_distractors(image, coverage, rng)
        if window.decoy:
            image = add_decoy(image, window.decoy, rng)
        image = exposed(image, sensor_from(rng, window.quality), window.native_scale, rng)
        camera = window.scene.camera
        if side < size:
            image = np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR), np.uint8)
            coverage, noc = _enlarged(coverage, noc, size)
            K = crop_K(camera.K, 0.0, 0.0, size / side, size / side)
            camera = Camera(K, size, size, camera.R_ned_cam, camera.t_ned_cam_m)
        out["image_bgr"][k], out["K"][k] = image, camera.K
        if window.visible_share * clear >= VISIBLE_SHARE_MIN:
            _write_target(out, k, window, camera, coverage >= MASK_COVERAGE_MIN, noc, hidden=clear < 1.0)
