"""An encounter: own ship, targets and camera over one sequence, drawn from a plan and flown by JSBSim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from edge.tracking.geodesy import lat_lon_alt_from_ned
from msgs.geometry import q_wxyz_from_R
from sim_replay.flight.jsbsim_flight import Gust
from sim_replay.flight.pointing import Pointing
from sim_replay.flight.track import Array, Track
from sim_replay.telemetry import Telemetry

ORIGIN_DEG_M = (47.3977, 8.5456, 488.0)  # of the NED world, on the ground


@dataclass(frozen=True)
class EncounterPlan:
    """Requirements for an encounter; the same plan gives the same encounter, bit for bit."""

    seed: int
    frames: int
    fps: float
    range_m: float  # from own ship to the main target at mid sequence
    airframes: tuple[str, ...]  # the first is the main target
    half_fov_rad: tuple[float, float]  # half the horizontal and half the vertical angle of the lens
    mount: Literal["fixed", "gimbal"] = "gimbal"
    jitter_rad: float = 0.0  # root mean square about each of the camera's axes
    gust: Gust = "light"
    leaves: bool = False  # the main target leaves the image for some frames and returns


@dataclass(frozen=True)
class Encounter:
    """A flown encounter of F frames; tracks run at 50 Hz from 1.2 s before the first frame to 1.2 s after the last."""

    plan: EncounterPlan  # `mount` is the one used: a gimbal if a fixed camera cannot keep the target in view
    frame_t_s: Array  # [F] mid exposure, from 0
    own: Track
    targets: tuple[Track, ...]  # in the order of plan.airframes
    R_ned_cam: Array  # [F, 3, 3]
    t_ned_cam_m: Array  # [F, 3]
    R_body_cam: Array  # [F, 3, 3] with jitter
    t_body_cam_m: Array  # [3]
    pointing: Pointing

    def camera_pose_at(self, t_s: Array) -> tuple[Array, Array]:
        """(R_ned_cam [M, 3, 3], t_ned_cam_m [M, 3]) at times [M]. Raises ValueError outside the tracks."""
        return camera_pose(self.own, self.pointing, self.t_body_cam_m, np.atleast_1d(np.asarray(t_s, dtype=np.float64)))

    def telemetry(self) -> Telemetry:
        """The own ship's rows at 50 Hz; t_ns counts from the first frame's exposure."""
        own = self.own
        place = np.array([lat_lon_alt_from_ned(ORIGIN_DEG_M, p) for p in own.t_ned_body_m])
        columns = [q_wxyz_from_R(own.R_ned_body), own.rates_body_radps, own.t_ned_body_m, own.v_ned_body_mps, place]
        return Telemetry(np.round(own.t_s * 1e9).astype(np.int64), np.hstack(columns))


def camera_pose(own: Track, pointing: Pointing, t_body_cam_m: Array, t_s: Array) -> tuple[Array, Array]:
    """(R_ned_cam [M, 3, 3], t_ned_cam_m [M, 3]) of a camera on its own ship at times [M]."""
    ship = own.at(t_s)
    return ship.R_ned_body @ pointing.at(t_s), ship.t_ned_body_m + ship.R_ned_body @ t_body_cam_m
