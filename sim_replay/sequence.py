"""Generates the bundled sequence: one aircraft crosses and recedes from an own ship whose fixed camera follows it.

    python -m sim_replay.sequence --out sim_replay/data/crossing --seed 34

The folder is a BOP scene with its models, the own ship's telemetry.csv and sequence.toml. The world is local NED.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.tracking.geodesy import lat_lon_alt_from_ned
from msgs.geometry import R_FORWARD_CAM, R_from_euler, q_wxyz_from_R, so3_log
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.bop import SceneWriter, write_camera, write_models
from sim_replay.flight.encounter import ORIGIN_DEG_M
from sim_replay.flight.pilot import GRAVITY_MPS2
from sim_replay.render.frame import render_frame
from sim_replay.render.records import bop_frame, bop_target
from sim_replay.render.scene import Camera, Scene, Target, environment_from_seed
from sim_replay.render.sensor import Sensor
from sim_replay.telemetry import Telemetry, write_telemetry

Array = NDArray[np.float64]
FPS = 30.0
FRAMES = 150
LEAD_S = 1.0  # of telemetry before the first frame and after the last
TELEMETRY_HZ = 50.0
AIRFRAME = "twin_boom_inverted_v"
LIVERY_SEED = 8
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 1920, 1080, 2700.0
MOUNT_PITCH_RAD = np.radians(4.0)
R_BODY_CAM = R_from_euler(0.0, MOUNT_PITCH_RAD, 0.0) @ R_FORWARD_CAM
T_BODY_CAM_M = np.array([0.45, 0.0, 0.12])
SENSOR = Sensor(
    blur_sigma_px=0.6,
    motion_px=(0.0, 0.0),
    gain=1.0,
    contrast=1.0,
    saturation=1.0,
    cast_bgr=(1.0, 1.0, 1.0),
    noise=0.003,
    read_noise=0.002,
    jpeg_quality=None,
)

Profile = Callable[[Array], Array]


@dataclass(frozen=True)
class Flight:
    """A point-mass flight in coordinated turns: heading rate = g tan(bank) / V, no slip, constant climb angle."""

    t_ned_start_m: tuple[float, float, float]  # its position when the first frame is exposed
    speed_mps: float
    heading_rad: float  # at that time
    climb_rad: float
    incidence_rad: float  # angle of the nose above the path
    bank_rad: Profile  # of time, s
    shake_rad: Profile  # [N] to [N, 3]: roll, pitch, yaw of the airframe in turbulence

    def states(self, t_s: Array) -> tuple[Array, Array, Array]:
        """R_ned_body [N, 3, 3], t_ned_body_m [N, 3] and v_ned_body_mps [N, 3] at times [N], seconds."""
        grid = np.arange(-LEAD_S - 0.1, FRAMES / FPS + LEAD_S + 0.1, 1e-3)
        turn = GRAVITY_MPS2 * np.tan(self.bank_rad(grid)) / self.speed_mps
        heading = self.heading_rad + _integral(turn, grid)
        velocity = self._velocity(heading)
        track = np.stack([_integral(velocity[:, k], grid) for k in range(3)], axis=-1) + self.t_ned_start_m
        heading_t = np.interp(t_s, grid, heading)
        position = np.stack([np.interp(t_s, grid, track[:, k]) for k in range(3)], axis=-1)
        shake = self.shake_rad(t_s)
        pitch = np.full_like(t_s, self.climb_rad + self.incidence_rad) + shake[:, 1]
        R_ned_body = R_from_euler(self.bank_rad(t_s) + shake[:, 0], pitch, heading_t + shake[:, 2])
        return R_ned_body, position, self._velocity(heading_t)

    def rates_body_radps(self, t_s: Array) -> Array:
        """Angular rates p, q, r [N, 3] by central differences of the attitude over 2 ms."""
        step_s = 1e-3
        before, after = self.states(t_s - step_s)[0], self.states(t_s + step_s)[0]
        return so3_log(np.swapaxes(before, -1, -2) @ after) / (2.0 * step_s)

    def _velocity(self, heading: Array) -> Array:
        level = np.cos(self.climb_rad)
        down = np.full_like(heading, -np.sin(self.climb_rad))
        return self.speed_mps * np.stack([level * np.cos(heading), level * np.sin(heading), down], axis=-1)


def _integral(rate: Array, t_s: Array) -> Array:
    """Trapezoidal integral that is zero at t = 0."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return total - np.interp(0.0, t_s, total)


def _shake(rng: np.random.Generator, amplitude_rad: float) -> Profile:
    """Turbulence: five sinusoids of 0.3 to 2.5 Hz on each axis."""
    frequency_hz = rng.uniform(0.3, 2.5, (5, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (5, 3))
    size = amplitude_rad * rng.uniform(0.2, 1.0, (5, 3)) / np.sqrt(5.0)

    def at(t_s: Array) -> Array:
        angle = 2.0 * np.pi * frequency_hz * np.asarray(t_s)[:, None, None] + phase
        return np.sum(size * np.sin(angle), axis=1)

    return at


def own_flight(seed: int) -> Flight:
    """A small own ship at 20 m/s that turns gently to the right to keep the target ahead."""
    rng = np.random.default_rng([seed, 1])
    return Flight(
        t_ned_start_m=(0.0, 0.0, -300.0),
        speed_mps=20.0,
        heading_rad=np.radians(-8.0),
        climb_rad=0.0,
        incidence_rad=np.radians(3.0),
        bank_rad=lambda t_s: np.radians(9.5 + 2.0 * np.sin(0.9 * t_s)),
        shake_rad=_shake(rng, np.radians(0.5)),
    )


def target_flight(seed: int) -> Flight:
    """A target at 61 m/s that crosses to the right, turns away to the left and rolls out."""
    rng = np.random.default_rng([seed, 2])
    return Flight(
        t_ned_start_m=(144.0, -36.0, -322.0),
        speed_mps=61.0,
        heading_rad=np.radians(48.0),
        climb_rad=np.radians(2.5),
        incidence_rad=np.radians(2.0),
        bank_rad=lambda t_s: np.radians(-24.0 - 14.0 / (1.0 + np.exp((np.asarray(t_s) - 3.2) / 0.5))),
        shake_rad=_shake(rng, np.radians(0.25)),
    )


@dataclass(frozen=True)
class Filmed:
    """A sequence to be filmed by a camera fixed to the own ship: K / `fps` seconds after the start, frame K."""

    frames: int
    fps: float
    size_wh_px: tuple[int, int]  # of a sensor with one size of pixels, cut smaller
    seed: int  # light, ground and noise
    own: Flight
    targets: tuple[tuple[str, int, Flight], ...]  # airframe, seed of its livery

    def scenes(self) -> list[Scene]:
        """The frames' scenes."""
        t_s = np.arange(self.frames) / self.fps
        width, height = self.size_wh_px
        K = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
        R_ned_own, t_ned_own_m, _ = self.own.states(t_s)
        flown = [(airframe_id(name), livery, *flight.states(t_s)[:2]) for name, livery, flight in self.targets]
        environment = environment_from_seed(self.seed)
        out = []
        for k in range(self.frames):
            place = t_ned_own_m[k] + R_ned_own[k] @ T_BODY_CAM_M
            camera = Camera(K, width, height, R_ned_own[k] @ R_BODY_CAM, place)
            targets = tuple(Target(airframe, livery, R[k], t_m[k]) for airframe, livery, R, t_m in flown)
            out.append(Scene(camera, targets, environment, sensor_seed=self.seed, frame_index=k))
        return out

    def telemetry(self) -> Telemetry:
        """The own ship's state at 50 Hz, from LEAD_S before the first frame to LEAD_S after the last."""
        rows = round((self.frames / self.fps + 2 * LEAD_S) * TELEMETRY_HZ) + 1
        t_ns = np.round((np.arange(rows) / TELEMETRY_HZ - LEAD_S) * 1e9).astype(np.int64)
        t_s = t_ns.astype(np.float64) * 1e-9
        R_ned_body, position, velocity = self.own.states(t_s)
        place = np.array([lat_lon_alt_from_ned(ORIGIN_DEG_M, p) for p in position])
        rates = self.own.rates_body_radps(t_s)
        return Telemetry(t_ns, np.hstack([q_wxyz_from_R(R_ned_body), rates, position, velocity, place]))


def crossing(seed: int) -> Filmed:
    """The bundled sequence."""
    target = (AIRFRAME, LIVERY_SEED, target_flight(seed))
    return Filmed(FRAMES, FPS, (WIDTH_PX, HEIGHT_PX), seed, own_flight(seed), (target,))


def _sequence_toml(seed: int, command: str) -> str:
    matrix = ", ".join("[" + ", ".join(f"{v + 0.0:.9f}" for v in row) + "]" for row in R_BODY_CAM)
    lever = ", ".join(f"{v:.3f}" for v in T_BODY_CAM_M)
    return "\n".join(
        [
            f"# Made by: {command}",
            f'command = "{command}"',
            f"seed = {seed}",
            f"fps = {FPS}",
            "t0_ns = 0  # exposure of frame 0 on telemetry.csv's clock",
            f'airframe = "{AIRFRAME}"',
            "# The camera is fixed to the own ship: R_body_cam turns optical axes into body (FRD).",
            f"R_body_cam = [{matrix}]",
            f"t_body_cam_m = [{lever}]",
            "# World of cam_R_w2c: north-east-down at this point, degrees and metres above sea.",
            f"origin_lat_lon_alt = [{ORIGIN_DEG_M[0]}, {ORIGIN_DEG_M[1]}, {ORIGIN_DEG_M[2]}]",
            "",
        ]
    )


def write_scene(folder: Path, filmed: Filmed, jpeg_quality: int) -> None:
    """Render a sequence into `folder`: everything but sequence.toml. What lies behind the camera is not listed."""
    names = {airframe_id(name) + 1: name for name, _, _ in filmed.targets}
    shown = filmed.scenes()
    with SceneWriter(folder, jpeg_quality) as writer:
        for scene in shown:
            rendered = render_frame(scene, SENSOR)
            ahead = [(t, s) for t, s in zip(scene.targets, rendered.targets, strict=True) if s.box_whole_xyxy_px]
            targets = tuple(bop_target(target, scene.camera, seen) for target, seen in ahead)
            writer.add(bop_frame(scene, targets), rendered.image_bgr, [seen.mask_visib for _, seen in ahead])
    write_models(folder / "models", {number: AIRFRAMES[number - 1].mesh() for number in names}, names)
    write_camera(folder / "camera.json", shown[0].camera.K, *filmed.size_wh_px)
    write_telemetry(folder / "telemetry.csv", filmed.telemetry())


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="Generate the bundled sequence: a BOP scene with own-ship telemetry.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    parser.add_argument("--seed", type=int, default=34, help="light, ground and turbulence (default %(default)s)")
    parser.add_argument("--jpeg-quality", type=int, default=84, metavar="Q", help="1 to 100 (default %(default)s)")
    options = parser.parse_args(arguments)
    given = sys.argv[1:] if arguments is None else list(arguments)
    write_scene(options.out, crossing(options.seed), options.jpeg_quality)
    command = shlex.join(["python", "-m", "sim_replay.sequence", *given])
    (options.out / "sequence.toml").write_text(_sequence_toml(options.seed, command), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
