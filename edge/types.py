"""What moves through the daemon: Frame → Estimate → Track → Report. Each names its frames and units."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameMeta:
    """Who a frame is, all times on the monotonic clock."""

    sequence: int  # counts frames the source produced less repeats that were withheld, so a gap is a drop
    capture_ns: int  # exposure time
    arrival_ns: int  # when the daemon held the pixels
    time_jumps: int = 0  # how often the camera's time had jumped by then


@dataclass(frozen=True)
class Frame:
    """One picture as the camera gave it and the intrinsics of exactly its pixels, its lens's distortion among them."""

    meta: FrameMeta
    image_bgr: NDArray[np.uint8]  # [H, W, 3]
    K: Array  # [3, 3], pixel centres at integers
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]] (plumb bob); empty: a pinhole camera


@dataclass(frozen=True)
class CameraInfo:
    """What a camera gives, known before its first frame."""

    name: str
    image_size_wh: tuple[int, int]
    K: Array  # [3, 3], pixel centres at integers; a zooming sequence's frames carry their own
    frame_rate_hz: float | None  # None: not known beforehand
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]] (plumb bob); empty: none


@dataclass(frozen=True)
class Estimate:
    """One target in one frame, as the network sees it, in `cam` (x right, y down, z forward)."""

    score: float
    box_xyxy_px: Array  # [4], visible box on the full frame
    R_cam_target: Array  # [3, 3], target body axes (FRD) into cam
    t_cam_target_m: Array  # [3]
    covariance: Array  # [6, 6], (x, y, z m, rot x, y, z rad) in cam; rotation as R = exp(w) R_hat
    stage: Literal["acquire", "track"]


@dataclass(frozen=True)
class Mount:
    """How the camera sits on its vehicle."""

    R_body_cam: Array  # [3, 3], cam (optical) into body (FRD)
    t_body_cam_m: Array  # [3], the camera's centre from the body origin


@dataclass(frozen=True)
class OwnShip:
    """The camera's vehicle at one instant (a frame's exposure)."""

    time_ns: int  # monotonic
    R_ned_body: Array  # [3, 3]
    t_ned_body_m: Array | None  # [3], None without a position source
    v_ned_body_mps: Array | None  # [3]
    lat_lon_alt: tuple[float, float, float] | None  # degrees, degrees, metres AMSL, of the ned origin
    R_body_gimbal: Array | None = None  # [3, 3]; None: the camera is fixed to the body
    clock_std_s: float = 0.0  # of the autopilot's stamps on our clock
    attitude_std_rad: float = 0.0  # about each axis, of an attitude that was gone on from by its rates
    axes_epoch: int = 0  # another number, other ned axes: the autopilot has begun anew, or its filter has
    origin_epoch: int = 0  # the same of ned's origin

    def camera(self, mount: Mount) -> Mount:
        """How the camera sits on the body now; on a gimbal, `mount` says how it sits on that."""
        if self.R_body_gimbal is None:
            return mount
        return Mount(self.R_body_gimbal @ mount.R_body_cam, mount.t_body_cam_m)


class TrackState(Enum):
    TENTATIVE = "tentative"
    CONFIRMED = "confirmed"
    COASTING = "coasting"


@dataclass(frozen=True)
class Track:
    """One target over time, at the last frame's exposure time."""

    track_id: int  # 0..max_targets-1; the topic's `tN`
    state: TrackState
    time_ns: int  # monotonic time the state is valid for
    measured_ns: int  # monotonic time of the last measurement in it: its age is what a receiver judges
    born_ns: int  # monotonic time of the first: a number is used again
    score: float
    box_xyxy_px: Array  # [4], where the target is, or should be, on the frame
    R_cam_target: Array  # [3, 3]
    t_cam_target_m: Array  # [3]
    covariance: Array  # [6, 6] in cam, as in Estimate
    R_ned_target: Array | None  # [3, 3]; None without own attitude
    t_ned_target_m: Array | None  # [3], from the ned origin, or from the own ship if its position is unknown
    v_ned_target_mps: Array | None  # [3]
    covariance_ned: Array | None  # [9, 9], (position, velocity, rotation) in ned


@dataclass(frozen=True)
class Report:
    """All that leaves the daemon for one frame."""

    meta: FrameMeta
    K: Array
    image_size_wh: tuple[int, int]
    tracks: tuple[Track, ...]
    own_ship: OwnShip | None  # at meta.capture_ns; None: no attitude, tracks are in `cam` only
    model_sha256: str
    chosen_id: int | None = None  # track_id of the target that a person pointed at
    distortion: tuple[float, ...] = ()  # of the frame's lens, as Frame has it
