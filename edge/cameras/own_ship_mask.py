"""Reads [camera] own_ship_mask: where the own aircraft is in the picture."""

from __future__ import annotations

import cv2

from edge.cameras.picture_file import read_8_bits
from edge.config_camera import Camera
from edge.errors import InputError
from edge.estimator.own_parts import OwnParts

KEY = ("camera", "own_ship_mask")
SHARE_MAX = 0.5  # a mask that hides more is probably the wrong way round


def load_own_parts(settings: Camera, image_size_wh: tuple[int, int]) -> OwnParts | None:
    """For pictures of this size; None if no mask is configured.

    Raises InputError for a file that is no picture, or of another shape, or that hides nothing, or more than half.
    """
    path = settings.own_ship_mask
    if path is None:
        return None
    try:
        mask = read_8_bits(path, cv2.IMREAD_GRAYSCALE)
    except InputError as error:
        raise InputError(str(error), KEY) from error
    (h, w), (width, height) = mask.shape, image_size_wh
    if w * height != h * width:
        raise InputError(
            f"{path} is for {w}x{h} pixels, but the camera gives {width}x{height}, which is not the same shape", KEY
        )
    parts = OwnParts.of(mask, image_size_wh)
    if not 0.0 < parts.share <= SHARE_MAX:
        raise InputError(
            f"{path} is white over {100 * parts.share:.0f} % of the picture: white is where the own aircraft is seen, "
            f"at most {100 * SHARE_MAX:.0f} %",
            KEY,
        )
    return parts
