"""A camera's effects on an image: lens blur, motion, mosaic, noise, exposure, colour, sharpening, compression."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_replay.render.motion import motion_kernel

Quality = Literal["good", "ordinary", "poor"]
_NOISE_VALUES = 2**23
_BAYER_MIN_SCALE = 0.95  # below it, each pixel of the image averages several of the mosaic


@dataclass(frozen=True)
class Sensor:
    """Lengths are in pixels of the native frame; levels are shares of full scale, with gamma 2."""

    blur_sigma_px: float
    motion_px: tuple[float, float]
    gain: float
    contrast: float
    saturation: float
    cast_bgr: tuple[float, float, float]
    noise: float  # gamma 2 makes shot noise independent of the level
    read_noise: float  # visible in the dark
    jpeg_quality: int | None
    sharpening: float = 0.0  # strength of the unsharp mask, 0: none
    mosaic: bool = False  # one colour per pixel, interpolated, as behind a Bayer filter
    drift: float = 0.0  # how far exposure varies from frame to frame, share of the gain


@dataclass(frozen=True)
class _Ranges:
    """Ranges for each quality; shares are of the cameras that have the defect."""

    blur_px: tuple[float, float]
    soft_share: float
    motion_share: float
    noise: tuple[float, float]
    read_noise: tuple[float, float]
    jpeg_share: float
    jpeg: tuple[int, int]
    drift: tuple[float, float]


_QUALITIES: dict[Quality, _Ranges] = {
    "good": _Ranges((0.4, 0.8), 0.0, 0.1, (0.002, 0.007), (0.0, 0.004), 0.1, (85, 96), (0.0, 0.01)),
    "ordinary": _Ranges((0.4, 1.0), 0.13, 0.33, (0.003, 0.02), (0.0, 0.01), 0.45, (50, 96), (0.0, 0.04)),
    "poor": _Ranges((0.7, 1.6), 0.35, 0.5, (0.012, 0.045), (0.005, 0.03), 0.85, (18, 60), (0.03, 0.12)),
}


def sensor_from(rng: np.random.Generator, quality: Quality = "ordinary") -> Sensor:
    """A random camera of that quality."""
    ranges = _QUALITIES[quality]
    angle, moved = rng.uniform(0, np.pi), rng.uniform(0.5, 5.0) * (rng.random() < ranges.motion_share)
    grey = rng.random() < 0.07
    soft = rng.random() < ranges.soft_share
    return Sensor(
        blur_sigma_px=float(rng.uniform(ranges.blur_px[1], 2.2) if soft else rng.uniform(*ranges.blur_px)),
        motion_px=(float(moved * np.cos(angle)), float(moved * np.sin(angle))),
        gain=float(np.exp(rng.normal(0.0, 0.16))),
        contrast=float(rng.uniform(0.75, 1.25)),
        saturation=0.0 if grey else float(rng.uniform(0.5, 1.25)),
        cast_bgr=tuple(float(c) for c in 1.0 + (0.0 if grey else 0.05) * rng.normal(size=3)),  # type: ignore[arg-type]
        noise=float(np.exp(rng.uniform(*np.log(ranges.noise)))),
        read_noise=float(rng.uniform(*ranges.read_noise)),
        jpeg_quality=int(rng.integers(*ranges.jpeg)) if rng.random() < ranges.jpeg_share else None,
        sharpening=float(rng.uniform(0.2, 0.9)) if rng.random() < 0.4 else 0.0,
        mosaic=bool(rng.random() < 0.8),
        drift=float(rng.uniform(*ranges.drift)),
    )


def drifted(sensor: Sensor, seed: int, frame_index: int) -> Sensor:
    """The sensor with the gain that its exposure control has drifted to by that frame."""
    rng = np.random.default_rng([seed, 0xE8])
    period_frames, phase = rng.uniform(40.0, 150.0, 2) / [1.0, 3.0], rng.uniform(0.0, 2.0 * np.pi, 2)
    wave = np.sin(2.0 * np.pi * frame_index / period_frames + phase) @ [0.7, 0.3]
    return replace(sensor, gain=sensor.gain * (1.0 + sensor.drift * float(wave)))


@cache
def _noise_values() -> NDArray[np.float32]:
    return np.random.default_rng(0x401E).standard_normal(_NOISE_VALUES, dtype=np.float32)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Standard normal noise: a slice of a fixed table from a random place, which is far faster than sampling."""
    count = int(np.prod(shape))
    if count > _NOISE_VALUES - 2**16:
        return rng.standard_normal(shape, dtype=np.float32)
    start = int(rng.integers(_NOISE_VALUES - count))
    return _noise_values()[start : start + count].reshape(shape)


def _mosaic(image_bgr: Any) -> NDArray[np.uint8]:
    """Value of each photosite [H, W]: blue and green in even rows, green and red in odd ones."""
    raw = np.array(image_bgr[..., 1])
    raw[::2, ::2] = image_bgr[::2, ::2, 0]
    raw[1::2, 1::2] = image_bgr[1::2, 1::2, 2]
    return raw


def _with_noise(image: Any, sensor: Sensor, scale: float, rng: np.random.Generator) -> Any:
    # Averaging native pixels into one averages their noise, less than ideally because demosaicing correlates it.
    share = max(scale, 0.35)
    level = np.linspace(0.0, 1.0, 256)
    sigma = (255.0 * share * (sensor.noise + sensor.read_noise * np.square(1.0 - level))).astype(np.float32)
    return cv2.add(image, cv2.multiply(cv2.LUT(image, sigma), _noise(image.shape, rng)), dtype=cv2.CV_8U)


def _colour_map(sensor: Sensor) -> NDArray[np.float32]:
    """Saturation, colour cast, gain and contrast as one affine map [3, 4] of the three channels, 0..255."""
    luma = np.tile(np.array([0.114, 0.587, 0.299]), (3, 1))
    mix = (sensor.saturation * np.eye(3) + (1 - sensor.saturation) * luma) * np.asarray(sensor.cast_bgr)[:, None]
    lift = np.full((3, 1), 255.0 * 0.45 * (1 - sensor.contrast))
    return np.hstack([sensor.contrast * sensor.gain * mix, lift]).astype(np.float32)


def exposed(image_bgr: NDArray[np.uint8], sensor: Sensor, scale: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image [H, W, 3] as this camera would deliver it; `scale` is image pixels per native pixel, at most 1."""
    image: Any = image_bgr
    sigma = sensor.blur_sigma_px * scale
    if sigma > 0.2:
        image = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    kernel = motion_kernel((sensor.motion_px[0] * scale, sensor.motion_px[1] * scale))
    if kernel is not None:
        image = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    if sensor.mosaic and scale >= _BAYER_MIN_SCALE:
        # OpenCV names a mosaic by the second row's second and third photosite: this one is its RG.
        image = cv2.cvtColor(_with_noise(_mosaic(image), sensor, scale, rng), cv2.COLOR_BayerRG2BGR)
    else:
        image = _with_noise(np.ascontiguousarray(image), sensor, scale, rng)
    image = cv2.transform(image, _colour_map(sensor))
    if sensor.sharpening > 0.0 and scale > 0.6:
        soft = cv2.GaussianBlur(image, (0, 0), 1.2, borderType=cv2.BORDER_REPLICATE)
        image = cv2.addWeighted(image, 1.0 + sensor.sharpening, soft, -sensor.sharpening, 0.0)
    if sensor.jpeg_quality is not None:
        quality = sensor.jpeg_quality if scale > 0.6 else max(sensor.jpeg_quality, 60)
        image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    return np.asarray(image, dtype=np.uint8)


def exposed_frame(
    image_bgr: NDArray[np.uint8], sensor: Sensor, seed: int, frame_index: int, moved: bool
) -> NDArray[np.uint8]:
    """A whole frame [H, W, 3]; `moved` says that it already contains motion blur."""
    sensor = drifted(sensor, seed, frame_index)
    if moved:
        sensor = replace(sensor, motion_px=(0.0, 0.0))
    return exposed(image_bgr, sensor, 1.0, np.random.default_rng([seed, 2, frame_index]))
