"""Visualises a score: true and estimated pose drawn on the frames, an inset of the target, plots over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs.geometry import Array
from sim_replay.score import Match, TargetPose

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

TRUTH_BGR: Color = (255, 255, 0)
ESTIMATE_BGR: Color = (255, 0, 255)
_TEXT_BGR: Color = (240, 240, 240)
_MUTED_BGR: Color = (170, 170, 170)
_PANEL_BGR: Color = (28, 24, 20)
# Corners are numbered by bits x, y, z; an edge joins two that differ in one bit.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
_SUBPIXEL_BITS = 4
_PLACE_PX = 12  # size of a cross, per pixel of line width
_RING_PX = 28  # radius around a target of unknown range, in a picture of 1080 rows
_INSET_SCALE = 2.2  # window side over the target's longer projected side


@dataclass(frozen=True)
class Extents:
    """The target's box in its own axes (FRD), metres; drawn at the true and at the estimated pose."""

    min_m: tuple[float, float, float]
    size_m: tuple[float, float, float]

    def corners_m(self) -> Array:
        """[8, 3]; bits 0, 1, 2 of the index choose the far side along x, y, z."""
        bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
        return np.array(self.min_m) + bits * np.array(self.size_m)


@dataclass(frozen=True, eq=False)
class FrameView:
    """Everything that is drawn for one frame, except its pixels."""

    K: Array  # [3, 3], pixel centres at integers
    match: Match | None  # of the target in the inset and the charts; None: it is not in view
    extents: Extents | None  # of that target
    latency_ms: float | None
    others: tuple[tuple[Match, Extents], ...] = ()  # the frame's other targets
    directions: tuple[TargetPose, ...] = ()  # targets of unknown range: only their directions mean anything


def project(points_cam_m: ArrayLike, K: Array) -> Array | None:
    """Points [N, 3] in `cam` to pixels [N, 2]; None if any lies behind the camera."""
    points = np.asarray(points_cam_m, dtype=np.float64)
    if not (points[:, 2] > 0.1).all():
        return None
    return (points @ K.T)[:, :2] / points[:, 2:]


def window_camera(K: Array, left_top_px: ArrayLike, scale: float) -> Array:
    """K of a crop whose outer edge starts at `left_top_px` - 0.5 and that is resized by `scale`."""
    left, top = np.asarray(left_top_px, dtype=np.float64)
    shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
    resize = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    return resize @ shift @ K


def draw_pose(canvas: Image, K: Array, pose: TargetPose, extents: Extents, color: Color, thickness: int) -> None:
    """The target's box and an arrow along its nose, in place; nothing if it extends behind the camera.

    For a pose of unknown rotation, a cross marks the position.
    """
    nose_m = extents.min_m[0] + extents.size_m[0]
    points_body = np.vstack([extents.corners_m(), np.zeros(3), [nose_m + 0.6 * extents.size_m[0], 0.0, 0.0]])
    points_px = project(points_body @ pose.R_cam_target.T + pose.t_cam_target_m, K)
    if points_px is None or np.abs(points_px).max() > 1e5:
        return
    if not pose.rotation_known:
        u, v = (int(c) for c in np.round(points_px[8]))
        cv2.drawMarker(canvas, (u, v), color, cv2.MARKER_CROSS, _PLACE_PX * thickness, thickness, cv2.LINE_AA)
        return
    fixed = [tuple(int(c) for c in p) for p in np.round(points_px * 2**_SUBPIXEL_BITS)]
    for a, b in _EDGES:
        cv2.line(canvas, fixed[a], fixed[b], color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.arrowedLine(canvas, fixed[8], fixed[9], color, thickness + 1, cv2.LINE_AA, _SUBPIXEL_BITS, tipLength=0.2)


class Overlay:
    """Draws the frames of one replay. The layout scales with the frame's height; its width limits the inset."""

    def __init__(self, views: Sequence[FrameView], size_wh: tuple[int, int]) -> None:
        self._views = views
        self._width, self._height = size_wh
        self._unit = self._height / 1080.0
        self._font: Any = cv2.FontFace("sans")
        self._inset_px = max(1, min(self._px(480), self._width - 2 * self._px(32)))
        self._inset_left = self._px(32) if self._targets_mostly_right() else self._width - self._px(32) - self._inset_px
        self._series = _series(views)

    def draw(self, index: int, image_bgr: Image) -> Image:
        """The frame at `index` with all overlays; a new image [H, W, 3]."""
        canvas = image_bgr.copy()
        view = self._views[index]
        inset = self._inset(view, image_bgr)
        self._draw_targets(canvas, view, view.K, self._px(2))
        if inset is not None:
            top, left = self._px(32), self._inset_left
            canvas[top : top + self._inset_px, left : left + self._inset_px] = inset
            corner = (left + self._inset_px, top + self._inset_px)
            cv2.rectangle(canvas, (left, top), corner, _TEXT_BGR, self._px(2), cv2.LINE_AA)
        self._draw_legend(canvas, index)
        self._draw_charts(canvas, index)
        return canvas

    def _px(self, at_1080: float) -> int:
        return max(1, round(at_1080 * self._unit))

    def _targets_mostly_right(self) -> bool:
        """Whether the targets pass through the area of the inset at the right edge."""
        centers = [project(v.match.truth.t_cam_target_m[None], v.K) for v in self._views if v.match is not None]
        inside = [c for c in centers if c is not None and c[0, 0] > 0.7 * self._width and c[0, 1] < 0.55 * self._height]
        return len(inside) > 0.1 * max(len(centers), 1)

    def _draw_targets(self, canvas: Image, view: FrameView, K: Array, thickness: int) -> None:
        first = () if view.match is None or view.extents is None else ((view.match, view.extents),)
        for match, extents in (*first, *view.others):
            draw_pose(canvas, K, match.truth, extents, TRUTH_BGR, thickness + self._px(1))
            if match.estimate is not None:
                draw_pose(canvas, K, match.estimate, extents, ESTIMATE_BGR, thickness)
        for seen in view.directions:
            self._draw_direction(canvas, K, seen, thickness)

    def _draw_direction(self, canvas: Image, K: Array, seen: TargetPose, thickness: int) -> None:
        """A ring with the target's name below it; nothing if it is seen behind the camera."""
        place_px = project(seen.t_cam_target_m[None], K)
        if place_px is None or np.abs(place_px).max() > 1e5:
            return
        u, v = (int(c) for c in np.round(place_px[0]))
        radius = self._px(_RING_PX)
        cv2.circle(canvas, (u, v), radius, ESTIMATE_BGR, thickness, cv2.LINE_AA)
        label, size = f"{seen.track} range ?", self._px(26)
        _, _, width, _ = cv2.getTextSize((self._width, self._height), label, (0, 0), self._font, size, 500)
        below = (u - width // 2, v + radius + size)
        cv2.putText(canvas, label, below, ESTIMATE_BGR, self._font, size, 500)

    def _inset(self, view: FrameView, image_bgr: Image) -> Image | None:
        """The target's surroundings enlarged, with boxes drawn at the inset's own resolution."""
        if view.match is None or view.extents is None:
            return None
        truth = view.match.truth
        corners = project(view.extents.corners_m() @ truth.R_cam_target.T + truth.t_cam_target_m, view.K)
        if corners is None:
            return None
        low, high = corners.min(axis=0), corners.max(axis=0)
        side = int(np.clip(_INSET_SCALE * (high - low).max(), 48, min(self._width, self._height)))
        limits = np.array([self._width - side, self._height - side])
        left, top = (int(c) for c in np.clip(np.round((low + high - side) / 2.0), 0, limits))
        crop = image_bgr[top : top + side, left : left + side]
        inset = np.asarray(cv2.resize(crop, (self._inset_px,) * 2, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
        self._draw_targets(inset, view, window_camera(view.K, (left, top), self._inset_px / side), self._px(2))
        return inset

    def _text(self, canvas: Image, text: str, left: float, base: float, size: float, color: Color) -> None:
        origin = (self._px(left), self._px(base))
        cv2.putText(canvas, text, origin, color, self._font, self._px(size), 500)

    def _panel(self, canvas: Image, left: float, top: float, width: float, height: float) -> None:
        x, y, w, h = (self._px(value) for value in (left, top, width, height))
        region = canvas[y : y + h, x : x + w]
        region[:] = (0.3 * region + 0.7 * np.array(_PANEL_BGR)).astype(np.uint8)

    def _draw_legend(self, canvas: Image, index: int) -> None:
        left = 32.0 if self._inset_left > self._width // 2 else self._width / self._unit - 32.0 - 560.0
        self._panel(canvas, left, 32, 560, 214)
        rows = ((TRUTH_BGR, "ground truth", "truth_m"), (ESTIMATE_BGR, "estimate", "estimate_m"))
        for row, (color, label, name) in enumerate(rows):
            base = 78.0 + 44.0 * row
            dash = self._px(base - 9)
            cv2.line(canvas, (self._px(left + 20), dash), (self._px(left + 70), dash), color, self._px(4), cv2.LINE_AA)
            self._text(canvas, label, left + 88, base, 28, _TEXT_BGR)
            self._text(canvas, _number(self._series[name][index], "{:.1f} m"), left + 370, base, 28, color)
        figures = (("rotation error", "rotation_deg", "{:.1f}°"), ("capture to MAVLink", "latency_ms", "{:.1f} ms"))
        for row, (label, name, form) in enumerate(figures):
            base = 166.0 + 44.0 * row
            self._text(canvas, label, left + 20, base, 28, _MUTED_BGR)
            self._text(canvas, _number(self._series[name][index], form), left + 370, base, 28, _TEXT_BGR)

    def _draw_charts(self, canvas: Image, index: int) -> None:
        height, gap, top = 150.0, 32.0, 1080.0 - 150.0 - 32.0
        width = (self._width / self._unit - 4 * gap) / 3.0
        truth, estimate = ("truth_m", TRUTH_BGR), ("estimate_m", ESTIMATE_BGR)
        charts = (
            ("range", "m", (truth, estimate)),
            ("range error", "%", (("range_error_pct", ESTIMATE_BGR),)),
            ("rotation error", "°", (("rotation_deg", ESTIMATE_BGR),)),
        )
        for column, (title, unit, curves) in enumerate(charts):
            left = gap + column * (width + gap)
            self._panel(canvas, left, top, width, height)
            series = [(self._series[name], color) for name, color in curves]
            values = np.concatenate([line[np.isfinite(line)] for line, _ in series] or [np.zeros(1)])
            low = float(values.min()) if title == "range" and values.size else 0.0
            high = float(values.max()) if values.size else 1.0
            high = max(high, low + 1e-3)
            self._text(canvas, f"{title}, {unit}", left + 12, top + 28, 20, _MUTED_BGR)
            self._text(
                canvas, f"{high:.0f}" if high >= 10 else f"{high:.1f}", left + width - 64, top + 28, 20, _MUTED_BGR
            )
            self._text(canvas, f"{low:.0f}", left + width - 64, top + height - 10, 20, _MUTED_BGR)
            area = (left + 12, top + 38, width - 90, height - 54)
            for line, color in series:
                self._curve(canvas, line[: index + 1], (low, high), area, color)

    def _curve(
        self,
        canvas: Image,
        line: Array,
        limits: tuple[float, float],
        area: tuple[float, float, float, float],
        color: Color,
    ) -> None:
        """One line up to the current frame, interrupted where there is no value; `area` is left, top, width, height."""
        left, top, width, height = area
        x = left + width * np.arange(len(line)) / max(len(self._views) - 1, 1)
        y = top + height * (1.0 - (line - limits[0]) / (limits[1] - limits[0]))
        points = np.round(np.stack([x, y], axis=1) * self._unit * 2**_SUBPIXEL_BITS)
        known = np.isfinite(line)
        for run in np.split(np.arange(len(line)), np.flatnonzero(np.diff(known.astype(int))) + 1):
            if run.size and known[run[0]]:
                path = points[run].astype(np.int32).reshape(-1, 1, 2)
                cv2.polylines(canvas, [path], False, color, self._px(2), cv2.LINE_AA, _SUBPIXEL_BITS)


def _series(views: Sequence[FrameView]) -> dict[str, Array]:
    """Data of the charts and the legend, each [frames], NaN where there is no value."""
    names = ("truth_m", "estimate_m", "range_error_pct", "rotation_deg", "latency_ms")
    series = {name: np.full(len(views), np.nan) for name in names}
    for i, view in enumerate(views):
        if view.latency_ms is not None:
            series["latency_ms"][i] = view.latency_ms
        if view.match is None:
            continue
        true_m = float(np.linalg.norm(view.match.truth.t_cam_target_m))
        series["truth_m"][i] = true_m
        if view.match.estimate is not None:
            range_m = float(np.linalg.norm(view.match.estimate.t_cam_target_m))
            series["estimate_m"][i] = range_m
            series["range_error_pct"][i] = 100.0 * abs(range_m - true_m) / true_m
            series["rotation_deg"][i] = view.match.rotation_error_deg
    return series


def _number(value: float, form: str) -> str:
    return form.format(value) if np.isfinite(value) else "–"


def showcase_index(views: Sequence[FrameView]) -> int:
    """The frame of median rotation error among those with an estimate: typical, not the best. Else the middle frame."""
    scored = [
        (view.match.rotation_error_deg, i)
        for i, view in enumerate(views)
        if view.match is not None and view.match.rotation_error_deg is not None
    ]
    return sorted(scored)[len(scored) // 2][1] if scored else len(views) // 2
