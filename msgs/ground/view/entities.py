"""Rerun entities of one vehicle: each function logs one thing at the time that was set on the recording.

Entities of `<uav>`: `ned` (3-D, north, east, down), with `ned/camera` the image; `map` (from above), `zoom` (targets
as seen, enlarged), `plots`, `health`, `events`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import rerun as rr

from msgs.cdr import CameraInfo, CompressedImage, DiagnosticArray, DiagnosticStatus
from msgs.geometry import R_from_q_wxyz, euler_from_R
from msgs.ground.fleet import DirectionRow, TargetRow
from msgs.ground.view.drawing import SIGMAS, box_edges_m, ellipse, ellipsoid, pixel_covariance, posed, project
from msgs.receive import TargetPose
from msgs.wire import Array

OWN_RGB = (90, 200, 250)
TARGET_RGB = ((255, 90, 180), (255, 190, 60), (140, 230, 90), (190, 140, 255))
DOUBT_RGB = (150, 150, 160)
NAMES_RGB = (245, 245, 250)  # the viewer's labels have a grey background
GRID_RGB = (70, 74, 82)
AXES_RGB = ((240, 70, 70), (80, 220, 80), (90, 140, 255))  # nose, right, down
RINGS_M = (100, 200, 300, 400, 500)
SHIP_SIZE_M = (3.0, 3.0, 0.8)
FRUSTUM_M = 40.0
LABEL_BELOW_PX = 25.0
RING_NAMES_TOWARDS = np.array([-0.707, 0.707])  # north, east; away from the targets' labels, which are mostly ahead
VALUE_CHARS_MAX = 24  # enough to recognise a hash
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "CRITICAL"}
_ANGLES = ("roll", "pitch", "heading")
_HEALTH_LEVELS = {0: "INFO", 1: "WARN", 2: "ERROR"}
_MEDIA_TYPES = {"jpeg": "image/jpeg", "png": "image/png"}
_LATENCIES = {
    "total_p50": ("exposure to links p50", (110, 160, 220)),
    "total_p99": ("exposure to links p99", (220, 120, 90)),
}


def rgb(target: str) -> tuple[int, int, int]:
    """Colour of target `t0`, `t1`, …"""
    return TARGET_RGB[int(target[1:]) % len(TARGET_RGB)]


def target_paths(uav: str, target: str) -> tuple[str, ...]:
    """Entities of one target's current pose, without its trails and plots."""
    return tuple(f"{uav}/{where}/target/{target}" for where in ("ned", "ned/camera", "map", "zoom"))


def clear_target(rec: rr.RecordingStream, uav: str, target: str) -> None:
    """Remove all of one target but its trails, and interrupt the lines of its plots."""
    ranges = ("range", "range/minus_2_sigma", "range/plus_2_sigma", "closing")
    plots = (*ranges, "score", "age", *(f"attitude/{what}" for what in _ANGLES))
    _clear(rec, *target_paths(uav, target), *(plot_path(uav, target, path) for path in plots))


def prepare(rec: rr.RecordingStream, uav: str) -> None:
    """Log the static entities."""
    for where in ("ned", "ned/place"):
        rec.log(f"{uav}/{where}", rr.ViewCoordinates.FRD, static=True)
    ship = f"{uav}/ned/place/ship"
    rec.log(f"{ship}/body", rr.Boxes3D(sizes=[SHIP_SIZE_M], colors=[OWN_RGB]), static=True)
    rec.log(f"{ship}/nose", rr.Arrows3D(vectors=[[8.0, 0.0, 0.0]], colors=[OWN_RGB], radii=[0.3]), static=True)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    rings = rr.LineStrips2D([radius_m * circle for radius_m in RINGS_M], colors=[GRID_RGB])
    rec.log(f"{uav}/map/rings", rings, static=True)
    names = rr.Points2D(
        [radius_m * _on_map(RING_NAMES_TOWARDS) for radius_m in RINGS_M],
        labels=[f"{radius_m} m" for radius_m in RINGS_M], colors=[NAMES_RGB], radii=[1.0],
    )  # fmt: skip
    rec.log(f"{uav}/map/rings/names", names, static=True)
    for name, (label, color) in _LATENCIES.items():
        rec.log(f"{uav}/plots/latency/{name}", rr.SeriesLines(names=[label], colors=[color]), static=True)


def prepare_target(rec: rr.RecordingStream, uav: str, target: str) -> None:
    """Name and colour the lines of one target's plots."""
    color = rgb(target)
    lines = {
        "range": (target, color),
        "range/minus_2_sigma": (f"{target} −2σ", DOUBT_RGB),
        "range/plus_2_sigma": (f"{target} +2σ", DOUBT_RGB),
        **{f"attitude/{what}": (f"{target} {what}", AXES_RGB[axis]) for axis, what in enumerate(_ANGLES)},
        "closing": (target, color),
        "score": (target, color),
        "age": (f"{target} age on arrival", color),
    }
    for path, (name, line_rgb) in lines.items():
        rec.log(plot_path(uav, target, path), rr.SeriesLines(names=[name], colors=[line_rgb]), static=True)


def plot_path(uav: str, target: str, path: str) -> str:
    """Entity path of one line: `range`, `range/plus_2_sigma`, `attitude/roll`, …"""
    plot, _, line = path.partition("/")
    within = {"age": "latency"}.get(plot, plot)
    return f"{uav}/plots/{within}/{target}" + (f"/{line}" if line else "")


def log_camera(rec: rr.RecordingStream, uav: str, info: CameraInfo) -> None:
    """The camera and the border of its image."""
    width, height = info.width_px, info.height_px
    pinhole = rr.Pinhole(
        image_from_camera=info.K, resolution=[width, height], camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_M,
    )  # fmt: skip
    rec.log(f"{uav}/ned/camera", pinhole)
    frame = [[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1], [0, 0]]
    rec.log(f"{uav}/ned/camera/frame", rr.LineStrips2D([frame], colors=[DOUBT_RGB]))


def log_image(rec: rr.RecordingStream, uav: str, image: CompressedImage) -> None:
    rec.log(f"{uav}/ned/camera/image", rr.EncodedImage(contents=image.data, media_type=_MEDIA_TYPES.get(image.format)))


def log_ship(
    rec: rr.RecordingStream, uav: str, R_ned_body: Array, t_ned_m: Array, R_ned_cam: Array, t_ned_cam_m: Array
) -> None:
    """The own ship and its camera; on the map the ship is at the centre."""
    rec.log(f"{uav}/ned/place", rr.Transform3D(translation=t_ned_m))
    rec.log(f"{uav}/ned/place/ship", rr.Transform3D(mat3x3=R_ned_body))
    rec.log(f"{uav}/ned/camera", rr.Transform3D(translation=t_ned_cam_m, mat3x3=R_ned_cam))
    rec.log(f"{uav}/ned/trail/ship", rr.Points3D([t_ned_m], colors=[OWN_RGB], radii=[0.6]))
    ahead = rr.Arrows2D(vectors=[30.0 * _on_map(R_ned_body[:, 0])], colors=[OWN_RGB], radii=[2.0])
    rec.log(f"{uav}/map/ship", ahead)


def log_seen(
    rec: rr.RecordingStream, row: TargetRow, pose: TargetPose, camera: CameraInfo | None, size_m: Sequence[float]
) -> None:
    """The target in the image: its box, the box one sigma nearer and farther, and the error ellipse of its centre."""
    R = _R_cam_target(pose)
    _log_zoom(rec, row, R, size_m)
    if camera is None:
        return
    t_m, covariance = pose.pose.t_cam_target_m, pose.pose.covariance
    center = project(t_m, *_lens(camera))
    where = f"{row.uav}/ned/camera/target/{row.target}"
    if center is None:
        _clear(rec, where)
        return
    doubt = ellipse(center, pixel_covariance(t_m, covariance[:3, :3], camera.K))
    lowest_px = doubt[:, 1].max()
    if R is None:
        _clear(rec, f"{where}/box", f"{where}/range_sigma")
    else:
        box = _log_boxes(rec, row, R, t_m, camera, size_m)
        if box is None:
            _clear(rec, where)
            return
        lowest_px = max(lowest_px, box[..., 1].max())
    rec.log(f"{where}/sigma", rr.LineStrips2D([doubt], colors=[rgb(row.target)]))
    label = f"{row.target}  {row.range_m:.0f} ± {row.sigma_range_m:.0f} m"
    below = [center[0], lowest_px + LABEL_BELOW_PX]
    rec.log(f"{where}/label", rr.Points2D([below], colors=[rgb(row.target)], labels=[label], radii=[0.0]))


def _lens(camera: CameraInfo) -> tuple[Array, Array, str]:
    return camera.K, camera.distortion, camera.distortion_model


def _log_boxes(
    rec: rr.RecordingStream, row: TargetRow, R_cam_target: Array, t_m: Array, camera: CameraInfo,
    size_m: Sequence[float],
) -> Array | None:  # fmt: skip
    """Log the boxes; returns the pixels of the box, None if it is not completely in front of the camera."""
    where = f"{row.uav}/ned/camera/target/{row.target}"
    edges = box_edges_m(size_m)
    box = project(posed(edges, R_cam_target, t_m), *_lens(camera))
    if box is None:
        return None
    rec.log(f"{where}/box", rr.LineStrips2D(list(box), colors=[rgb(row.target)], radii=[-1.5]))
    share = row.sigma_range_m / max(row.range_m, 1e-9)
    doubtful = [
        project(posed(edges, R_cam_target, t_m * max(1.0 + side * share, 0.1)), *_lens(camera)) for side in (-1, 1)
    ]
    strips = [strip for one in doubtful if one is not None for strip in one]
    if strips:
        rec.log(f"{where}/range_sigma", rr.LineStrips2D(strips, colors=[DOUBT_RGB], radii=[-0.7]))
    return box


def _log_zoom(rec: rr.RecordingStream, row: TargetRow, R_cam_target: Array | None, size_m: Sequence[float]) -> None:
    """The box as seen by the camera, without perspective, scaled to unit length; targets side by side."""
    aside = np.array([2.0 * int(row.target[1:]), 0.0])
    where = f"{row.uav}/zoom/target/{row.target}"
    if R_cam_target is None:
        _clear(rec, f"{where}/box", f"{where}/axes")
    else:
        unit = box_edges_m(np.asarray(size_m) / max(size_m))
        strips = (unit @ R_cam_target.T)[..., :2] + aside
        rec.log(f"{where}/box", rr.LineStrips2D(list(strips), colors=[rgb(row.target)]))
        axes = (0.8 * R_cam_target.T)[:, :2]
        rec.log(f"{where}/axes", rr.Arrows2D(origins=[aside] * 3, vectors=axes, colors=AXES_RGB))
    below = np.array([0.0, 0.95])
    sigma = "?" if row.sigma_rotation_deg is None else f"{row.sigma_rotation_deg:.0f}"
    text = f"{row.target}  ±{sigma}°"
    rec.log(f"{where}/label", rr.Points2D([aside + below], colors=[rgb(row.target)], labels=[text], radii=[0.01]))


def log_direction(rec: rr.RecordingStream, row: DirectionRow, camera: CameraInfo | None) -> None:
    """Where a target of unknown range is in the image."""
    center = None if camera is None else project(RINGS_M[-1] * np.array(row.ray_cam), *_lens(camera))
    where = f"{row.uav}/ned/camera/target/{row.target}"
    if center is None:
        _clear(rec, where)
        return
    color = rgb(row.target)
    rec.log(f"{where}/direction", rr.Points2D([center], colors=[color], radii=[-4.0]))
    below = [center[0], center[1] + LABEL_BELOW_PX]
    rec.log(f"{where}/label", rr.Points2D([below], colors=[color], labels=[f"{row.target}  range ?"], radii=[0.0]))


def log_direction_placed(rec: rr.RecordingStream, row: DirectionRow, R_ned_cam: Array, t_ned_cam_m: Array) -> None:
    """The line of sight to a target of unknown range, in space and from above, as far as the outermost ring."""
    sight_m = RINGS_M[-1] * R_ned_cam @ np.array(row.ray_cam)
    color, label = rgb(row.target), f"{row.target}  range ?"
    line = rr.LineStrips3D([[t_ned_cam_m, t_ned_cam_m + sight_m]], colors=[color], labels=[label])
    rec.log(f"{row.uav}/ned/target/{row.target}/line_of_sight", line)
    above = rr.LineStrips2D([np.stack([np.zeros(2), _on_map(sight_m)])], colors=[color], labels=[label])
    rec.log(f"{row.uav}/map/target/{row.target}/line_of_sight", above)


def log_placed(
    rec: rr.RecordingStream, row: TargetRow, pose: TargetPose, R_ned_cam: Array, t_ned_cam_m: Array,
    size_m: Sequence[float],
) -> None:  # fmt: skip
    """The target in space and from above."""
    color, uav, name = rgb(row.target), row.uav, row.target
    t_m = t_ned_cam_m + R_ned_cam @ pose.pose.t_cam_target_m
    covariance = R_ned_cam @ pose.pose.covariance[:3, :3] @ R_ned_cam.T
    where = f"{uav}/ned/target/{name}"
    label = f"{name}  {row.range_m:.0f} m"
    rec.log(f"{where}/place", rr.Points3D([t_m], colors=[color], labels=[label], radii=[0.8]))
    half_m, q_xyzw = ellipsoid(covariance)
    doubt = rr.Ellipsoids3D(
        centers=[t_m], half_sizes=[half_m], quaternions=[rr.Quaternion(xyzw=q_xyzw)], colors=[(*color, 70)],
        fill_mode="majorwireframe",
    )  # fmt: skip
    rec.log(f"{where}/sigma", doubt)
    rec.log(f"{where}/line_of_sight", rr.LineStrips3D([[t_ned_cam_m, t_m]], colors=[DOUBT_RGB]))
    rec.log(f"{uav}/ned/trail/targets", rr.Points3D([t_m], colors=[color], radii=[0.8]))
    above_m = _on_map(t_m - t_ned_cam_m)
    above = f"{uav}/map/target/{name}"
    rec.log(f"{above}/place", rr.Points2D([above_m], colors=[color], labels=[label], radii=[4.0]))
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])
    doubt_line = ellipse(above_m, turned @ covariance[:2, :2] @ turned.T)
    rec.log(f"{above}/sigma", rr.LineStrips2D([doubt_line], colors=[color]))
    rec.log(f"{uav}/map/trail/targets", rr.Points2D([above_m], colors=[color], radii=[1.5]))
    R_cam_target = _R_cam_target(pose)
    if R_cam_target is None:
        plots = [plot_path(uav, name, f"attitude/{what}") for what in _ANGLES]
        _clear(rec, f"{where}/body", f"{above}/heading", *plots)
    else:
        _log_turned(rec, row, R_ned_cam @ R_cam_target, t_m, above_m, size_m)


def _log_turned(
    rec: rr.RecordingStream, row: TargetRow, R_ned_target: Array, t_m: Array, above_m: Array, size_m: Sequence[float]
) -> None:
    """The target's attitude: in space, from above and as plots."""
    color, uav, name = rgb(row.target), row.uav, row.target
    body = f"{uav}/ned/target/{name}/body"
    rec.log(body, rr.Transform3D(translation=t_m, mat3x3=R_ned_target))
    rec.log(f"{body}/box", rr.Boxes3D(sizes=[size_m], colors=[color]))
    rec.log(f"{body}/nose", rr.Arrows3D(vectors=[[size_m[0], 0, 0]], colors=[color], radii=[0.3]))
    heading = rr.Arrows2D(origins=[above_m], vectors=[30.0 * _on_map(R_ned_target[:, 0])], colors=[color], radii=[2.0])
    rec.log(f"{uav}/map/target/{name}/heading", heading)
    roll, pitch, yaw = np.degrees(euler_from_R(R_ned_target))
    for what, value in zip(_ANGLES, (roll, pitch, yaw % 360.0), strict=True):
        rec.log(plot_path(uav, name, f"attitude/{what}"), rr.Scalars(float(value)))


def _R_cam_target(pose: TargetPose) -> Array | None:
    """None if the pose's quaternion is only a placeholder, which must not be drawn."""
    return R_from_q_wxyz(np.roll(pose.pose.q_cam_target_xyzw, 1)) if pose.rotation_known else None


def _clear(rec: rr.RecordingStream, *paths: str) -> None:
    for path in paths:
        rec.log(path, rr.Clear(recursive=True))


def log_plots(rec: rr.RecordingStream, row: TargetRow, age_s: float) -> None:
    """Range with its uncertainty, closing speed, score, and age at reception."""
    values = {
        "range": row.range_m,
        "range/minus_2_sigma": row.range_m - SIGMAS * row.sigma_range_m,
        "range/plus_2_sigma": row.range_m + SIGMAS * row.sigma_range_m,
        "closing": row.closing_mps,
        "score": row.score,
        "age": 1e3 * age_s,
    }
    for path, value in values.items():
        if value is not None:
            rec.log(plot_path(row.uav, row.target, path), rr.Scalars(value))


def clock(utc_ns: int) -> str:
    """A time as text, such as `10:03:04 UTC`."""
    return datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).strftime("%H:%M:%S UTC")


def log_event(rec: rr.RecordingStream, uav: str, level: int, text: str) -> None:
    """`level` as in rcl_interfaces/Log."""
    rec.log(f"{uav}/events", rr.TextLog(text, level=_LEVELS.get(level, "INFO")))


def log_health(rec: rr.RecordingStream, uav: str, message: DiagnosticArray, *, news: bool) -> None:
    """Health as text, its latencies as plots; with `news` as an event too."""
    status = message.status[0]
    values = dict(status.values)
    rec.log(f"{uav}/health", rr.TextDocument(health_text(status), media_type="text/markdown"))
    if news:
        rec.log(f"{uav}/events", rr.TextLog(status.message, level=_HEALTH_LEVELS.get(status.level, "WARN")))
    for name in _LATENCIES:
        value = _number(values.get(f"latency_ms/{name.replace('_', '/')}", ""))
        if value is not None:
            rec.log(f"{uav}/plots/latency/{name}", rr.Scalars(value))


def log_silence(rec: rr.RecordingStream, uav: str, last: DiagnosticArray) -> None:
    """In place of health: the time since which none was received, and the last state."""
    status = last.status[0]
    text = f"## No word since {clock(last.stamp_ns)}\n\nThe last was: {status.message.replace('|', '¦')}"
    rec.log(f"{uav}/health", rr.TextDocument(text, media_type="text/markdown"))


def health_text(status: DiagnosticStatus) -> str:
    """Markdown: state first, then other values, then latencies."""
    safe = [(key.replace("|", "¦"), value.replace("|", "¦")) for key, value in status.values]
    rest = [pair for pair in safe if not pair[0].startswith("latency_ms/")]
    latencies: dict[str, dict[str, str]] = {}
    for key, value in safe:
        if key.startswith("latency_ms/") and key.count("/") == 2:
            _, stage, percentile = key.split("/")
            latencies.setdefault(stage, {})[percentile] = value
    # A list, not a table: in a narrow panel one long value would push the whole column out of view.
    lines = [f"## {status.message.replace('|', '¦')}", ""]
    lines += [f"- {key}: **{value[:VALUE_CHARS_MAX]}**" for key, value in rest]
    if latencies:
        lines += ["", "| ms | p50 | p95 | p99 |", "|---|---|---|---|"]
        lines += [
            f"| {stage} | " + " | ".join(one.get(p, "–") for p in ("p50", "p95", "p99")) + " |"
            for stage, one in latencies.items()
        ]
    return "\n".join(lines)


def _on_map(ned: Array) -> Array:
    """NED to map coordinates, east right and north up: 2-D views have y downwards."""
    return np.array([ned[1], -ned[0]])


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
