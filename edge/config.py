"""The typed configuration tree: one TOML file, unknown keys rejected, every field described.

Paths are relative to the file's folder. `uavpose-edge check --config FILE` validates one.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, ValidationError, model_validator

from edge.config_camera import CameraSettings, Finite
from edge.config_camera import SequenceCamera as SequenceCamera
from edge.config_camera import camera_key as camera_key
from edge.config_estimator import SHIPPED_MODEL as SHIPPED_MODEL
from edge.config_estimator import EstimatorSettings, ModelSettings, TargetSettings
from edge.config_ground import RecorderSettings, ZenohSettings, ZenohTlsSettings
from edge.config_path import ConfigPath
from edge.config_ports import collision, mavlink_listener, metrics_listener, zenoh_listener
from edge.errors import InputError
from edge.links.mavlink_endpoints import parse_endpoint, plain_host
from edge.links.signing_key import load_key
from edge.types import Mount
from msgs.geometry import R_FORWARD_CAM, R_from_euler, nearest_rotation
from msgs.settings import Fault, Section, faults_of, parse_toml, read_text
from msgs.topics import check_uav_name

# For keys that are easily given another kind of value.
_WRONG_KINDS = ("string_type", "model_type", "model_attributes_type")
_EXAMPLES: dict[tuple[str, ...], str] = {
    ("camera", "device"): '"/dev/video0"',
    ("camera", "intrinsics"): '{ file = "camera.yaml" }',
}


def _signing_key(path: Path) -> Path:
    try:
        load_key(path)
    except InputError as error:
        raise ValueError(str(error)) from error
    return path


def _no_folder(path: Path) -> Path:
    if os.path.isdir(path):  # Path.is_dir raises if a parent folder may not be entered
        raise ValueError(f"{path} is a folder; give a file in it")
    return path


def _endpoint(text: str) -> str:
    parse_endpoint(text)
    return text


Endpoint = Annotated[str, AfterValidator(_endpoint)]
LeverM = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]  # larger values are surely millimetres


class VehicleSettings(Section):
    name: Annotated[str, AfterValidator(check_uav_name)] = Field(
        default="uav1", description="legal ROS name, first part of every topic"
    )


class MountSettings(Section):
    """Camera pose on the vehicle: three angles, or a matrix. All zero: along the nose, upright."""

    roll_deg: Finite = Field(default=0.0, description="about the optical axis; positive: the right of the image down")
    pitch_deg: Finite = Field(default=0.0, ge=-90, le=90, description="positive: optical axis above the nose")
    yaw_deg: Finite = Field(default=0.0, description="positive: optical axis to the right of the nose")
    R_body_cam: list[list[Finite]] | None = Field(
        default=None, description="3x3 rotation matrix from cam (optical) to body (FRD)"
    )
    t_body_cam_m: tuple[LeverM, LeverM, LeverM] = Field(
        default=(0.0, 0.0, 0.0), strict=False, description="camera position in body, metres, on a gimbal too"
    )

    @model_validator(mode="after")
    def _rotation(self) -> MountSettings:
        if self.R_body_cam is None:
            return self
        if {"roll_deg", "pitch_deg", "yaw_deg"} & self.model_fields_set:
            raise ValueError("give either the angles or R_body_cam, not both")
        if [len(row) for row in self.R_body_cam] != [3, 3, 3]:
            raise ValueError("R_body_cam takes three rows of three numbers")
        R = np.array(self.R_body_cam)
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
            raise ValueError("R_body_cam is not a rotation")
        return self

    def mount(self) -> Mount:
        """R_body_cam [3, 3], exactly orthonormal, and t_body_cam_m [3]."""
        if self.R_body_cam is not None:
            R_body_cam = nearest_rotation(self.R_body_cam)
        else:
            angles_rad = np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])
            R_body_cam = R_from_euler(*angles_rad) @ R_FORWARD_CAM
        return Mount(R_body_cam, np.array(self.t_body_cam_m))


class MavlinkSettings(Section):
    enabled: bool = Field(default=True, description="enable the MAVLink link to the autopilot")
    endpoints: list[Endpoint] = Field(
        default=["udpin:127.0.0.1:14550"],
        min_length=1,
        description="udpin, udpout, tcpin, tcpout:HOST:PORT or serial:DEVICE:BAUD, all used at the same time; in order "
        "of preference, the autopilot's own link first",
    )
    system_id: int | None = Field(
        default=None, ge=1, le=255, description="the vehicle's system id; default: taken from its heartbeat"
    )
    component_id: int = Field(
        default=191,
        ge=2,
        le=255,
        description="the daemon's component id; 191 is the onboard computer, 1 is the autopilot",
    )
    camera_component_id: int = Field(
        default=100, ge=2, le=255, description="the camera's component id; 100 is the first camera"
    )
    allowed_hosts: list[Annotated[str, AfterValidator(plain_host)]] = Field(
        default_factory=list,
        description="addresses accepted on udpin and tcpin; empty: the first that sends a valid autopilot heartbeat",
    )
    commanders: list[Annotated[int, Field(ge=1, le=255)]] = Field(
        default_factory=list, description="system ids whose commands are accepted; empty: all received on an endpoint"
    )
    signing_key: Annotated[ConfigPath, AfterValidator(_signing_key)] | None = Field(
        default=None,
        description="32-byte file from `uavpose-edge keygen`; all messages are signed, unsigned ones are rejected",
    )
    signing_state: Annotated[ConfigPath, AfterValidator(_no_folder)] | None = Field(
        default=None,
        description="file for the last signing timestamp; default: path of the key file plus .timestamp",
    )
    target_relative: bool = Field(default=True, description="send TARGET_RELATIVE (511) to autopilots other than PX4")
    target_relative_to_px4: bool = Field(
        default=False, description="also send it to PX4, where with VTE_EN=0 it is a landing target"
    )
    target_relative_rate_hz: float = Field(default=50.0, ge=0.1, le=50, description="maximum rate of TARGET_RELATIVE")
    tracking_rate_hz: float = Field(default=10.0, ge=5, le=20, description="rate of CAMERA_TRACKING_* messages")
    follow_target: bool = Field(default=False, description="send FOLLOW_TARGET from virtual_system_id")
    adsb_icao_address: int | None = Field(
        default=None,
        ge=1,
        le=0xFFFFFF - 3,
        description="send ADSB_VEHICLE with this ICAO address plus the target's number; the autopilot may avoid it",
    )
    virtual_system_id: int = Field(
        default=200, ge=1, le=255, description="system id of the target in FOLLOW_TARGET and ADSB_VEHICLE"
    )
    onboard_computer_status: bool = Field(default=False, description="send ONBOARD_COMPUTER_STATUS once a second")
    sensor_width_mm: float | None = Field(
        default=None,
        gt=0,
        le=100,
        description="width of the sensor area that forms the image; needed for the focal length in CAMERA_INFORMATION",
    )
    gimbal_component_id: int | None = Field(
        default=None,
        ge=1,
        le=255,
        description="source of the camera's gimbal attitude: a component id, or 1 to 6 for a gimbal whose attitude "
        "the autopilot sends; default: the first received",
    )
    attitude_rate_hz: float = Field(
        default=50.0,
        ge=7,
        le=400,
        description="requested from the autopilot; lower rates could not be used for any frame",
    )
    position_rate_hz: float = Field(
        default=20.0,
        ge=3,
        le=100,
        description="requested from the autopilot; lower rates could not be used for any frame",
    )
    max_age_ms: float = Field(default=200.0, gt=0, le=10_000, description="maximum age of a measurement to be sent")

    @model_validator(mode="after")
    def _fits_together(self) -> MavlinkSettings:
        # A serial port can be opened once, whatever the speed.
        places = [text.rpartition(":")[0] if text.startswith("serial:") else text for text in self.endpoints]
        twice = [place for place in places if places.count(place) > 1 and not place.endswith(":0")]
        if twice:
            raise ValueError(f"endpoints: {twice[0]} is there twice")
        if self.component_id == self.camera_component_id:
            raise ValueError("component_id and camera_component_id must differ")
        if self.system_id == self.virtual_system_id:
            raise ValueError("virtual_system_id must not be the vehicle's system_id")
        if self.signing_state is not None and self.signing_key is None:
            raise ValueError("signing_state needs signing_key")
        return self


class HealthSettings(Section):
    no_frame_s: float = Field(
        default=2.0,
        ge=0.2,
        le=60,
        description="time without a frame after which the state is FAULT; before the first frame at least 10 s",
    )
    latency_max_ms: float | None = Field(
        default=None,
        gt=0,
        le=10_000,
        description="state DEGRADED if the p95 latency from exposure to the links exceeds this; default: no limit",
    )
    loop_stuck_s: float = Field(
        default=5.0,
        ge=1,
        le=7,
        description="if the main loop is stuck for this long, the process ends and logs where; with a longer time, the "
        "unit's WatchdogSec=15 would end it first, without a log entry",
    )
    prometheus_port: int | None = Field(
        default=None, ge=1, le=65535, description="serve Prometheus metrics on this port of 127.0.0.1"
    )


class Config(Section):
    vehicle: VehicleSettings = VehicleSettings()
    camera: CameraSettings
    mount: MountSettings = MountSettings()
    model: ModelSettings = ModelSettings()
    target: TargetSettings = TargetSettings()
    estimator: EstimatorSettings = EstimatorSettings()
    zenoh: ZenohSettings = ZenohSettings()
    # The default is validated too, so that it is relative to the file's folder.
    recorder: RecorderSettings = Field(default_factory=dict, validate_default=True)
    mavlink: MavlinkSettings = MavlinkSettings()
    health: HealthSettings = HealthSettings()

    @model_validator(mode="after")
    def _gimbal_is_heard(self) -> Config:
        if self.camera.mount == "gimbal" and not self.mavlink.enabled:
            raise ValueError('[camera] mount = "gimbal" needs [mavlink]: the gimbal\'s attitude comes by it')
        if self.camera.mount == "fixed" and self.mavlink.gimbal_component_id is not None:
            raise ValueError('[mavlink] gimbal_component_id needs [camera] mount = "gimbal": else none is heard')
        return self

    @model_validator(mode="after")
    def _ports_are_free_of_each_other(self) -> Config:
        zenoh = [zenoh_listener(endpoint) for endpoint in self.zenoh.listen if self.zenoh.enabled]
        mavlink = [mavlink_listener(endpoint) for endpoint in self.mavlink.endpoints if self.mavlink.enabled]
        port = self.health.prometheus_port
        refused = collision([*zenoh, *mavlink, None if port is None else metrics_listener(port)])
        if refused is not None:
            raise ValueError(refused)
        return self


@dataclass(frozen=True)
class ConfigFile:
    """A configuration and its source, so that an error can name file, line and key."""

    path: Path
    text: str
    config: Config
    contents: Mapping[str, str] = field(default_factory=dict)  # by `[section] key`, a hash of the files named there

    @contextmanager
    def blame(self, *key: str) -> Iterator[None]:
        """Attribute errors raised inside to this key, unless they name their own: blame("model", "path")."""
        try:
            yield
        except InputError as error:
            raise InputError(_sentence(self.path, self.text, error.key or key, str(error))) from error


def load_config(path: Path) -> ConfigFile:
    """Read and validate a TOML file. Raises InputError with one line per fault, each naming file, line and key."""
    text = read_text(path, InputError)
    tree = parse_toml(text, path, InputError)
    try:
        config = Config.model_validate(tree, context={"folder": path.resolve().parent})
    except ValidationError as error:
        lines = [_sentence(path, text, _key(fault), _reason(fault)) for fault in faults_of(error)]
        raise InputError("\n".join(lines)) from error
    return ConfigFile(path, text, config, _contents(config))


def _contents(config: Config) -> dict[str, str]:
    """Hashes of the files that are read only once, at the start; unreadable ones are reported where they are used."""
    intrinsics, camera_tls = getattr(config.camera, "intrinsics", None), getattr(config.camera, "tls", None)
    files = {
        "[camera] intrinsics": (intrinsics.file,) if intrinsics is not None else (),
        "[camera] tls": _paths(camera_tls),
        "[camera] own_ship_mask": (config.camera.own_ship_mask,),
        "[zenoh] tls": _paths(config.zenoh.tls),
        "[mavlink] signing_key": (config.mavlink.signing_key,),
    }
    hashes: dict[str, str] = {}
    for key, paths in files.items():
        with suppress(OSError):
            held = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path is not None]
            hashes[key] = " ".join(held)
    return hashes


def _paths(tls: ZenohTlsSettings | None) -> tuple[Path, ...]:
    return () if tls is None else (tls.root_ca, tls.certificate, tls.private_key)


def _key(fault: Fault) -> tuple[str, ...]:
    parts = [str(part) for part in fault.location]
    if parts[:1] == ["camera"] and len(parts) > 1:
        parts = parts[:1] + parts[2:]  # pydantic inserts the selected type there
    return tuple(parts)


def _reason(fault: Fault) -> str:
    if fault.type == "union_tag_not_found":
        return "needs type = one of 'sequence', 'folder', 'file', 'device', 'stream', 'zenoh'"
    if fault.type == "union_tag_invalid":
        return f"type must be one of {fault.context['expected_tags']}"
    example = _EXAMPLES.get(_key(fault)) if fault.type in _WRONG_KINDS else None
    return f"{fault.reason}, such as {example}" if example else fault.reason


def _sentence(path: Path, text: str, key: tuple[str, ...], reason: str) -> str:
    line = _line_of(text, key)
    place = f"{path}:{line}" if line else f"{path}"
    words = list(key)
    indices = [words.pop() for _ in range(len(words)) if words and words[-1].isdigit()]
    table = f"[{'.'.join(words[:-1] or words)}]" if words else "the file"
    name = f"{table} {words[-1]}" if len(words) > 1 else table
    index = "".join(f"[{i}]" for i in reversed(indices))
    return f"{place}: {name}{index}: {reason}"


def _line_of(text: str, key: tuple[str, ...]) -> int | None:
    """Line of the key's assignment, else of its table (inline or header), else None (the key is missing)."""
    section: tuple[str, ...] = ()
    table_line = None
    words = tuple(word for word in key if not word.isdigit())
    for number, line in enumerate(text.splitlines(), start=1):
        header = re.match(r"\s*\[\s*([A-Za-z][^\[\]]*)\]", line)  # a row of numbers belongs to a matrix
        if header:
            section = tuple(part.strip() for part in header[1].split("."))
            if section == words[: len(section)]:
                table_line = number
        assignment = re.match(r"\s*([\w.-]+)\s*=", line)
        if assignment is None:
            continue
        assigned = section + tuple(assignment[1].split("."))
        if assigned == words:
            return number
        if assigned == words[: len(assigned)]:
            table_line = number
    return table_line
