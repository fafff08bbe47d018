"""The sections for output to the ground and to disk: [zenoh] and [recorder]."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from edge.config_path import ConfigPath
from msgs.recording_store import RecordingLimits
from msgs.session import TlsFiles, check_endpoint
from msgs.settings import Section

_MB = 1_000_000
DISK_MAX_MB = 1e9  # a petabyte
SELDOM_HZ = 0.001


def _seldom_or_never(hz: float) -> float:
    if 0 < hz < SELDOM_HZ:
        raise ValueError(f"is 0, for none, or at least {SELDOM_HZ:g}")
    return hz


RateOrNone = Annotated[float, AfterValidator(_seldom_or_never)]


class ZenohTlsSettings(Section):
    root_ca: ConfigPath = Field(description="CA certificate that signed the certificates of both ends, PEM")
    certificate: ConfigPath = Field(description="the vehicle's certificate, PEM; its common name is the vehicle's name")
    private_key: ConfigPath = Field(description="the vehicle's private key, PEM, mode 0600")

    def files(self) -> TlsFiles:
        return TlsFiles(self.root_ca, self.certificate, self.private_key)

    @model_validator(mode="after")
    def _do(self) -> ZenohTlsSettings:
        # Validity dates are not checked: a computer without a clock must be able to fly before it knows the time.
        self.files().check()
        return self


class ZenohSettings(Section):
    enabled: bool = Field(default=True, description="publish over zenoh")
    listen: list[str] = Field(default=["tcp/127.0.0.1:7448"], description="endpoints to listen on, for tools on board")
    connect: list[str] = Field(
        default_factory=list, description="endpoints of the ground, e.g. quic/HOST:7447; retried indefinitely"
    )
    tls: ZenohTlsSettings | None = Field(default=None, description="certificates, for tls/ and quic/ endpoints")
    pose_rate_max_hz: float | None = Field(
        default=None,
        ge=0.1,
        le=240,
        description="maximum rate of each target's poses, odometry and directions on tls/ and quic/ links; best a "
        "whole fraction of the frame rate, which is then delivered; default: unlimited",
    )
    image_max_hz: RateOrNone = Field(
        default=1.0,
        ge=0,
        le=10,
        description="maximum rate of live images, sent only to subscribers, never on tls/ and quic/ links; 0: none",
    )
    commands: bool = Field(default=True, description="accept commands: track, stop, select, record, rate, reload")
    domain: int = Field(default=0, ge=0, le=232, description="ROS domain, first chunk of every zenoh key")
    ros_distribution: Literal["jazzy", "humble", "off"] = Field(
        default="jazzy", description="ROS distribution that keys and type hashes follow"
    )
    max_age_ms: float = Field(
        default=500.0, gt=0, le=10_000, description="maximum age of a measurement to be published as a pose"
    )

    @model_validator(mode="after")
    def _endpoints_do(self) -> ZenohSettings:
        for key in ("listen", "connect"):
            endpoints = getattr(self, key)
            if twice := [endpoint for endpoint in endpoints if endpoints.count(endpoint) > 1]:
                raise ValueError(f"{key}: {twice[0]} is there twice")
            for endpoint in endpoints:
                try:
                    check_endpoint(endpoint, tls=self.tls is not None)
                except ValueError as error:
                    raise ValueError(f"{key}: {error}") from error
        return self

    def unheard(self, vehicle: str) -> str | None:
        """Why the ground may hear nothing of a vehicle of this name although the link is up, as a sentence."""
        return self.tls.files().another_than(vehicle) if self.enabled and self.tls and self.connect else None


class RecorderSettings(Section):
    """Records what is published to the ground, as MCAP on disk; also works with zenoh disabled."""

    enabled: bool = Field(default=False, description="record from startup")
    folder: ConfigPath = Field(default=Path("recordings"), validate_default=True, description="created if missing")
    image_max_hz: RateOrNone = Field(
        default=0.0,
        ge=0,
        le=240,
        description="maximum rate of recorded images, needed to replay the recording; 0: none",
    )
    file_max_mb: float = Field(default=256.0, ge=1, le=16_000, description="limit at which the next file begins")
    file_max_minutes: float = Field(default=10.0, gt=0, le=1440, description="limit at which the next file begins")
    total_max_mb: float | None = Field(
        default=None,
        gt=0,
        le=DISK_MAX_MB,
        description="limit for all files of this vehicle, at least twice file_max_mb; default: the disk's size",
    )
    free_min_mb: float = Field(default=1000.0, ge=0, le=DISK_MAX_MB, description="free disk space to leave")
    when_full: Literal["oldest", "stop"] = Field(
        default="oldest", description="remove the oldest files, or stop recording"
    )

    @model_validator(mode="after")
    def _room_for_two(self) -> RecorderSettings:
        if self.total_max_mb is not None and self.total_max_mb < 2 * self.file_max_mb:
            raise ValueError("total_max_mb must hold two files of file_max_mb, or nothing is left when one begins")
        return self

    def limits(self) -> RecordingLimits:
        return RecordingLimits(
            file_bytes_max=round(self.file_max_mb * _MB),
            file_seconds_max=60.0 * self.file_max_minutes,
            total_bytes_max=None if self.total_max_mb is None else round(self.total_max_mb * _MB),
            free_bytes_min=round(self.free_min_mb * _MB),
            when_full=self.when_full,
        )
