"""Files of pictures, read as they were stored."""

from __future__ import annotations

import logging
import struct
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import InputError

_SIXTEEN_BITS_LEAST = 2**14  # data of 10- to 14-bit cameras stay below it, unless they were scaled
_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_ORIENTATION = 274
log = logging.getLogger(__name__)


def read_8_bits(path: Path, flags: int) -> NDArray[np.uint8]:
    """As read_pixels; of 16 bits the upper eight. Warns, once for a folder, if these are next to nothing.

    Raises InputError, also for pixels of neither 8 nor 16 bits.
    """
    pixels = read_pixels(path, flags | cv2.IMREAD_ANYDEPTH)
    if pixels.dtype == np.uint16:
        if pixels.max() < _SIXTEEN_BITS_LEAST:
            _tell_once_of_dark_pictures(path.parent)
        pixels >>= 8
    elif pixels.dtype != np.uint8:
        raise InputError(f"{path} has pixels of {pixels.dtype}, not of 8 or 16 bits")
    return np.asarray(pixels, dtype=np.uint8)


def read_pixels(path: Path, flags: int) -> NDArray[Any]:
    """The pixels as they lie, never turned; `flags` are those of cv2.imdecode.

    Raises InputError for a file that is no picture, that cannot be read, or that was cut short.
    """
    try:
        coded = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    if _is_torn_jpeg(coded):
        raise InputError(f"{path} is cut short: what is missing would be read as gray")
    coded = _with_tiff_unturned(coded)
    try:
        pixels = cv2.imdecode(np.frombuffer(coded, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION) if coded else None
    except cv2.error:  # a header that tells of more pixels than OpenCV takes
        pixels = None
    if pixels is None:
        raise InputError(f"{path} is not a readable picture")
    return pixels


@cache
def _tell_once_of_dark_pictures(folder: Path) -> None:
    log.warning(
        "%s: holds pictures of 16 bits that do not use the upper two: unless it is dark there, "
        "scale them, to 16 or to 8",
        folder,
    )


def _is_torn_jpeg(coded: bytes) -> bool:
    """Whether a JPEG is truncated before its end marker, after which anything may follow. cv2.imread would pad the rest
    with gray; cv2.imdecode refuses it without saying why."""
    if not coded.startswith(b"\xff\xd8"):
        return False
    at = 2
    while at + 4 <= len(coded) and coded[at] == 0xFF and coded[at + 1] != 0xDA:  # to the scan; a thumbnail has its own
        at += 1 if coded[at + 1] == 0xFF else 2 + int.from_bytes(coded[at + 2 : at + 4], "big")
    return coded.find(b"\xff\xd9", at) < 0


def _with_tiff_unturned(coded: bytes) -> bytes:
    """A TIFF whose orientation tag says that its pixels are not turned: OpenCV obeys it whatever the flags. Others as
    they are."""
    order = _TIFF_ORDERS.get(coded[:4])
    if order is None:
        return coded
    try:
        (at,) = struct.unpack_from(f"{order}I", coded, 4)
        (entries,) = struct.unpack_from(f"{order}H", coded, at)
        for entry in range(at + 2, at + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", coded, entry)[0] == _TIFF_ORIENTATION:
                return coded[: entry + 8] + struct.pack(f"{order}H", 1) + coded[entry + 10 :]
    except struct.error:
        pass  # cut short: OpenCV refuses it
    return coded
