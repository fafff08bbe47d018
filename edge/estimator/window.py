"""Between the frame's pixels and the network's: fits whole frames, cuts windows, transforms K exactly. Pure.

The network always sees a pinhole camera of square pixels. Only the pixels it is given are undistorted; the boxes it
finds are distorted back to the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.estimator.lens import Lens
from edge.types import Array

Image = NDArray[np.uint8]

# Pixels whose sides differ by less count as square: training contains such, and calibrations are no more exact.
SQUARE_WITHIN = 0.03
ASPECT_MOST = 4.0  # no camera's pixels are longer; unbounded, a mistake in fx or fy could demand any amount of memory

_GRID_POINTS = 9  # each way, to find the part of the frame that a window covers through a lens
_MARGIN_PX = 4.0  # around that part: for what lies between the grid points, and for bilinear sampling
_NOWHERE = -1000.0  # a coordinate outside every frame


@dataclass(frozen=True)
class PixelMap:
    """Pinhole pixels c to network pixels c' = (c + 0.5) * scale - 0.5 + offset, each axis; pixel centres at integers.

    Without a lens, frame pixels are pinhole pixels.
    """

    scale_xy: tuple[float, float]
    offset_xy: tuple[float, float]
    lens: Lens | None = None

    def to_network(self, points_px: ArrayLike) -> Array:
        """[..., 2] frame pixels to network pixels."""
        points = np.asarray(points_px, dtype=np.float64)
        pinhole = points if self.lens is None else self.lens.to_pinhole(points)
        return (pinhole + 0.5) * self.scale_xy - 0.5 + self.offset_xy

    def to_frame(self, points_px: ArrayLike) -> Array:
        """[..., 2] network pixels to frame pixels."""
        pinhole = self.to_pinhole(points_px)
        return pinhole if self.lens is None else self.lens.to_frame(pinhole)

    def to_pinhole(self, points_px: ArrayLike) -> Array:
        """[..., 2] network pixels to pinhole pixels."""
        return (np.asarray(points_px, dtype=np.float64) + 0.5 - self.offset_xy) / self.scale_xy - 0.5

    def box_to_frame(self, center_px: ArrayLike, size_px: ArrayLike) -> Array:
        """Centre and size [..., 2] in network pixels to box_xyxy_px [..., 4] on the frame."""
        center = self.to_pinhole(center_px)
        half = 0.5 * np.asarray(size_px, dtype=np.float64) / self.scale_xy
        box = np.concatenate([center - half, center + half], axis=-1)
        return box if self.lens is None else self.lens.box_to_frame(box)

    def intrinsics(self, K: ArrayLike) -> Array:
        """K [3, 3] of the frame to K of the network's pixels: the same camera with other pixels."""
        (sx, sy), (ox, oy) = self.scale_xy, self.offset_xy
        to_network = np.array([[sx, 0.0, 0.5 * sx - 0.5 + ox], [0.0, sy, 0.5 * sy - 0.5 + oy], [0.0, 0.0, 1.0]])
        return to_network @ np.asarray(K, dtype=np.float64)


@dataclass(frozen=True)
class Window:
    """Pinhole pixels left .. left + width - 1, top .. top + height - 1; it may reach beyond the frame."""

    left: int
    top: int
    width: int
    height: int

    def pixel_map(self, size_wh: tuple[int, int], lens: Lens | None = None) -> PixelMap:
        sx, sy = size_wh[0] / self.width, size_wh[1] / self.height
        return PixelMap((sx, sy), (-self.left * sx, -self.top * sy), lens)


def pixel_aspect(K: ArrayLike) -> float:
    """Height of a pixel over its width, in angles; exactly 1 if it is within SQUARE_WITHIN of square.

    Capture cards deliver non-square pixels for analogue and anamorphic video. The network was trained on none: it would
    confidently take the aircraft for a longer or a taller one.
    """
    f = np.asarray(K, dtype=np.float64)
    aspect = float(np.clip(f[0, 0] / f[1, 1], 1.0 / ASPECT_MOST, ASPECT_MOST))
    return 1.0 if abs(np.log(aspect)) <= SQUARE_WITHIN else aspect


def whole_frame(frame_wh: tuple[int, int], lens: Lens | None = None) -> Window:
    """The window that contains the whole frame, undistorted."""
    if lens is None:
        return Window(0, 0, *frame_wh)
    x0, y0, x1, y1 = lens.extent_xyxy_px(frame_wh)
    left, top = int(np.floor(x0 + 0.5)), int(np.floor(y0 + 0.5))
    return Window(left, top, max(int(np.ceil(x1 + 0.5)) - left, 2), max(int(np.ceil(y1 + 0.5)) - top, 2))


def fit_frame(
    image_bgr: Image,
    size_wh: tuple[int, int],
    fit: Literal["letterbox", "squash"],
    lens: Lens | None = None,
    aspect: float = 1.0,
    part: Window | None = None,
) -> tuple[Image, PixelMap]:
    """The whole frame [H, W, 3] as the network's image [h, w, 3]: letterboxed (square pixels, black bars) or squashed.

    `aspect`: of the frame's pixels (pixel_aspect). `part`: of whole_frame, if only that is to be shown.
    """
    seen = part or whole_frame((image_bgr.shape[1], image_bgr.shape[0]), lens)
    inner_wh = size_wh
    if fit == "letterbox":
        height = seen.height * aspect
        scale = min(size_wh[0] / seen.width, size_wh[1] / height)
        inner_wh = (max(round(seen.width * scale), 1), max(round(height * scale), 1))
    inner_map = seen.pixel_map(inner_wh, lens)
    if lens is None:
        inner = _resize(image_bgr[seen.top : seen.top + seen.height, seen.left : seen.left + seen.width], inner_wh)
    else:
        inner = _straightened(image_bgr, lens, inner_map, inner_wh, cv2.BORDER_CONSTANT)
    left, top = (size_wh[0] - inner_wh[0]) // 2, (size_wh[1] - inner_wh[1]) // 2
    out = np.zeros((size_wh[1], size_wh[0], 3), dtype=np.uint8)
    out[top : top + inner_wh[1], left : left + inner_wh[0]] = inner
    offset_xy = (inner_map.offset_xy[0] + left, inner_map.offset_xy[1] + top)
    return out, PixelMap(inner_map.scale_xy, offset_xy, lens)


def window_around(
    box_xyxy_px: ArrayLike,
    window_scale: float,
    size_wh: tuple[int, int],
    image_size_wh: tuple[int, int],
    lens: Lens | None = None,
    aspect: float = 1.0,
) -> Window:
    """The window around a box on the frame, with the network's aspect ratio.

    Its shorter side is window_scale times the box's longer one; sides are measured with the pixels' `aspect`
    (pixel_aspect), so that the network sees square pixels.

    If it fits, it is moved into the frame: real pixels are worth more than a repeated border. It is limited to the
    frame's longer side: the box of a target predicted very near is unbounded, memory is not.
    """
    seen = whole_frame(image_size_wh, lens)
    box = np.asarray(box_xyxy_px, dtype=np.float64)
    # The lens is known on the frame only.
    x0, y0, x1, y1 = box if lens is None else _straight(lens, clipped(box, image_size_wh))
    side = min(window_scale * max(x1 - x0, (y1 - y0) * aspect, 1.0), float(max(seen.width, seen.height * aspect)))
    shorter = min(size_wh)
    width, height = (
        _halvable(max(round(side * size / shorter / high), 2), size)
        for size, high in zip(size_wh, (1.0, aspect), strict=True)
    )
    # The outermost pixel centres lie half a pixel inside the window's edges.
    left = round(0.5 * (x0 + x1) - 0.5 * (width - 1))
    top = round(0.5 * (y0 + y1) - 0.5 * (height - 1))
    return Window(
        _inside(left, width, seen.left, seen.width), _inside(top, height, seen.top, seen.height), width, height
    )


def cut(image_bgr: Image, window: Window, size_wh: tuple[int, int], lens: Lens | None = None) -> Image:
    """The window's pixels at the network's size [h, w, 3]; beyond the frame its border pixels are repeated."""
    if lens is not None:
        return _straightened(image_bgr, lens, window.pixel_map(size_wh, lens), size_wh, cv2.BORDER_REPLICATE)
    height, width = image_bgr.shape[:2]
    rows = slice(max(window.top, 0), min(window.top + window.height, height))
    columns = slice(max(window.left, 0), min(window.left + window.width, width))
    pixels: Image = image_bgr[rows, columns]
    if pixels.shape[:2] != (window.height, window.width):
        margins = (
            rows.start - window.top,
            window.top + window.height - rows.stop,
            columns.start - window.left,
            window.left + window.width - columns.stop,
        )
        pixels = np.asarray(cv2.copyMakeBorder(pixels, *margins, cv2.BORDER_REPLICATE), dtype=np.uint8)
    return _resize(pixels, size_wh)


def _straightened(image_bgr: Image, lens: Lens, pixel_map: PixelMap, size_wh: tuple[int, int], border: int) -> Image:
    """The image [h, w, 3] of the map's pinhole camera: the part of the frame it covers, downscaled, then undistorted.

    Downscaling first averages pixels; a remap alone only samples points.
    """
    grid = np.stack(np.meshgrid(*(np.linspace(-0.5, side - 0.5, _GRID_POINTS) for side in size_wh)), axis=-1)
    pinhole = pixel_map.to_pinhole(grid).reshape(-1, 2)
    folded = np.linalg.norm(lens.rays(pinhole)[:, :2], axis=1) > lens.radius_max
    points = lens.to_frame(pinhole[~folded] if not folded.all() else pinhole[:1])
    shrink_x, shrink_y = (min(scale, 1.0) for scale in pixel_map.scale_xy)
    left, right = _span(points[:, 0], shrink_x, image_bgr.shape[1])
    top, bottom = _span(points[:, 1], shrink_y, image_bgr.shape[0])
    part = Window(left, top, right - left, bottom - top)
    pixels: Image = image_bgr[top:bottom, left:right]
    part_wh = (max(round(part.width * shrink_x), 1), max(round(part.height * shrink_y), 1))
    if part_wh != (part.width, part.height):
        pixels = _resize(pixels, part_wh)
    K_part, K_network = part.pixel_map(part_wh).intrinsics(lens.K), pixel_map.intrinsics(lens.K)
    maps = cv2.initUndistortRectifyMap(K_part, np.array(lens.distortion), None, K_network, size_wh, cv2.CV_32FC1)
    if folded.any():
        maps[0][_folded(lens, pixel_map, size_wh)] = _NOWHERE
    straight = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(straight, dtype=np.uint8)


def _folded(lens: Lens, pixel_map: PixelMap, size_wh: tuple[int, int]) -> NDArray[np.bool_]:
    """[h, w], which of the network's pixels have rays beyond the lens model's valid radius."""
    columns, rows = np.meshgrid(np.arange(size_wh[0]), np.arange(size_wh[1]))
    rays = lens.rays(pixel_map.to_pinhole(np.stack([columns, rows], axis=-1)))
    return np.asarray(np.hypot(rays[..., 0], rays[..., 1]) > lens.radius_max)


def _span(coordinates: Array, shrink: float, limit: int) -> tuple[int, int]:
    """First and one past the last pixel, inside 0 .. limit and never empty, of an interval with the coordinates.

    If the limit allows, its length can be halved without remainder on the way to `shrink` times the length.
    """
    margin_px, step = _MARGIN_PX / shrink, 2 ** int(-np.log2(shrink))
    first = int(np.clip(np.floor(coordinates.min() - margin_px), 0, limit - 1))
    last = int(np.clip(np.ceil(coordinates.max() + margin_px) + 1, first + 1, limit))
    length = -(-(last - first) // step) * step
    return (min(first, limit - length), min(first, limit - length) + length) if length <= limit else (first, last)


def _straight(lens: Lens, box_xyxy_px: Array) -> Array:
    """The box [4] on the pinhole image; unchanged where the lens cannot be inverted, as in some lenses' corners."""
    straight = lens.box_to_pinhole(box_xyxy_px)
    return straight if np.isfinite(straight).all() else box_xyxy_px


def clipped(box_xyxy_px: Array, image_size_wh: tuple[int, int]) -> Array:
    """The part of a box [4] on the frame; a box outside collapses onto the nearest edge."""
    return np.clip(box_xyxy_px, -0.5, np.tile(image_size_wh, 2) - 0.5)


def _halvable(length: int, size: int) -> int:
    """The length, or slightly less, such that it can be halved without remainder while it is twice `size` or more."""
    return length - length % 2 ** int(np.log2(max(length / size, 1.0)))


def _inside(start: int, length: int, low: int, limit: int) -> int:
    if length >= limit:
        return low - ((length - limit) // 2)
    return min(max(start, low), low + limit - length)


def _resize(image_bgr: Image, size_wh: tuple[int, int]) -> Image:
    """Area averages for downscaling, bilinear for upscaling. Halving first is a cheaper way to the same averages."""
    pixels = image_bgr
    while pixels.shape[1] >= 2 * size_wh[0] and pixels.shape[0] >= 2 * size_wh[1]:
        half_wh = (pixels.shape[1] // 2, pixels.shape[0] // 2)
        pixels = np.asarray(cv2.resize(pixels, half_wh, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    # First the sides that shrink: if one shrinks and the other grows, OpenCV does not average.
    less_wh = (min(size_wh[0], pixels.shape[1]), min(size_wh[1], pixels.shape[0]))
    averaged = cv2.resize(pixels, less_wh, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(averaged, size_wh, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
