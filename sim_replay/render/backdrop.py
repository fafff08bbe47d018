"""Photographs and panoramas that replace sky and ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.render.scene import Camera

LARGEST_PX = 4096
INTEGER_WHITE = {"uint8": 255.0, "uint16": 65535.0}
WIDEST_PHOTOGRAPH_RAD = np.radians(60.0)
_GOLDEN = 0.6180339887


class BackdropError(ValueError):
    """A backdrop that cannot be used; the text is a sentence that names the file."""


@dataclass(frozen=True, eq=False)
class Backdrop:
    """An image around the camera, fixed in the world."""

    image_rgb: NDArray[np.uint8]  # [H, W, 3], gamma 2
    panorama: bool  # equirectangular, twice as wide as high; else a photograph

    def map_for(self, camera: Camera, seed: int) -> tuple[float, float, float]:
        """(turn, rad; width, rad; height / width, 0 for a panorama): how world directions map to the image.

        The seed turns it, so that sequences show different parts. A photograph is shown somewhat wider than the field
        of view, its middle at the horizon, and repeats mirrored beyond its edges.
        """
        height, width = self.image_rgb.shape[:2]
        turn = 2.0 * np.pi * ((seed * _GOLDEN) % 1.0)
        seen_rad = 2.0 * np.arctan(0.5 * camera.width_px / camera.K[0, 0])
        wide_rad = 2.0 * np.pi if self.panorama else min(1.6 * seen_rad, float(WIDEST_PHOTOGRAPH_RAD))
        return float(turn), float(wide_rad), 0.0 if self.panorama else height / width


@lru_cache(maxsize=4)
def load_backdrop(path: Path) -> Backdrop:
    """Read a photograph (any format OpenCV reads) or panorama (also Radiance HDR). Raises BackdropError."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise BackdropError(f"backdrop {path} is not a readable picture")
    scale = LARGEST_PX / max(image.shape[:2])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    linear = image.astype(np.float32)
    white = INTEGER_WHITE.get(image.dtype.name)
    if white is not None:
        # Integer files are in sRGB; the renderer works with gamma 2.
        linear = (linear / white) ** 2.2
    else:
        # Exposed for the median, but so that only the brightest (the sun and its like) saturate.
        middle, bright = np.percentile(linear, [50.0, 98.0])
        linear *= min(0.25 / max(float(middle), 1e-9), 0.9 / max(float(bright), 1e-9))
    pixels = np.sqrt(np.clip(linear, 0.0, 1.0)) * 255.0
    rgb = cv2.cvtColor(np.rint(pixels).astype(np.uint8), cv2.COLOR_BGR2RGB)
    height, width = rgb.shape[:2]
    return Backdrop(np.ascontiguousarray(rgb, dtype=np.uint8), abs(width - 2 * height) <= 2)
