"""What a BOP dataset says of one picture: its camera and the objects in it. SI units; millimetres stay in the files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError

Array = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]  # OpenCV's plumb bob: k1, k2, p1, p2, k3
MM_PER_M = 1000.0
# Not in BOP, which knows pinhole cameras alone; absent from a file whose pictures have no distortion.
DISTORTION_KEY = "dist_k1_k2_p1_p2_k3"


class BopError(InputError, ValueError):
    """A BOP file that cannot be used; the text is a sentence that names the file and the key."""


@dataclass(frozen=True, eq=False)
class BopTarget:
    """One object in one picture."""

    object_id: int
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]
    box_visible_xyxy_px: Array | None = None  # [4], edges half a pixel outside the outermost visible pixel centres
    box_whole_xyxy_px: Array | None = None  # [4], of the whole outline, also beyond the picture
    visible_px: int | None = None  # pixels of the visible mask
    whole_px: int | None = None  # pixels of the whole outline


@dataclass(frozen=True, eq=False)
class BopFrame:
    """One picture: its camera and the objects in it."""

    image_id: int
    K: Array  # [3, 3]
    targets: tuple[BopTarget, ...] = ()
    R_cam_world: Array | None = None  # [3, 3]
    t_cam_world_m: Array | None = None  # [3]
    distortion: Distortion | None = None  # None: a pinhole camera
    truth_known: bool = True  # False: no file tells what is in it, so no targets does not mean that it is empty
