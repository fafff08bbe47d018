"""The data types of the pipeline: Frame → Estimate → Track → Report. Each states its frames and units."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.estimator.own_parts import OwnParts

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameMeta:
    """Identity and timing of a frame; all times on the monotonic clock."""

    sequence: int  # counts the source's frames, without suppressed repeats: a gap means dropped frames
    capture_ns: int  # exposure time
    arrival_ns: int  # when the pixels were in memory
    time_jumps: int = 0  # number of jumps of the camera's timestamps so far


@dataclass(frozen=True)
class Frame:
    """One image as the camera delivered it, with the intrinsics and lens distortion of exactly these pixels."""

    meta: FrameMeta
    image_bgr: NDArray[np.uint8]  # [H, W, 3]
    K: Array  # [3, 3], pixel centres at integers
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]] (plumb bob); empty: a pinhole camera
    up_cam: Array | None = None  # [3], unit vector upwards in `cam`; None: unknown, taken for the top of the picture
    own_parts: OwnParts | None = None  # of the own aircraft, that are painted over in the image; None: nothing is

    @property
    def size_wh(self) -> tuple[int, int]:
        return self.image_bgr.shape[1], self.image_bgr.shape[0]


@dataclass(frozen=True)
class CameraInfo:
    """Properties of a camera that are known before its first frame."""

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
    # How many times as large as the given size it appears to be, where that contradicts it. None: it does not, or no
    # size is given.
    oversize: float | None = None


@dataclass(frozen=True)
class Mount:
    """Camera pose on the vehicle."""

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
    clock_std_s: float = 0.0  # of the autopilot's timestamps converted to our clock
    attitude_std_rad: float = 0.0  # about each axis, of an extrapolated or interpolated attitude
    axes_epoch: int = 0  # changes when the ned axes may have changed: the autopilot or its estimator was reset
    origin_epoch: int = 0  # the same for the ned origin

    def camera(self, mount: Mount) -> Mount:
        """Camera pose on the body at this instant; of `mount`, a gimbal only changes the rotation."""
        if self.R_body_gimbal is None:
            return mount
        return Mount(self.R_body_gimbal @ mount.R_body_cam, mount.t_body_cam_m)


PROBABLE_SCORE = 0.8  # of a track; below: what looks like an aircraft in one frame and not in the next, mostly a bird


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
    measured_ns: int  # monotonic time of the last measurement in it; receivers judge a track by its age
    born_ns: int  # monotonic time of the first measurement; tells tracks apart, as track_id is reused
    score: float  # probability that it is a target: mean of its recent frames' scores
    box_xyxy_px: Array  # [4], the target's box on the frame, measured or predicted
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
    chosen_id: int | None = None  # track_id of the target that the operator selected
    distortion: tuple[float, ...] = ()  # of the frame's lens, as in Frame
    doubtful_below: float = PROBABLE_SCORE  # score of a track; 0 if the model's scores are no probabilities
