"""Renders the two short sequences that golden files need beside the bundled one.

    python -m sim_replay.golden.sequences --out sim_replay/data/golden

`away_and_back`: the own ship swings its nose off the target for longer than a track lasts, and back.
`two_targets`: a second aircraft crosses the first. Both are BOP scenes with telemetry, like `sim_replay.sequence`'s.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.tracking.geodesy import lat_lon_alt_from_ned
from msgs.geometry import q_wxyz_from_R
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.bop import BopFrame, BopTarget, SceneWriter, write_camera, write_models
from sim_replay.render.frame import RenderedFrame, render_frame
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed
from sim_replay.sequence import (
    AIRFRAME,
    FOCAL_PX,
    ORIGIN_DEG_M,
    R_BODY_CAM,
    SENSOR,
    T_BODY_CAM_M,
    TELEMETRY_HZ,
    Array,
    Flight,
    own_flight,
    target_flight,
)
from sim_replay.telemetry import Telemetry, write_telemetry

SEED = 34
FPS = 10.0
SIZE_WH = (1280, 720)  # of a sensor with the bundled sequence's pixels, cut smaller
JPEG_QUALITY = 60
AWAY_RAD = np.radians(42.0)
AWAY_FROM_S, AWAY_TO_S, SWING_S = 1.1, 3.6, 0.1


@dataclass(frozen=True)
class Plan:
    """One sequence: the own ship and the aircraft in front of it, by airframe and livery."""

    frames: int
    own: Flight
    targets: tuple[tuple[str, int, Flight], ...]


def plans() -> dict[str, Plan]:
    """The sequences by name."""
    own, first = own_flight(SEED), (AIRFRAME, 8, target_flight(SEED))
    return {
        "away_and_back": Plan(50, _swinging(own), (first,)),
        "two_targets": Plan(30, own, (first, ("glider", 3, _glider()))),
    }


def _swinging(flight: Flight) -> Flight:
    def shake_rad(t_s: Array) -> Array:
        t_s = np.asarray(t_s)
        out = 1.0 / (1.0 + np.exp((AWAY_FROM_S - t_s) / SWING_S))
        back = 1.0 / (1.0 + np.exp((AWAY_TO_S - t_s) / SWING_S))
        return np.asarray(flight.shake_rad(t_s) + (out - back)[:, None] * [0.0, 0.0, AWAY_RAD])

    return dataclasses.replace(flight, shake_rad=shake_rad)


def _glider() -> Flight:
    """Wings level, slowly from the right to the left of the image."""
    return Flight(
        t_ned_start_m=(185.3, 4.9, -306.0),
        speed_mps=30.1,
        heading_rad=np.radians(10.8),
        climb_rad=np.radians(4.4),
        incidence_rad=np.radians(2.0),
        bank_rad=lambda t_s: np.zeros_like(t_s),
        shake_rad=lambda t_s: np.zeros((len(t_s), 3)),
    )


def scenes(plan: Plan) -> list[Scene]:
    """The frames' scenes, exposed at k / FPS seconds."""
    t_s: Array = np.arange(plan.frames) / FPS
    width, height = SIZE_WH
    K = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
    R_ned_own, t_ned_own_m, _ = plan.own.states(t_s)
    flown = [(airframe_id(name), livery, *flight.states(t_s)[:2]) for name, livery, flight in plan.targets]
    environment = environment_from_seed(SEED)
    out = []
    for k in range(plan.frames):
        place = t_ned_own_m[k] + R_ned_own[k] @ T_BODY_CAM_M
        camera = Camera(K, width, height, R_ned_own[k] @ R_BODY_CAM, place)
        targets = tuple(Target(airframe, livery, R[k], t_m[k]) for airframe, livery, R, t_m in flown)
        out.append(Scene(camera, targets, environment, sensor_seed=SEED, frame_index=k))
    return out


def telemetry(plan: Plan) -> Telemetry:
    """The own ship's state at 50 Hz, from a second before the first frame to a second after the last."""
    rows = round((plan.frames / FPS + 2.0) * TELEMETRY_HZ) + 1
    t_ns = np.round((np.arange(rows) / TELEMETRY_HZ - 1.0) * 1e9).astype(np.int64)
    t_s = t_ns.astype(np.float64) * 1e-9
    R_ned_body, position, velocity = plan.own.states(t_s)
    place = [lat_lon_alt_from_ned(ORIGIN_DEG_M, t_ned_m) for t_ned_m in position]
    rates = plan.own.rates_body_radps(t_s)
    return Telemetry(t_ns, np.hstack([q_wxyz_from_R(R_ned_body), rates, position, velocity, np.array(place)]))


def _bop_frame(scene: Scene, rendered: RenderedFrame, object_ids: Sequence[int]) -> BopFrame:
    camera = scene.camera
    targets = []
    for target, seen, object_id in zip(scene.targets, rendered.targets, object_ids, strict=True):
        R_cam_target, t_cam_target_m = target.pose_in(camera)
        visible, whole = seen.box_visible_xyxy_px, seen.box_whole_xyxy_px
        if whole is None:
            continue  # outside the image
        boxes = (None if visible is None else np.asarray(visible), np.asarray(whole))
        targets.append(BopTarget(object_id, R_cam_target, t_cam_target_m, *boxes, seen.visible_px, seen.whole_px))
    R_cam_ned = camera.R_ned_cam.T
    return BopFrame(scene.frame_index, camera.K, tuple(targets), R_cam_ned, -R_cam_ned @ camera.t_ned_cam_m)


def generate(folder: Path, plan: Plan) -> None:
    """Write a whole sequence into `folder`."""
    shown = scenes(plan)
    ids = {name: airframe_id(name) + 1 for name, _, _ in plan.targets}
    with SceneWriter(folder, JPEG_QUALITY) as writer:
        for scene in shown:
            rendered = render_frame(scene, SENSOR)
            frame = _bop_frame(scene, rendered, list(ids.values()))
            present = [seen.mask_visib for seen in rendered.targets if seen.box_whole_xyxy_px is not None]
            writer.add(frame, rendered.image_bgr, present)
    for name in ("mask", "mask_visib"):  # not used when a sequence is played
        shutil.rmtree(folder / name)
    write_models(folder / "models", {i: AIRFRAMES[i - 1].mesh() for i in ids.values()}, {i: n for n, i in ids.items()})
    write_camera(folder / "camera.json", shown[0].camera.K, *SIZE_WH)
    write_telemetry(folder / "telemetry.csv", telemetry(plan))
    lines = [
        'command = "python -m sim_replay.golden.sequences"',
        f"fps = {FPS}",
        "t0_ns = 0  # exposure of frame 0 on telemetry.csv's clock",
        f"R_body_cam = {np.round(R_BODY_CAM, 9).tolist()}",
        f"t_body_cam_m = {T_BODY_CAM_M.tolist()}",
        f"origin_lat_lon_alt = {list(ORIGIN_DEG_M)}",
    ]
    (folder / "sequence.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m sim_replay.golden.sequences", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write the scenes' folders to")
    options = parser.parse_args(arguments)
    for name, plan in plans().items():
        generate(options.out / name, plan)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
