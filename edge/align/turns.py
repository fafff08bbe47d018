"""How the camera turned between two pictures of a far scene. Pure but for what `TurnTracker` remembers."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.estimator.lens import lens_of
from edge.types import Array, Frame
from msgs.geometry import nearest_rotation, so3_exp, so3_log

WIDTH_MAX_PX = 800  # pictures are shrunk to it: finer ones give no better turn, and cost time
POINTS = 200
# Least contrast of a point, in squares, of that of the strongest one: a glint of the sun must not hide a hazy horizon.
CONTRAST_SHARE = 0.002
APART_SHARE = 1 / 50  # least distance of two points, in widths of the picture
# Longer: the attitude's errors at both ends weigh less. Shorter: it shows better when the turn began and ended.
SPAN_NS = 200_000_000
SPAN_MIN_NS = 80_000_000
GAP_MAX_NS = 500_000_000  # between pictures: over a longer one, points are not followed
KEPT_MIN_SHARE = 0.6  # of the points with which a turn began: with fewer it ends early
THERE_AND_BACK_MAX_PX = 0.5
AGREEING_MIN, AGREEING_MIN_SHARE = 25, 0.5  # of the points that were followed
OFF_MAX_PX = 2.5  # of a point: a lens or rows that are not quite as configured move points by as much
TRIES = 80
WINDOW_PX, LEVELS = (21, 21), 4  # of the search for a point: finds it up to some 100 px away


@dataclass(frozen=True, eq=False)
class Sight:
    """Far points seen in two pictures; in pinhole coordinates, which are x / z and y / z in `cam`."""

    start_ns: int
    end_ns: int
    start_xy: Array  # [N, 2]
    end_xy: Array  # [N, 2]
    start_row_s: Array  # [N], exposure of the points' rows minus that of the frame: a rolling shutter
    end_row_s: Array  # [N]
    off_max_rad: float  # how far off a point may be, with the configured focal length

    def turn_cam_rad(self, focal_ratio: float = 1.0, rates_cam_radps: Array | None = None) -> Array | None:
        """Rotation vector [3] of R_cam0_cam1, in cam at the start; None unless most points agree on one.

        Args:
            focal_ratio: Of the focal length to assume to the configured one.
            rates_cam_radps: [2, 3], how fast the camera turned at start and end, to take rows to the frame's time.
        """
        start, end = _rays(self.start_xy / focal_ratio), _rays(self.end_xy / focal_ratio)
        if rates_cam_radps is not None:
            start = _moved(start, self.start_row_s[:, None] * rates_cam_radps[0])
            end = _moved(end, self.end_row_s[:, None] * rates_cam_radps[1])
        return _turn(start, end, self.off_max_rad / focal_ratio)


class TurnTracker:
    """Follows points from picture to picture and gives a Sight every SPAN_NS, or when too few points are left."""

    def __init__(self, readout_s: float = 0.0) -> None:
        """`readout_s`: from the first row's exposure to the last one's, as [camera] readout_ms."""
        self._readout_s = readout_s
        self.attempts = 0  # to follow points over a span: those that gave a Sight, and those that did not
        self._grey: NDArray[np.uint8] | None = None
        self._start_ns = self._last_ns = 0
        self._start_px = self._now_px = np.empty((0, 2), np.float32)
        self._begun = 0  # number of points with which the span began

    def take(self, frame: Frame) -> Sight | None:
        """The span that this picture ends, if any and if its points could be followed."""
        shrink = min(1.0, WIDTH_MAX_PX / frame.size_wh[0])
        grey = np.asarray(cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        if shrink < 1.0:
            grey = np.asarray(cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), np.uint8)
        now_ns, before = frame.meta.capture_ns, self._grey
        follows = before is not None and before.shape == grey.shape and 0 < now_ns - self._last_ns <= GAP_MAX_NS
        sight = None
        if before is not None and follows:
            if self._begun:
                self._follow(before, grey)
            span_ns, left = now_ns - self._start_ns, len(self._now_px)
            few = left < max(AGREEING_MIN, KEPT_MIN_SHARE * self._begun)
            if span_ns < SPAN_NS and not few:
                self._grey, self._last_ns = grey, now_ns
                return None
            self.attempts += 1
            if left >= AGREEING_MIN and span_ns >= SPAN_MIN_NS:
                sight = self._sight(frame, now_ns, shrink)
        self._begin(frame, grey, now_ns)
        return sight

    def _begin(self, frame: Frame, grey: NDArray[np.uint8], now_ns: int) -> None:
        mask = None
        if frame.own_parts is not None:  # the own aircraft does not stay where it is while the camera turns
            covered = cv2.resize(frame.own_parts.covered, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
            mask = np.where(np.asarray(covered) > 0, np.uint8(0), np.uint8(255))
        apart_px = APART_SHARE * grey.shape[1]
        found = cv2.goodFeaturesToTrack(grey, POINTS, CONTRAST_SHARE, apart_px, mask=mask)
        points = np.empty((0, 2)) if found is None else np.asarray(found).reshape(-1, 2)
        self._start_px = self._now_px = points.astype(np.float32)
        self._begun = len(points)
        self._grey, self._start_ns, self._last_ns = grey, now_ns, now_ns

    def _follow(self, before: NDArray[np.uint8], grey: NDArray[np.uint8]) -> None:
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            before, grey, self._now_px, np.empty(0), winSize=WINDOW_PX, maxLevel=LEVELS
        )
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(
            grey, before, there, np.empty(0), winSize=WINDOW_PX, maxLevel=LEVELS
        )
        returned = np.abs(back - self._now_px).max(axis=-1) < THERE_AND_BACK_MAX_PX
        h, w = grey.shape
        inside = ((there >= 0) & (there <= (w - 1, h - 1))).all(axis=-1)
        kept = (found.ravel() == 1) & (found_back.ravel() == 1) & returned & inside
        self._start_px, self._now_px = self._start_px[kept], there[kept]

    def _sight(self, frame: Frame, now_ns: int, shrink: float) -> Sight:
        lens, inverse = lens_of(frame.K, frame.distortion), np.linalg.inv(frame.K)
        usable = np.ones(len(self._now_px), bool)
        both, rows_s = list[Array](), list[Array]()
        for small_px in (self._start_px, self._now_px):
            px = (small_px.astype(np.float64) + 0.5) / shrink - 0.5
            rows_s.append(self._readout_s * ((px[:, 1] + 0.5) / frame.size_wh[1] - 0.5))
            if lens is not None:
                usable &= lens.shows(px)
                px = lens.to_pinhole(px)
            both.append(px @ inverse[:2, :2].T + inverse[:2, 2])
        off_max_rad = OFF_MAX_PX / (shrink * frame.K[0, 0])
        (start_xy, end_xy), (start_row_s, end_row_s) = ([one[usable] for one in of] for of in (both, rows_s))
        return Sight(self._start_ns, now_ns, start_xy, end_xy, start_row_s, end_row_s, off_max_rad)


def _rays(xy: Array) -> Array:
    """[N, 2] pinhole coordinates to unit vectors [N, 3]."""
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _moved(rays: Array, turns_rad: Array) -> Array:
    """Vectors [N, 3], each turned by its rotation vector [N, 3]."""
    return np.asarray(np.einsum("nij,nj->ni", so3_exp(turns_rad), rays))


def _turn(start: Array, end: Array, off_max_rad: float) -> Array | None:
    """Rotation vector [3] that turns the end's rays [N, 3] into the start's; None unless most of them agree on one."""
    if len(start) < AGREEING_MIN:
        return None
    agreeing = _agreeing(start, end, off_max_rad)
    if agreeing.sum() < max(AGREEING_MIN, AGREEING_MIN_SHARE * len(start)):
        return None
    for _ in range(3):
        R = nearest_rotation(start[agreeing].T @ end[agreeing])
        agreeing = np.linalg.norm(end @ R.T - start, axis=-1) < off_max_rad
        if agreeing.sum() < AGREEING_MIN:
            return None
    return so3_log(R)


def _agreeing(a: Array, b: Array, off_max_rad: float) -> NDArray[np.bool_]:
    """Which of the rays [N, 3] fit the rotation that most of them fit, among those that pairs of them give (RANSAC)."""
    chosen = np.random.default_rng(0).integers(0, len(a), (TRIES, 2))
    R = _axes(a[chosen]) @ _axes(b[chosen]).swapaxes(-1, -2)  # [tries, 3, 3]
    off_rad = np.linalg.norm(np.einsum("tij,nj->tni", R, b) - a, axis=-1)
    fits = off_rad < off_max_rad  # false for NaN, of a pair that is twice the same point
    return np.asarray(fits[np.argmax(fits.sum(axis=-1))])


def _axes(two: Array) -> Array:
    """Pairs of unit vectors [..., 2, 3] to right-handed axes [..., 3, 3], their columns, that turn with the pair."""
    middle, across = two[..., 0, :] + two[..., 1, :], np.cross(two[..., 0, :], two[..., 1, :])
    with np.errstate(invalid="ignore"):
        first = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        second = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)
