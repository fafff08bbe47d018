"""Generates one sequence on disk: renders its frames into a scene folder and writes the accompanying files."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from msgs.geometry import Array
from msgs.settings import toml_value
from sim_replay.benchmark.crew import Stopped, Tell
from sim_replay.benchmark.exposure import metered
from sim_replay.benchmark.filming import Film, fly, outline_labels
from sim_replay.benchmark.plan import SequencePlan
from sim_replay.benchmark.preset import Preset
from sim_replay.benchmark.scene_store import SceneStore, is_finished
from sim_replay.benchmark.video import through_h264
from sim_replay.bop import write_camera
from sim_replay.flight.encounter import ORIGIN_DEG_M
from sim_replay.render.frame import render_frame
from sim_replay.render.records import bop_frame, bop_target
from sim_replay.telemetry import write_telemetry


@dataclass(frozen=True)
class Job:
    """Settings shared by all sequences of a run."""

    preset: Preset
    out: Path
    command: str  # that reproduces the dataset
    focal_px: Mapping[int, float]  # by sequence
    every: int = 1  # render only every Nth of the planned frames
    labels_only: bool = False
    undistorted: bool = False
    backdrops: tuple[Path, ...] = ()  # photographs; half of the sequences use one in place of sky and ground

    def folder(self, plan: SequencePlan) -> Path:
        """The sequence's BOP scene folder."""
        return self.out / plan.split / f"{plan.index:06d}"

    def frames(self, plan: SequencePlan) -> range:
        """Numbers of the frames to generate; an image keeps its number whatever `every` is."""
        return range(0, plan.frames, self.every)

    def film(self, plan: SequencePlan) -> Film:
        """The flown sequence."""
        return fly(plan, self.preset, self.focal_px[plan.index], self.undistorted, self.backdrop(plan))

    def backdrop(self, plan: SequencePlan) -> Path | None:
        """The photograph behind a sequence; None: sky and ground are drawn."""
        if not self.backdrops or plan.environment_seed // 2 % 2 == 0:
            return None
        return self.backdrops[plan.environment_seed // 4 % len(self.backdrops)]


@dataclass(frozen=True)
class FrameNews:
    """Finished frames: generated now, or kept from before."""

    sequence: int
    made: int = 0
    kept: int = 0


def make_sequence(job: Job, plan: SequencePlan, tell: Tell, stopped: Stopped) -> bool:
    """A crew's task: generate what is missing of a sequence, report FrameNews; False if interrupted between frames."""
    folder = job.folder(plan)
    if is_finished(folder):
        shutil.rmtree(folder / ".part", ignore_errors=True)
        tell(FrameNews(plan.index, kept=len(job.frames(plan))))
        return True
    film = job.film(plan) if job.labels_only else metered(job.film(plan))
    h264_kbps = None if job.labels_only else plan.h264_kbps
    with SceneStore(folder, plan.jpeg_quality, pictures=not job.labels_only, keep_raw=h264_kbps is not None) as store:
        tell(FrameNews(plan.index, kept=len(store.done)))
        for number in job.frames(plan):
            if number in store.done:
                continue
            if stopped():
                return False
            add_frame(store, film, number, job.labels_only)
            tell(FrameNews(plan.index, made=1))
        if h264_kbps is not None:
            # At the full rate even if frames are left out: an image then has as many bits as among all of them.
            store.replace_images(through_h264(store.raw_images(), plan.fps, h264_kbps))
        K, size, distortion = film.K, film.size_wh_px, film.distortion
        store.finish(
            {
                "camera.json": lambda path: write_camera(path, K, *size, distortion),
                "telemetry.csv": lambda path: write_telemetry(path, film.encounter.telemetry()),
            },
            sequence_toml(job, film),
        )
    return True


def add_frame(store: SceneStore, film: Film, number: int, labels_only: bool) -> None:
    """Render and store one frame. A target without a visible pixel is not listed."""
    scene = film.scene(number)
    if labels_only:
        store.add(bop_frame(scene, outline_labels(scene)), None)
        return
    drawn = render_frame(scene, film.sensor)
    shown = [(target, seen) for target, seen in zip(scene.targets, drawn.targets, strict=True) if seen.visible_px]
    targets = tuple(bop_target(target, scene.camera, seen) for target, seen in shown)
    visible, whole = [seen.mask_visib for _, seen in shown], [seen.mask for _, seen in shown]
    store.add(bop_frame(scene, targets), drawn.image_bgr, visible, whole)


def _matrix_rows(matrix: Array) -> str:
    return ", ".join("[" + ", ".join(f"{v + 0.0:.9f}" for v in row) + "]" for row in matrix)


def sequence_toml(job: Job, film: Film) -> str:
    """The text of sequence.toml, which describes how the sequence was flown and how to play it."""
    plan, encounter = film.plan, film.encounter
    lever = ", ".join(f"{v:.3f}" for v in encounter.t_body_cam_m)
    origin = ", ".join(str(value) for value in ORIGIN_DEG_M)
    names = ", ".join(f'"{name}"' for name in plan.airframes[: plan.shown])
    codec = [] if plan.h264_kbps is None else [f"h264_kbps = {plan.h264_kbps}"]
    return "\n".join(
        [
            f"command = {toml_value(job.command)}  # makes the dataset again",
            f"sequence = {plan.index}",
            f'split = "{plan.split}"',
            f"fps = {plan.fps / job.every}",
            "t0_ns = 0  # exposure of frame 0 on telemetry.csv's clock",
            f'airframe = "{plan.airframes[0] if plan.shown else ""}"',
            f"airframes = [{names}]",
            f"flight_seed = {plan.flight_seed}",
            f"range_m = {plan.range_m}  # planned, in the middle of the sequence",
            f"focal_px = {film.focal_px}",
            f'weather = "{plan.weather}"',
            f'camera = "{plan.quality}"',
            f"exposure_s = {plan.exposure_s}",
            f"jpeg_quality = {plan.jpeg_quality}",
            *codec,
            f'mount = "{encounter.plan.mount}"',
            "# R_body_cam turns optical axes into body (FRD), without vibration; on a gimbal it is that at frame 0.",
            "# scene_camera.json holds the camera's attitude at every frame, with vibration.",
            f"R_body_cam = [{_matrix_rows(encounter.pointing.still_at(encounter.frame_t_s[:1])[0])}]",
            f"t_body_cam_m = [{lever}]",
            "# World of cam_R_w2c: north-east-down at this point, degrees and metres above sea.",
            f"origin_lat_lon_alt = [{origin}]",
            "",
        ]
    )
