"""A video with telemetry as a scene, described by a TOML file."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from pydantic import Field, ValidationError

from edge.cameras.file import VideoTimes, tells_times
from edge.cameras.intrinsics import load_intrinsics
from edge.cameras.video import grab_next, open_video
from edge.config import MountSettings
from edge.config_camera import IntrinsicsSettings, ReadoutMs
from edge.config_path import ConfigPath
from edge.errors import InputError
from msgs.settings import Section, dotted, faults_of, read_toml
from sim_replay.bop.write import SceneWriter
from sim_replay.ground_truth import check_spans
from sim_replay.recorded.scene_files import JPEG_QUALITY, add_picture, write_sequence_toml
from sim_replay.telemetry import Telemetry, TelemetryError, read_telemetry

FPS_MAX = 240.0  # of the daemon's camera
STEADY_FRAMES = 0.5  # largest deviation of an image from a constant rate
ROWS_HZ_MIN = 9.5  # of nominally 10 Hz telemetry: between its rows the own ship is assumed to turn evenly


class FilmedFlight(Section):
    """A video, and how its camera was carried; paths are relative to the file's folder."""

    video: ConfigPath = Field(description="what ffmpeg reads, of a constant rate")
    telemetry: ConfigPath = Field(description="CSV of the own ship, as telemetry.csv has it")
    t0_ns: int = Field(default=0, description="exposure of the first picture on the telemetry's clock")
    fps: float | None = Field(default=None, gt=0, le=FPS_MAX, description="pictures a second; default: the video's own")
    intrinsics: IntrinsicsSettings
    readout_ms: ReadoutMs = Field(default=0.0, description="as in the daemon's [camera]")
    own_ship_mask: ConfigPath | None = Field(default=None, description="as in the daemon's [camera]")
    mount: MountSettings = Field(default_factory=MountSettings)


def read_filmed_flight(path: Path) -> FilmedFlight:
    """Raises InputError: one line per error, each naming file and key."""
    try:
        return FilmedFlight.model_validate(read_toml(path, InputError), context={"folder": path.parent})
    except ValidationError as error:
        told = (f"{path}: {dotted(fault.location)}: {fault.reason}" for fault in faults_of(error))
        raise InputError("\n".join(told)) from error


def unpack_video(path: Path, folder: Path, on_picture: Callable[[], None]) -> None:
    """Convert the flight described by the TOML file at `path` to a scene. Raises InputError, OSError."""
    flight = read_filmed_flight(path)
    try:
        telemetry = read_telemetry(flight.telemetry)
    except TelemetryError as error:
        raise InputError(str(error)) from error
    rows_hz = 1e9 / float(np.median(np.diff(telemetry.t_ns)))
    if rows_hz < ROWS_HZ_MIN:
        raise InputError(f"{flight.telemetry}: has {rows_hz:.1f} rows a second; 10 are needed")
    if not flight.video.is_file():
        raise InputError(f"{path}: video: {flight.video} does not exist")
    if flight.own_ship_mask is not None and not flight.own_ship_mask.is_file():
        raise InputError(f"{path}: own_ship_mask: {flight.own_ship_mask} does not exist")
    capture = open_video(str(flight.video))
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: video: {flight.video} is not a readable video")
        fps = flight.fps or capture.get(cv2.CAP_PROP_FPS)
        told = flight.fps is not None or tells_times(flight.video)  # otherwise the rate is a guess of ffmpeg's
        if not told or not math.isfinite(fps) or not 0 < fps <= FPS_MAX:
            raise InputError(f"{path}: fps: is missing, and {flight.video} does not say it")
        first_ns = _unpack(capture, path, flight, telemetry, fps, folder, on_picture)
    finally:
        capture.release()
    shutil.copyfile(flight.telemetry, folder / "telemetry.csv")
    camera: dict[str, object] = {"readout_ms": flight.readout_ms}
    if flight.own_ship_mask is not None:
        camera["own_ship_mask"] = f"own_ship_mask{flight.own_ship_mask.suffix}"
        shutil.copyfile(flight.own_ship_mask, folder / str(camera["own_ship_mask"]))
    mount = flight.mount.mount()
    write_sequence_toml(folder, flight.video, fps, flight.t0_ns + first_ns, mount, False, camera)


def _unpack(
    capture: cv2.VideoCapture,
    path: Path,
    flight: FilmedFlight,
    telemetry: Telemetry,
    fps: float,
    folder: Path,
    on_picture: Callable[[], None],
) -> int:
    """Returns the time in the video of its first picture that can be decoded, ns."""
    size_wh = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    try:
        lens = load_intrinsics(flight.intrinsics).scaled_to(size_wh)
    except InputError as error:
        raise InputError(f"{path}: intrinsics: {error}") from error
    first_ns, times = None, VideoTimes(fps)
    with SceneWriter(folder, JPEG_QUALITY) as writer:
        while (undecodable := grab_next(capture)) is not None:
            times.take(round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6), undecodable)
            off_ns = abs(times.last_ns - times.index * 1e9 / fps)
            if flight.fps is None and off_ns > STEADY_FRAMES * 1e9 / fps:
                raise InputError(
                    f"{path}: video: {flight.video} is of a rate that varies: picture {times.index} was taken "
                    f"{off_ns / 1e9:.2f} s off {fps:g} a second; make one of a constant rate of it"
                )
            # One by one: where a file does not say how many pictures it has, ffmpeg guesses it from its duration, which
            # may count from long before the first one, or to the end of the sound.
            check_spans(telemetry, flight.telemetry, flight.t0_ns, times.index + 1, fps)
            read, image_bgr = capture.retrieve()
            if not read:
                continue
            add_picture(writer, times.index, np.asarray(image_bgr, dtype=np.uint8), lens.K, lens.distortion)
            first_ns = times.last_ns if first_ns is None else first_ns
            on_picture()
    if first_ns is None:
        raise InputError(f"{path}: video: {flight.video} has no readable picture")
    return first_ns
