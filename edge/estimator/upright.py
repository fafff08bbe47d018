"""Pictures turned by quarters, so that the network sees them upright. Pure.

Cameras are mounted upside down or on their side, and aircraft bank. In training no camera is rolled by more than 40
degrees: the network takes a picture that is upside down for one that is not, and is as sure of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.estimator.model import Peaks
from edge.types import Array, Mount, OwnShip

# Least share of "up" that lies in the picture: a camera that looks within 15 degrees of straight up or down has none.
IN_PICTURE_MIN = float(np.sin(np.deg2rad(15.0)))


def up_in_cam(own_ship: OwnShip | None, mount: Mount) -> Array:
    """The unit vector upwards, [3] in `cam`; an own ship of unknown attitude is taken to fly level."""
    R_ned_cam = mount.R_body_cam if own_ship is None else own_ship.R_ned_body @ own_ship.camera(mount).R_body_cam
    return -R_ned_cam[2]


def quarter_turns(up_cam: Array | None) -> int:
    """How many counter-clockwise, 0..3, bring up to the top of the picture; 0 if it is unknown or not in it."""
    if up_cam is None or np.hypot(up_cam[0], up_cam[1]) < IN_PICTURE_MIN:
        return 0
    return round(float(np.arctan2(up_cam[0], -up_cam[1])) / (0.5 * np.pi)) % 4


def turned(images_bgr: NDArray[np.uint8], K: Array, turns: int) -> tuple[NDArray[np.uint8], Array]:
    """Images [N, H, W, 3] turned counter-clockwise by that many quarters, and the K [N, 3, 3] of their pixels."""
    if turns == 0:
        return images_bgr, K
    R, shift_px = _turn(turns, (images_bgr.shape[2], images_bgr.shape[1]))
    pixels = R.copy()
    pixels[:2, 2] = shift_px
    return np.ascontiguousarray(np.rot90(images_bgr, turns, axes=(1, 2))), pixels @ K @ R.T


def turned_back(peaks: Peaks, size_wh: tuple[int, int], turns: int) -> Peaks:
    """The network's outputs for turned images, converted to the images of `size_wh` that were turned."""
    if turns == 0:
        return peaks
    R, shift_px = _turn(turns, size_wh)
    first, second = (1, 0) if turns % 2 else (0, 1)
    return replace(
        peaks,
        center_px=((peaks.center_px - shift_px) @ R[:2, :2]).astype(np.float32),
        size_px=peaks.size_px[..., [first, second]],
        origin_px=((peaks.origin_px - shift_px) @ R[:2, :2]).astype(np.float32),
        t_cam_target_m=(peaks.t_cam_target_m @ R).astype(np.float32),
        R_cam_target=(R.T @ peaks.R_cam_target).astype(np.float32),
        sigma=peaks.sigma[..., [first, second, 2, 3 + first, 3 + second, 5]],
    )


def _turn(turns: int, size_wh: tuple[int, int]) -> tuple[Array, Array]:
    """R [3, 3] of the turned camera from the camera, and the shift [2] px: p' = R p + shift for pixels p of an image of
    `size_wh`."""
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    R = np.linalg.matrix_power(quarter, turns)
    middle = 0.5 * (np.array(size_wh) - 1.0)
    return R, (middle[::-1] if turns % 2 else middle) - R[:2, :2] @ middle
