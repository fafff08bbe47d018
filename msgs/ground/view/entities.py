"""What one vehicle looks like in Rerun: each function logs one thing at the time that was set on the recording.

Entities of `<uav>`: `ned` (3-D, north, east, down), with `ned/camera` the picture; `map` (from above), `zoom` (targets
as seen, enlarged), `plots`, `health`, `events`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from msgs.cdr import CameraInfo, CompressedImage, DiagnosticArray, DiagnosticStatus
from msgs.geometry import R_from_q_wxyz, euler_from_R
from msgs.ground.fleet import TargetRow
from msgs.ground.view.drawing import SIGMAS, box_edges_m, ellipse, ellipsoid, pixel_covariance, posed, project
from msgs.receive import TargetPose
from msgs.wire import Array

OWN_RGB = (90, 200, 250)
TARGET_RGB = ((255, 90, 180), (255, 190, 60), (140, 230, 90), (190, 140, 255))
DOUBT_RGB = (150, 150, 160)
SHIP_SIZE_M = (3.0, 3.0, 0.8)
FRUSTUM_M = 40.0
_LEVELS = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "CRITICAL"}
_HEALTH_LEVELS = {0: "INFO", 1: "WARN", 2: "ERROR"}
_MEDIA_TYPES = {"jpeg": "image/jpeg", "png": "image/png"}
_PLOTTED_LATENCIES = {"latency_ms/total/p50": "total_p50", "latency_ms/total/p99": "total_p99"}


def rgb(target: str) -> tuple[int, int, int]:
    """Of `t0`, `t1`, …"""
    return TARGET_RGB[int(target[1:]) % len(TARGET_RGB)]


def target_paths(uav: str, target: str) -> tuple[str, ...]:
    """Everything that stands for one target now; trails and plots go on."""
    return tuple(f"{uav}/{where}/target/{target}" for where in ("ned", "ned/camera", "map", "zoom"))


def prepare(rec: rr.RecordingStream, uav: str) -> None:
    """What does not change."""
    rec.log(f"{uav}/ned", rr.ViewCoordinates.FRD, static=True)
    rec.log(f"{uav}/ned/ship/body", rr.Boxes3D(sizes=[SHIP_SIZE_M], colors=[OWN_RGB]), static=True)
    rec.log(f"{uav}/ned/ship/nose", rr.Arrows3D(vectors=[[8.0, 0.0, 0.0]], colors=[OWN_RGB], radii=[0.3]), static=True)


def log_camera(rec: rr.RecordingStream, uav: str, info: CameraInfo) -> None:
    """The camera and the edge of its pictures."""
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


def log_ship(rec: rr.RecordingStream, uav: str, R_ned_body: Array, t_ned_m: Array, R_ned_cam: Array) -> None:
    """The own ship and its camera, which is drawn at the ship's place."""
    rec.log(f"{uav}/ned/ship", rr.Transform3D(translation=t_ned_m, mat3x3=R_ned_body))
    rec.log(f"{uav}/ned/camera", rr.Transform3D(translation=t_ned_m, mat3x3=R_ned_cam))
    rec.log(f"{uav}/ned/trail/ship", rr.Points3D([t_ned_m], colors=[OWN_RGB], radii=[0.6]))
    here, ahead = _on_map(t_ned_m), _on_map(R_ned_body[:, 0])
    rec.log(f"{uav}/map/ship", rr.Arrows2D(origins=[here], vectors=[20.0 * ahead], colors=[OWN_RGB], labels=[uav]))
    rec.log(f"{uav}/map/trail/ship", rr.Points2D([here], colors=[OWN_RGB], radii=[1.0]))


def log_seen(
    rec: rr.RecordingStream, row: TargetRow, pose: TargetPose, camera: CameraInfo | None, size_m: Sequence[float]
) -> None:
    """The target on the picture: its box, that box one sigma nearer and farther, and where its centre may be."""
    t_m, covariance = pose.pose.t_cam_target_m, pose.pose.covariance
    R = R_from_q_wxyz(np.roll(pose.pose.q_cam_target_xyzw, 1))
    edges = box_edges_m(size_m)
    label = f"{row.target}  {row.range_m:.0f} ± {row.sigma_range_m:.0f} m"
    _log_zoom(rec, row, R, size_m)
    if camera is None:
        return
    where = f"{row.uav}/ned/camera/target/{row.target}"
    box = project(posed(edges, R, t_m), camera.K, camera.distortion)
    if box is None:
        return
    rec.log(f"{where}/box", rr.LineStrips2D(list(box), colors=[rgb(row.target)], radii=[-1.5]))
    share = row.sigma_range_m / max(row.range_m, 1e-9)
    doubtful = [project(posed(edges, R, t_m * max(1.0 + s * share, 0.1)), camera.K, camera.distortion) for s in (-1, 1)]
    strips = [strip for one in doubtful if one is not None for strip in one]
    if strips:
        rec.log(f"{where}/range_sigma", rr.LineStrips2D(strips, colors=[DOUBT_RGB], radii=[-0.7]))
    center = project(t_m, camera.K, camera.distortion)
    if center is not None:
        doubt = ellipse(center, pixel_covariance(t_m, covariance[:3, :3], camera.K))
        rec.log(f"{where}/sigma", rr.LineStrips2D([doubt], colors=[rgb(row.target)], labels=[label]))


def _log_zoom(rec: rr.RecordingStream, row: TargetRow, R_cam_target: Array, size_m: Sequence[float]) -> None:
    """The box as the camera sees it, without perspective, one unit long; targets stand side by side."""
    aside = np.array([2.0 * int(row.target[1:]), 0.0])
    unit = box_edges_m(np.asarray(size_m) / max(size_m))
    strips = (unit @ R_cam_target.T)[..., :2] + aside
    where = f"{row.uav}/zoom/target/{row.target}"
    rec.log(f"{where}/box", rr.LineStrips2D(list(strips), colors=[rgb(row.target)]))
    axes = (0.8 * R_cam_target.T)[:, :2]
    colors = [(240, 70, 70), (80, 220, 80), (90, 140, 255)]
    arrows = rr.Arrows2D(origins=[aside] * 3, vectors=axes, colors=colors, labels=["nose", "right", "down"])
    rec.log(f"{where}/axes", arrows)
    below = np.array([0.0, 0.95])
    text = f"{row.target}  ±{row.sigma_rotation_deg:.0f}°"
    rec.log(f"{where}/label", rr.Points2D([aside + below], colors=[rgb(row.target)], labels=[text], radii=[0.01]))


def log_placed(
    rec: rr.RecordingStream, row: TargetRow, pose: TargetPose, R_ned_cam: Array, t_ned_own_m: Array,
    size_m: Sequence[float],
) -> None:  # fmt: skip
    """The target in space and from above."""
    color, uav, name = rgb(row.target), row.uav, row.target
    R = R_ned_cam @ R_from_q_wxyz(np.roll(pose.pose.q_cam_target_xyzw, 1))
    t_m = t_ned_own_m + R_ned_cam @ pose.pose.t_cam_target_m
    covariance = R_ned_cam @ pose.pose.covariance[:3, :3] @ R_ned_cam.T
    where = f"{uav}/ned/target/{name}"
    rec.log(f"{where}/body", rr.Transform3D(translation=t_m, mat3x3=R))
    label = f"{name}  {row.range_m:.0f} m"
    rec.log(f"{where}/body/box", rr.Boxes3D(sizes=[size_m], colors=[color], labels=[label]))
    rec.log(f"{where}/body/nose", rr.Arrows3D(vectors=[[size_m[0], 0, 0]], colors=[color], radii=[0.3]))
    half_m, q_xyzw = ellipsoid(covariance)
    doubt = rr.Ellipsoids3D(
        centers=[t_m], half_sizes=[half_m], quaternions=[rr.Quaternion(xyzw=q_xyzw)], colors=[(*color, 70)],
        fill_mode="majorwireframe",
    )  # fmt: skip
    rec.log(f"{where}/sigma", doubt)
    rec.log(f"{where}/line_of_sight", rr.LineStrips3D([[t_ned_own_m, t_m]], colors=[DOUBT_RGB]))
    rec.log(f"{uav}/ned/trail/targets", rr.Points3D([t_m], colors=[color], radii=[0.8]))
    place = _on_map(t_m)
    above = f"{uav}/map/target/{name}"
    rec.log(
        f"{above}/heading",
        rr.Arrows2D(origins=[place], vectors=[20.0 * _on_map(R[:, 0])], colors=[color], labels=[label]),
    )
    turned = np.array([[0.0, 1.0], [-1.0, 0.0]])
    rec.log(f"{above}/sigma", rr.LineStrips2D([ellipse(place, turned @ covariance[:2, :2] @ turned.T)], colors=[color]))
    rec.log(f"{uav}/map/trail/targets", rr.Points2D([place], colors=[color], radii=[1.0]))
    roll, pitch, heading = np.degrees(euler_from_R(R))
    for what, value in (("roll", roll), ("pitch", pitch), ("heading", heading % 360.0)):
        rec.log(f"{uav}/plots/attitude/{name}/{what}", rr.Scalars(float(value)))


def log_plots(rec: rr.RecordingStream, row: TargetRow, age_s: float) -> None:
    uav, name = row.uav, row.target
    plots = f"{uav}/plots"
    rec.log(f"{plots}/range/{name}", rr.Scalars(row.range_m))
    rec.log(f"{plots}/range/{name}/minus_2_sigma", rr.Scalars(row.range_m - SIGMAS * row.sigma_range_m))
    rec.log(f"{plots}/range/{name}/plus_2_sigma", rr.Scalars(row.range_m + SIGMAS * row.sigma_range_m))
    if row.closing_mps is not None:
        rec.log(f"{plots}/closing/{name}", rr.Scalars(row.closing_mps))
    if row.score is not None:
        rec.log(f"{plots}/score/{name}", rr.Scalars(row.score))
    rec.log(f"{plots}/latency/{name}_age", rr.Scalars(1e3 * age_s))


def log_event(rec: rr.RecordingStream, uav: str, level: int, text: str) -> None:
    """`level` as in rcl_interfaces/Log."""
    rec.log(f"{uav}/events", rr.TextLog(text, level=_LEVELS.get(level, "INFO")))


def log_health(rec: rr.RecordingStream, uav: str, message: DiagnosticArray, *, news: bool) -> None:
    """Health as a table, its latencies as plots; with `news` as an event too."""
    status = message.status[0]
    values = dict(status.values)
    rec.log(f"{uav}/health", rr.TextDocument(health_text(status), media_type="text/markdown"))
    if news:
        rec.log(f"{uav}/events", rr.TextLog(status.message, level=_HEALTH_LEVELS.get(status.level, "WARN")))
    for key, name in _PLOTTED_LATENCIES.items():
        value = _number(values.get(key, ""))
        if value is not None:
            rec.log(f"{uav}/plots/latency/{name}", rr.Scalars(value))


def health_text(status: DiagnosticStatus) -> str:
    """Markdown: state first, then what is not a latency, then latencies."""
    safe = [(key.replace("|", "¦"), value.replace("|", "¦")) for key, value in status.values]
    rest = [pair for pair in safe if not pair[0].startswith("latency_ms/")]
    latencies: dict[str, dict[str, str]] = {}
    for key, value in safe:
        if key.startswith("latency_ms/") and key.count("/") == 2:
            _, stage, percentile = key.split("/")
            latencies.setdefault(stage, {})[percentile] = value
    lines = [f"## {status.message.replace('|', '¦')}", "", "| | |", "|---|---|"]
    lines += [f"| {key} | {value} |" for key, value in rest]
    if latencies:
        lines += ["", "| ms | p50 | p95 | p99 |", "|---|---|---|---|"]
        lines += [
            f"| {stage} | " + " | ".join(one.get(p, "–") for p in ("p50", "p95", "p99")) + " |"
            for stage, one in latencies.items()
        ]
    return "\n".join(lines)


def _on_map(ned: Array) -> Array:
    """East to the right, north up: 2-D views have y downwards."""
    return np.array([ned[1], -ned[0]])


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
