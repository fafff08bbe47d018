"""The section [camera], with one type for each kind of source, and the intrinsics."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from edge.config_ground import ZenohTlsSettings
from edge.config_path import ConfigPath
from msgs.session import check_endpoint
from msgs.settings import Section

SIDE_MAX_PX = 65_535  # JPEG's limit; larger images would need more memory than any machine has
MONOTONIC_MAX_NS = 10**18  # 31 years since boot: a larger value is UTC

PositivePx = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
ReadoutMs = Annotated[float, Field(ge=-200, le=200)]
Side = Annotated[int, Field(gt=0, le=SIDE_MAX_PX)]


def _network_address(text: str) -> str:
    # The error does not contain the address, in which there may be a password.
    scheme = re.match(r"([a-z][a-z0-9+.-]*)://.", text)  # ffmpeg knows none in capitals
    if scheme is None or scheme[1] == "file":
        raise ValueError('is no network address such as rtsp://HOST/PATH or udp://HOST:PORT; a video is type = "file"')
    return text


def _topic(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*", text):
        raise ValueError(f"{text!r} is no ROS topic without its first slash, such as camera/image/compressed")
    return text


def _own_machine(text: str) -> str:
    if not re.fullmatch(r"(127\.0\.0\.1|localhost):[1-9][0-9]{0,4}", text):
        raise ValueError(f"{text!r} is neither 127.0.0.1:PORT nor localhost:PORT; the player runs on the same machine")
    return text


def _device(text: str) -> str:
    if not text.startswith("/"):
        raise ValueError(f"{text!r} is no device such as /dev/video0")
    return text


class IntrinsicsSettings(Section):
    """Either `file`, or the values themselves."""

    file: ConfigPath | None = Field(
        default=None, description="calibration YAML as written by ROS camera_info or OpenCV"
    )
    fx: PositivePx | None = Field(default=None, description="focal length along x, pixels")
    fy: PositivePx | None = Field(default=None, description="focal length along y, pixels")
    cx: Finite | None = Field(default=None, description="principal point x, pixels; pixel centres at integers")
    cy: Finite | None = Field(default=None, description="principal point y, pixels; pixel centres at integers")
    width: Side | None = Field(default=None, description="width of the calibration images, pixels")
    height: Side | None = Field(default=None, description="height of the calibration images, pixels")
    distortion: list[Finite] = Field(
        default_factory=list,
        description="4, 5 or 8 coefficients k1 k2 p1 p2 k3 k4 k5 k6, as OpenCV's; empty: no distortion",
    )

    @model_validator(mode="after")
    def _one_way(self) -> IntrinsicsSettings:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.width, self.height)
        if self.file is not None and (self.distortion or any(n is not None for n in numbers)):
            raise ValueError("give either file or fx fy cx cy width height, not both")
        if self.file is None and any(n is None for n in numbers):
            raise ValueError("needs file, or all of fx fy cx cy width height")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError("distortion takes 4, 5 or 8 coefficients, or none")
        return self


class Camera(Section):
    mount: Literal["fixed", "gimbal"] = Field(
        default="fixed",
        description="gimbal: [mount] turns the camera on the gimbal, whose attitude comes over MAVLink",
    )
    readout_ms: ReadoutMs = Field(
        default=0.0,
        description="rolling shutter: from the first row's exposure to the last one's, milliseconds; negative: the "
        "last comes first; 0: global shutter",
    )
    own_ship_mask: ConfigPath | None = Field(
        default=None,
        description="picture of the same shape, white where the own aircraft is seen, which is painted over; default: "
        "nothing is",
    )


class SequenceCamera(Camera):
    type: Literal["sequence"]
    path: ConfigPath = Field(description="BOP scene folder (rgb/, scene_camera.json)")
    fps: float = Field(default=30.0, ge=0.01, le=240, description="frames per second")
    start_at_ns: int | None = Field(
        default=None,
        le=MONOTONIC_MAX_NS,
        description="exposure of frame 0, ns of the monotonic clock; default: when everything is ready",
    )
    loop: bool = Field(default=False, description="restart after the last frame")
    lockstep: Annotated[str, AfterValidator(_own_machine)] | None = Field(
        default=None,
        description="HOST:PORT of the player that controls the frames and the daemon's clock; not for flight",
    )
    intrinsics: IntrinsicsSettings | None = Field(
        default=None, description="replaces the intrinsics in scene_camera.json"
    )


class FolderCamera(Camera):
    type: Literal["folder"]
    path: ConfigPath = Field(description="folder of images, played in the order of their names")
    fps: float = Field(default=30.0, ge=0.01, le=240, description="frames per second")
    start_at_ns: int | None = Field(
        default=None,
        le=MONOTONIC_MAX_NS,
        description="exposure of the first image, ns of the monotonic clock; default: when everything is ready",
    )
    loop: bool = Field(default=False, description="restart after the last image")
    intrinsics: IntrinsicsSettings


class FileCamera(Camera):
    type: Literal["file"]
    path: ConfigPath = Field(description="video file, played by its own timestamps")
    intrinsics: IntrinsicsSettings


class DeviceCamera(Camera):
    type: Literal["device"]
    device: Annotated[str, AfterValidator(_device)] = Field(default="/dev/video0", description="V4L2 device")
    width: Side = Field(default=1920, description="requested from the device, pixels")
    height: Side = Field(default=1080, description="requested from the device, pixels")
    fps: float = Field(default=30.0, ge=0.01, le=1000, description="requested from the device, frames per second")
    fourcc: str = Field(
        default="MJPG", min_length=4, max_length=4, description="pixel format requested from the device"
    )
    exposure_ms: float | None = Field(
        default=None, gt=0, le=1000, description="fixed exposure time, if the driver supports it; default: unchanged"
    )
    latency_ms: float = Field(
        default=0.0, ge=0, le=1000, description="measured time from exposure to the driver's timestamp, milliseconds"
    )
    intrinsics: IntrinsicsSettings


class StreamCamera(Camera):
    type: Literal["stream"]
    url: Annotated[str, AfterValidator(_network_address)] = Field(
        description="RTSP, HTTP or UDP address, in ffmpeg syntax"
    )
    rtsp_transport: Literal["tcp", "udp"] = Field(default="tcp", description="transport of RTSP images")
    latency_ms: float = Field(
        default=0.0, ge=0, le=5000, description="measured minimum time from exposure to arrival, milliseconds"
    )
    intrinsics: IntrinsicsSettings


class ZenohCamera(Camera):
    type: Literal["zenoh"]
    topic: Annotated[str, AfterValidator(_topic)] = Field(
        description="ROS topic of type sensor_msgs/CompressedImage, without the leading slash"
    )
    connect: str = Field(default="tcp/127.0.0.1:7447", description="endpoint of the router or publisher")
    domain: int = Field(default=0, ge=0, le=232, description="ROS domain, first chunk of the zenoh key")
    tls: ZenohTlsSettings | None = Field(default=None, description="certificates, for tls/ and quic/ endpoints")
    latency_ms: float = Field(
        default=0.0, ge=0, le=5000, description="measured time from exposure to the header's timestamp, milliseconds"
    )
    intrinsics: IntrinsicsSettings

    @model_validator(mode="after")
    def _endpoint_does(self) -> ZenohCamera:
        check_endpoint(self.connect, tls=self.tls is not None)
        return self


CameraSettings = Annotated[
    SequenceCamera | FolderCamera | FileCamera | DeviceCamera | StreamCamera | ZenohCamera,
    Field(discriminator="type", description="source of the frames"),
]


def camera_key(camera: CameraSettings) -> tuple[str, str]:
    """The key that names the source of a camera's frames."""
    return "camera", {"stream": "url", "device": "device", "zenoh": "topic"}.get(camera.type, "path")
