"""A far scene all around, and the pictures that a camera takes of it: drawn by rays, by nothing of ours."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

TEXTURE_WH = (2048, 1024)
WHOLE_TURN = 2.0 * np.pi


@cache
def texture() -> NDArray[np.uint8]:
    """[height, width]; a little wider than around, so that the neighbours of the seam are there."""
    rng = np.random.default_rng(7)
    fine, coarse = (
        cv2.GaussianBlur(rng.normal(0, 1, TEXTURE_WH[::-1]).astype(np.float32), (0, 0), sigma) for sigma in (1.5, 8.0)
    )
    grey = np.clip(128 + 40 * (fine / fine.std() + coarse / coarse.std()), 0, 255).astype(np.uint8)
    return np.concatenate([grey, grey[:, :8]], axis=1)


class Panorama:
    """Noise on a sphere, seen through a lens."""

    def __init__(self, K: NDArray[np.float64], size_wh: tuple[int, int], distortion: tuple[float, ...] = ()) -> None:
        xs, ys = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in size_wh))
        pixels = np.stack([xs, ys], axis=-1).reshape(-1, 1, 2)
        exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        xy = cv2.undistortPoints(pixels, K, np.array(distortion or np.zeros(4)), criteria=exact).reshape(-1, 2)
        self._rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)
        self._rays /= np.linalg.norm(self._rays, axis=-1, keepdims=True)
        self._size_wh = size_wh

    def picture(self, ned_cam: Rotation, per_row: Rotation | None = None) -> NDArray[np.uint8]:
        """[H, W, 3]. `per_row`: attitudes [H] of the rows instead, of a rolling shutter."""
        width, height = self._size_wh
        if per_row is None:
            north, east, down = (self._rays @ ned_cam.as_matrix().T).T
        else:
            rays = self._rays.reshape(height, width, 3)
            north, east, down = np.einsum("hij,hwj->ihw", per_row.as_matrix(), rays).reshape(3, -1)
        u = (np.arctan2(east, north) % WHOLE_TURN) / WHOLE_TURN * TEXTURE_WH[0]
        v = (np.arcsin(np.clip(down, -1, 1)) / np.pi + 0.5) * TEXTURE_WH[1] - 0.5
        shape = (height, width)
        grey = cv2.remap(
            texture(), u.reshape(shape).astype(np.float32), v.reshape(shape).astype(np.float32), cv2.INTER_LINEAR
        )
        return np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=-1)
