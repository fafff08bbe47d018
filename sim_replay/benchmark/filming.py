"""Converts a sequence's plan to the scene of each frame: flight, lens, shutter and labels; nothing is rendered yet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_replay.airframes import airframe_id
from sim_replay.benchmark.plan import SequencePlan
from sim_replay.benchmark.preset import Preset
from sim_replay.bop import BopTarget
from sim_replay.flight import Encounter, EncounterPlan, fly_encounter
from sim_replay.render.frame import outline_px
from sim_replay.render.projection import extents_px, project_px, solid_vertices_m
from sim_replay.render.scene import Camera, Environment, Scene, Target, environment_from_seed
from sim_replay.render.sensor import Sensor, sensor_from

Array = NDArray[np.float64]
POINTING_MARGIN = 1.3  # the flown aspect may require a lens longer than planned by this factor


@dataclass(frozen=True, eq=False)
class Film:
    """A flown sequence, ready to be rendered frame by frame; every frame is a pure function of it."""

    plan: SequencePlan
    size_wh_px: tuple[int, int]
    encounter: Encounter
    focal_px: float
    environment: Environment
    sensor: Sensor
    undistorted: bool
    backdrop: Path | None

    @property
    def K(self) -> Array:
        """Intrinsics [3, 3] of every frame, pixels."""
        cx, cy = self.plan.principal_px
        return np.array([[self.focal_px, 0.0, cx], [0.0, self.focal_px, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> tuple[float, float, float, float, float] | None:
        """OpenCV's k1 k2 p1 p2 k3 of the lens, or None if it has none or the undistorted variant is requested."""
        if self.plan.corner_distortion is None or self.undistorted:
            return None
        radius = 0.5 * float(np.hypot(*self.size_wh_px)) / self.focal_px
        k1, k2, p1, p2 = self.plan.corner_distortion
        values = (k1 / radius**2, k2 / radius**4, p1 / radius, p2 / radius)
        return (*(round(value, 9) for value in values), 0.0)  # type: ignore[return-value]

    def scene(self, frame: int) -> Scene:
        """The scene at mid exposure of a frame, and the poses when the shutter closes."""
        middle_s = float(self.encounter.frame_t_s[frame])
        close_s = middle_s + 0.5 * self.plan.exposure_s
        R_ned_cam, t_ned_cam_m = (value[0] for value in self.encounter.camera_pose_at(np.array([close_s])))
        return Scene(
            camera=self._camera(self.encounter.R_ned_cam[frame], self.encounter.t_ned_cam_m[frame]),
            targets=self._targets(middle_s),
            environment=self.environment,
            sensor_seed=self.plan.sensor_seed,
            frame_index=frame,
            shutter_close=(self._camera(R_ned_cam, t_ned_cam_m), self._targets(close_s)),
            distractors=self.plan.distractors,
            backdrop=self.backdrop,
        )

    def _camera(self, R_ned_cam: Array, t_ned_cam_m: Array) -> Camera:
        return Camera(self.K, *self.size_wh_px, R_ned_cam, t_ned_cam_m, distortion=self.distortion)

    def _targets(self, t_s: float) -> tuple[Target, ...]:
        shown = zip(self.plan.airframes, self.plan.livery_seeds, self.encounter.targets, strict=True)
        out = []
        for name, livery_seed, track in list(shown)[: self.plan.shown]:
            at = track.at(np.array([t_s]))
            out.append(Target(airframe_id(name), livery_seed, at.R_ned_body[0], at.t_ned_body_m[0]))
        return tuple(out)


def fly(
    plan: SequencePlan, preset: Preset, focal_px: float, undistorted: bool = False, backdrop: Path | None = None
) -> Film:
    """Fly a planned sequence, filmed with a lens no longer than `pointing_focal_px`. Raises FlightError."""
    return Film(
        plan,
        preset.size_wh_px,
        fly_encounter(encounter_plan(plan, preset)),
        focal_px,
        environment_from_seed(plan.environment_seed, plan.weather),
        # The image is compressed only once, when it is stored.
        replace(sensor_from(np.random.default_rng([plan.sensor_seed, 1]), plan.quality), jpeg_quality=None),
        undistorted,
        backdrop,
    )


def pointing_focal_px(plan: SequencePlan, preset: Preset) -> float:
    """Focal length for which the camera is pointed: a shorter lens also keeps in the image whatever this one does."""
    return min(POINTING_MARGIN * plan.focal_px, preset.lens.focal_px[1])


def encounter_plan(plan: SequencePlan, preset: Preset) -> EncounterPlan:
    """The requirements for the flight."""
    width, height = preset.size_wh_px
    focal_px = pointing_focal_px(plan, preset)
    return EncounterPlan(
        seed=plan.flight_seed,
        frames=plan.frames,
        fps=plan.fps,
        range_m=plan.range_m,
        airframes=plan.airframes,
        half_fov_rad=(float(np.arctan2(0.5 * width, focal_px)), float(np.arctan2(0.5 * height, focal_px))),
        mount="gimbal" if plan.gimbal else "fixed",
        jitter_rad=plan.jitter_rad,
        gust=plan.gust,
        leaves=plan.leaves,
    )


def mean_box_area(encounter: Encounter) -> float:
    """Area of the main target's box at focal length 1, averaged over the frames, as if the image had no edge."""
    vertices = solid_vertices_m(airframe_id(encounter.plan.airframes[0]))
    track = encounter.targets[0].at(encounter.frame_t_s)
    areas = []
    for k in range(len(encounter.frame_t_s)):
        R_cam_ned = encounter.R_ned_cam[k].T
        t_cam = R_cam_ned @ (track.t_ned_body_m[k] - encounter.t_ned_cam_m[k])
        # A target outside the image may be far off axis: its box is computed as if the camera pointed at it.
        towards = _turned_to_axis(t_cam)
        pixels = project_px(vertices, towards @ R_cam_ned @ track.R_ned_body[k], towards @ t_cam, np.eye(3))
        areas.append(float(np.prod(np.ptp(pixels, axis=0))))
    return float(np.mean(areas))


def _turned_to_axis(t_cam_m: Array) -> Array:
    """R [3, 3] of the shortest rotation of a camera ray onto the optical axis."""
    d = t_cam_m / np.linalg.norm(t_cam_m)
    cross = np.array([d[1], -d[0], 0.0])
    skew = np.array([[0.0, 0.0, cross[1]], [0.0, 0.0, -cross[0]], [-cross[1], cross[0], 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + d[2])


def outline_labels(scene: Scene) -> tuple[BopTarget, ...]:
    """Labels without rendering: boxes of the projected outlines, clipped to the image; pixels are not counted.

    A target is listed if its outline's box touches the image; occlusion is not known here.
    """
    camera = scene.camera
    limit = np.array([camera.width_px, camera.height_px]) - 0.5
    out = []
    for target in scene.targets:
        extents = extents_px(outline_px(target, camera))
        if extents is None:
            continue
        whole = np.asarray(extents)
        low, high = np.maximum(whole[:2], -0.5), np.minimum(whole[2:], limit)
        if (high > low).all():
            pose = target.pose_in(camera)
            out.append(BopTarget(target.airframe_id + 1, *pose, np.concatenate([low, high]), whole))
    return tuple(out)
