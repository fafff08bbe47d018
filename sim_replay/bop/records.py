"""Contents of a BOP dataset for one image: its camera and objects. SI units; millimetres only in the files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError

Array = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]  # OpenCV's plumb bob: k1, k2, p1, p2, k3
MM_PER_M = 1000.0


class BopError(InputError, ValueError):
    """A BOP file that cannot be used; the text is a sentence that names the file and the key."""


@dataclass(frozen=True, eq=False)
class BopTarget:
    """One object in one image."""

    object_id: int
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]
    box_visible_xyxy_px: Array | None = None  # [4], edges half a pixel outside the outermost visible pixel centres
    box_whole_xyxy_px: Array | None = None  # [4], of the whole outline, also beyond the image
    visible_px: int | None = None  # pixels of the visible mask
    whole_px: int | None = None  # pixels of the whole outline; bop_toolkit's are also those beyond the image

    def is_beside(self, size_wh: tuple[int, int]) -> bool:
        """Whether it is not hidden by anything, but outside an image of that size, as its whole box says."""
        box = self.box_whole_xyxy_px
        return self.visible_px == 0 and box is not None and lies_outside(box, size_wh)


@dataclass(frozen=True, eq=False)
class BopFrame:
    """One image: its camera and objects."""

    image_id: int
    K: Array  # [3, 3]
    targets: tuple[BopTarget, ...] = ()
    R_cam_world: Array | None = None  # [3, 3]
    t_cam_world_m: Array | None = None  # [3]
    distortion: Distortion | None = None  # None: a pinhole camera
    truth_known: bool = True  # False: no file states its content, so it may show targets even if none is listed

    @property
    def camera_in_world(self) -> tuple[Array, Array] | None:
        """R_world_cam [3, 3] and t_world_cam_m [3]; None: unknown."""
        if self.R_cam_world is None or self.t_cam_world_m is None:
            return None
        R_world_cam = self.R_cam_world.T
        return R_world_cam, -R_world_cam @ self.t_cam_world_m


def lies_outside(box_xyxy_px: Array, size_wh: tuple[int, int]) -> bool:
    """Whether the box [4] contains no pixel of an image of that size."""
    return bool(np.any(box_xyxy_px[:2] >= np.array(size_wh) - 0.5) or np.any(box_xyxy_px[2:] <= -0.5))
