"""The plots of a flight report, as SVG. Pure: numbers in, text out."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from msgs.geometry import Array
from sim_replay.ground_truth import SceneTruth
from sim_replay.lettering import FAMILY, lettering
from sim_replay.report.continuity import follows
from sim_replay.report.peer import coordinate_errors, coordinates, pairs, root_mean_square
from sim_replay.score import Match

TRUTH_COLOR, ESTIMATE_COLOR, AUTOPILOT_COLOR, OWN_COLOR = "#0091a1", "#d1009b", "#e08a00", "#64748b"
STATE_COLORS = {
    "init": "#cbd5e1",
    "searching": "#7dd3fc",
    "tracking": "#4ade80",
    "coasting": "#fde047",
    "degraded": "#fb923c",
    "fault": "#ef4444",
}
_STYLE: Any = {
    "font.family": FAMILY,
    "font.size": 9.5,
    "axes.edgecolor": "#94a3b8",
    "axes.labelcolor": "#334155",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlecolor": "#0f172a",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e2e8f0",
    "grid.linewidth": 0.8,
    "xtick.color": "#475569",
    "ytick.color": "#475569",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "svg.fonttype": "path",
}
MARKED_MAX = 1500  # with more poses, a separate SVG element for each is too slow in browsers
_SIGMAS = 2.0
_JUMP_DEG = 180.0
_BEARING_SPAN_DEG = 0.05  # minimum: smaller deviations are noise


@dataclass(frozen=True)
class HealthSample:
    """The daemon's diagnostics at one time, seconds since frame 0."""

    t_s: float
    state: str  # edge.health.HealthState's value
    headline: str  # state, and the daemon's activity in it
    reasons: str
    frame_rate_hz: float | None
    dropped: int | None


def pose_over_time(matches: Sequence[Match], frames: int, fps: float, unrecorded: Collection[int] = ()) -> str:
    """X, Y, Z in `cam` and roll, pitch, yaw against the camera's axes, with RMSE and the covariance's ±2 sigma.

    Curves run on over frames without an image (`unrecorded`).
    """
    recorded = np.setdiff1d(np.arange(frames), list(unrecorded))
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.6, 5.6), layout="constrained")
        panels = figure.subplots(2, 3, sharex=True).ravel()
        for target in _by_target(matches):
            _pose_of_target(panels, target, recorded, fps)
        errors = coordinate_errors(pairs(matches))
        names = ("X, right", "Y, down", "Z, forward", "roll", "pitch", "yaw")
        for k, (axes, name) in enumerate(zip(panels, names, strict=True)):
            unit = " m" if k < 3 else "°"
            rms = root_mean_square(errors[:, k])
            told = "no values" if rms is None else f"RMSE {rms:.2f}{unit}"
            axes.set_title(f"{name}  ·  {told}")
            axes.set_ylabel(unit)
            axes.set_xlim(0.0, frames / fps)
        for axes in panels[3:]:
            _at_least(axes, 10.0)  # when all are drawn: a fixed axis would cut off who comes later
            axes.set_xlabel("time, s")
        handles = [Patch(color=TRUTH_COLOR, label="ground truth"), Patch(color=ESTIMATE_COLOR, label="received")]
        handles.append(Patch(color=ESTIMATE_COLOR, alpha=0.18, label="±2σ of the received covariance"))
        figure.legend(handles=handles, loc="outside upper right", ncols=3)
        return _svg(figure, "pose")


def _pose_of_target(panels: Sequence[Axes], target: Sequence[Match], recorded: NDArray[np.int64], fps: float) -> None:
    t_s = recorded / fps
    true, estimated, sigma = (np.full((len(recorded), 6), np.nan) for _ in range(3))
    rows = np.searchsorted(recorded, [m.truth.frame for m in target])
    true[rows] = coordinates([m.truth for m in target])
    for row, match in zip(rows, target, strict=True):
        if match.estimate is not None:
            estimated[row] = coordinates([match.estimate])[0]
            if match.estimate.covariance is not None:
                sigma[row, :3] = np.sqrt(np.diagonal(match.estimate.covariance)[:3])
    for k, axes in enumerate(panels):
        wrapped = k >= 3
        axes.plot(*_unjoined(t_s, true[:, k], wrapped), color=TRUTH_COLOR, lw=2.4, alpha=0.85)
        marker = "." if len(recorded) <= MARKED_MAX else ""
        axes.plot(*_unjoined(t_s, estimated[:, k], wrapped), color=ESTIMATE_COLOR, marker=marker, ms=2.5, lw=1.1)
        if np.isfinite(sigma[:, k]).any():
            low, high = estimated[:, k] - _SIGMAS * sigma[:, k], estimated[:, k] + _SIGMAS * sigma[:, k]
            axes.fill_between(t_s, low, high, color=ESTIMATE_COLOR, alpha=0.18, lw=0)


def trajectory(matches: Sequence[Match], scene: SceneTruth) -> str:
    """Target and own ship in 3-D and from above, in `ned` if the scene has the camera's position, else in `cam`."""
    in_ned = all(camera is not None for camera in scene.cameras_world)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.6, 4.7), layout="constrained")
        solid = figure.add_subplot(1, 2, 1, projection="3d")
        above = figure.add_subplot(1, 2, 2)
        own = np.array([camera[1] if camera else np.zeros(3) for camera in scene.cameras_world])
        curves = [(_east_north_up(own, in_ned), OWN_COLOR, "own ship", "")] if in_ned else []
        for k, target in enumerate(_by_target(matches)):
            true, seen = _places(target, scene, in_ned)
            curves.append((_east_north_up(true, in_ned), TRUTH_COLOR, "target, ground truth" if k == 0 else "", ""))
            curves.append((_east_north_up(seen, in_ned), ESTIMATE_COLOR, "target, received" if k == 0 else "", "."))
        for points, color, label, marker in curves:
            style: dict[str, Any] = {
                "color": color,
                "label": label,
                "marker": marker if len(points) <= MARKED_MAX else "",
                "ms": 2.5,
                "lw": 1.2 if marker else 2.4,
            }
            solid.plot(*points.T, **style)
            above.plot(points[:, 0], points[:, 1], **style)
            above.plot(*points[np.isfinite(points[:, 0])][:1, :2].T, "o", color=color, ms=6, mfc="white")
        across, along, up = ("east", "north", "up") if in_ned else ("right", "forward", "up")
        solid.set(xlabel=f"{across}, m", ylabel=f"{along}, m", zlabel=f"{up}, m")
        solid.set_box_aspect((1.0, 1.0, 0.55), zoom=0.95)
        for axis in (solid.xaxis, solid.yaxis, solid.zaxis):
            axis.set_major_locator(MaxNLocator(5))
        solid.view_init(elev=24, azim=-62)
        above.set(xlabel=f"{across}, m", ylabel=f"{along}, m")
        above.set_title("top view  ·  ○ start")
        above.set_aspect("equal", adjustable="datalim")
        if curves:
            above.legend(loc="best")
        return _svg(figure, "trajectory")


def _places(target: Sequence[Match], scene: SceneTruth, in_ned: bool) -> tuple[Array, Array]:
    """[N, 3] true and received positions of each recorded frame, NaN out of view and where no pose was received."""
    recorded = np.setdiff1d(np.arange(len(scene.images)), list(scene.unrecorded))
    true, seen = (np.full((len(recorded), 3), np.nan) for _ in range(2))
    for k, match in zip(np.searchsorted(recorded, [m.truth.frame for m in target]), target, strict=True):
        camera = scene.cameras_world[match.truth.frame]
        R, t_m = camera if in_ned and camera is not None else (np.eye(3), np.zeros(3))
        true[k] = R @ match.truth.t_cam_target_m + t_m
        if match.estimate is not None:
            seen[k] = R @ match.estimate.t_cam_target_m + t_m
    return true, seen


def _east_north_up(points: Array, in_ned: bool) -> Array:
    """[N, 3] of `ned` as east, north, up; of `cam` as right, forward, up."""
    return points[:, [1, 0, 2]] * [1, 1, -1] if in_ned else points[:, [0, 2, 1]] * [1, 1, -1]


def ages(peers: Mapping[str, Sequence[tuple[int, float]]], fps: float) -> str:
    """From exposure to arrival at each peer: over the flight, and its distribution."""
    colors = dict(zip(peers, (ESTIMATE_COLOR, AUTOPILOT_COLOR), strict=False))
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.6, 3.1), layout="constrained")
        over_time, spread = figure.subplots(1, 2, width_ratios=(3, 2))
        for name, received in peers.items():
            if not received:
                continue
            frames, age_ms = np.array(received).T
            p50, p99 = np.percentile(age_ms, [50, 99])
            label = f"{name}: p50 {p50:.1f} ms, p99 {p99:.1f} ms"
            many = len(age_ms) > MARKED_MAX
            over_time.plot(frames / fps, age_ms, ".", ms=4, color=colors[name], label=label, rasterized=many)
            share = 100.0 * np.arange(1, len(age_ms) + 1) / len(age_ms)
            spread.step(np.sort(age_ms), share, where="post", color=colors[name])
        over_time.set(xlabel="time, s", ylabel="age on receipt, ms", ylim=(0, None))
        over_time.set_title("exposure to receipt")
        if over_time.has_data():
            over_time.legend(loc="best")
        spread.set(xlabel="age on receipt, ms", ylabel="share of poses, %", xlim=(0, None), ylim=(0, 102))
        spread.set_title("cumulative distribution")
        return _svg(figure, "ages")


def timeline(
    health: Sequence[HealthSample], matches: Sequence[Match], frames: int, fps: float, unrecorded: Collection[int] = ()
) -> str:
    """The daemon's state each second, when each target was in view, and when poses of it arrived.

    A bar runs on over frames without an image (`unrecorded`).
    """
    targets = _by_target(matches)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.6, 1.5 + 0.42 * (1 + 2 * len(targets))), layout="constrained")
        axes = figure.subplots()
        end_s = frames / fps
        for k, sample in enumerate(health):
            stop_s = health[k + 1].t_s if k + 1 < len(health) else max(end_s, sample.t_s)
            color = STATE_COLORS.get(sample.state, "#e2e8f0")
            axes.broken_barh([(sample.t_s, stop_s - sample.t_s)], (-0.38, 0.76), color=color, lw=0)
        labels = ["health"]
        for target in targets:
            name = target[0].truth.airframe_label
            seen = [match.truth.frame for match in target]
            axes.broken_barh(
                _runs(seen, fps, unrecorded), (len(labels) - 0.3, 0.6), color=TRUTH_COLOR, alpha=0.45, lw=0
            )
            labels.append(f"{name}: in view")
            tracks: dict[str, list[int]] = {}
            for match in target:
                if match.estimate is not None:
                    tracks.setdefault(match.estimate.track, []).append(match.truth.frame)
            for k, (track, came) in enumerate(tracks.items()):
                color = ESTIMATE_COLOR if k % 2 == 0 else "#7c3aed"
                axes.broken_barh(_runs(came, fps, unrecorded), (len(labels) - 0.3, 0.6), color=color, alpha=0.75, lw=0)
                axes.text(came[0] / fps, len(labels), f" {track}", va="center", color="white", fontsize=8)
            labels.append("poses received")
        shown, style = lettering(labels)
        axes.set_yticks(range(len(labels)), shown, **style)
        axes.set_ylim(len(labels) - 0.4, -0.6)
        axes.set(xlabel="time since the first frame, s")
        axes.axvline(0.0, color="#475569", lw=0.8, ls=":")
        axes.set_xlim(min([0.0, *(sample.t_s for sample in health)]), max([end_s, *(s.t_s for s in health)]))
        axes.grid(axis="y", visible=False)
        states = {sample.state for sample in health}
        handles = [Patch(color=color, label=state) for state, color in STATE_COLORS.items() if state in states]
        if handles:
            figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))
        return _svg(figure, "timeline")


def errors_over_range(matches: Sequence[Match]) -> str:
    """Rotation, range and bearing error of every pose, over the true range."""
    found = pairs(matches)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(11.6, 2.9), layout="constrained")
        rotation, distance, bearing = figure.subplots(1, 3)
        seen = [match for match in matches if match.estimate is not None]
        range_m = np.array([np.linalg.norm(truth.t_cam_target_m) for truth, _ in found])
        received_m = np.array([np.linalg.norm(estimate.t_cam_target_m) for _, estimate in found])
        share = 100.0 * (received_m - range_m) / range_m if found else range_m
        panels = (
            (rotation, "rotation error, °", np.array([m.rotation_error_deg for m in seen], dtype=np.float64)),
            (distance, "range error, % of range", share),
            (bearing, "bearing error, °", [match.bearing_error_deg for match in seen]),
        )
        for axes, label, values in panels:
            many = len(found) > MARKED_MAX
            axes.plot(range_m, values, ".", ms=4, color=ESTIMATE_COLOR, alpha=0.6, rasterized=many)
            axes.set_title(label)
            axes.set_xlabel("true range, m")
        distance.axhspan(-5.0, 5.0, color=TRUTH_COLOR, alpha=0.12, lw=0)
        rotation.axhspan(0.0, 10.0, color=TRUTH_COLOR, alpha=0.12, lw=0)
        rotation.set_ylim(0, None)
        bearing.set_ylim(0, max([_BEARING_SPAN_DEG, *bearing.get_ylim()]))
        return _svg(figure, "range")


def _by_target(matches: Sequence[Match]) -> list[list[Match]]:
    groups: dict[tuple[int, int], list[Match]] = {}
    for match in matches:
        groups.setdefault(match.truth.target, []).append(match)
    return list(groups.values())


def _runs(frames: Sequence[int], fps: float, unrecorded: Collection[int]) -> list[tuple[float, float]]:
    """(start, length) in seconds of each run of frames with no other image in between."""
    ordered = np.unique(frames)
    ends = [not follows(int(before), int(after), unrecorded) for before, after in pairwise(ordered)]
    parts = np.split(ordered, np.flatnonzero(ends) + 1)
    return [(float(part[0]) / fps, float(part[-1] + 1 - part[0]) / fps) for part in parts if len(part)]


def _unjoined(t_s: Array, values: Array, wrapped: bool) -> tuple[Array, Array]:
    """Times and angles with a NaN between two on both sides of ±180°, so that no line connects them."""
    jumps = np.flatnonzero(wrapped & (np.abs(np.diff(values)) > _JUMP_DEG)) + 1
    return np.insert(t_s, jumps, t_s[jumps]), np.insert(values, jumps, np.nan)


def _at_least(axes: Axes, span: float) -> None:
    """A vertical axis of at least this span, so that noise does not look like motion."""
    low, high = axes.get_ylim()
    if high - low < span:
        axes.set_ylim(0.5 * (low + high - span), 0.5 * (low + high + span))


def _svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element; its ids are unique in a page with several."""
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name}):
        figure.savefig(text, format="svg", dpi=150, transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", svg[svg.index("<svg") :])
    head, rest = svg.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)  # as wide as the page allows
    return f'{head} data-plot="{name}">{rest}'
