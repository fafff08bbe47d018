"""The sampler's output: rendered images with exact labels, as arrays over a batch of N."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

AcquireView = Literal["crop", "frame"]  # a window of the downscaled frame, or the whole frame scaled to a square


@dataclass(frozen=True)
class SampleBatch:
    """N rendered windows or frames of H x W pixels and their labels.

    Pixel centres lie at integer coordinates; a box's edges lie half a pixel outside its outermost pixel centres.
    Where `present` is false, the other labels are zeros (R the identity) without meaning.
    """

    image_bgr: NDArray[np.uint8]  # [N, H, W, 3]
    K: NDArray[np.float32]  # [N, 3, 3], of exactly these pixels
    present: NDArray[np.bool_]  # [N]
    R_cam_target: NDArray[np.float32]  # [N, 3, 3]
    t_cam_target_m: NDArray[np.float32]  # [N, 3]
    box_xyxy_px: NDArray[np.float32]  # [N, 4], of the visible mask, clipped to the image
    mask: NDArray[np.bool_]  # [N, H, W], visible target pixels
    noc: NDArray[np.float16]  # [N, H, W, 3], body-frame surface point / model diameter; zeros off the mask
    airframe_id: NDArray[np.int32]  # [N], as sim_replay.airframes.airframe_of takes it, -1 without a target
    diameter_m: NDArray[np.float32]  # [N], largest distance between two model points
