"""A camera's own marks on a picture: blur, exposure, colour, noise, compression; and things that are no aircraft."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sensor:
    """Lengths are pixels of the native frame; levels are of full scale, with gamma 2."""

    blur_sigma_px: float
    motion_px: tuple[float, float]
    gain: float
    contrast: float
    saturation: float
    cast_bgr: tuple[float, float, float]
    noise: float  # gamma 2 makes shot noise the same at every level
    read_noise: float  # felt in the dark
    jpeg_quality: int | None


def sensor_from(rng: np.random.Generator) -> Sensor:
    """A camera at random."""
    angle, moved = rng.uniform(0, np.pi), rng.uniform(0.5, 5.0) * (rng.random() < 0.35)
    grey = rng.random() < 0.07
    return Sensor(
        blur_sigma_px=float(rng.uniform(0.3, 1.0) if rng.random() < 0.85 else rng.uniform(1.0, 2.2)),
        motion_px=(float(moved * np.cos(angle)), float(moved * np.sin(angle))),
        gain=float(np.exp(rng.normal(0.0, 0.16))),
        contrast=float(rng.uniform(0.75, 1.25)),
        saturation=0.0 if grey else float(rng.uniform(0.5, 1.25)),
        cast_bgr=tuple(float(c) for c in 1.0 + (0.0 if grey else 0.05) * rng.normal(size=3)),  # type: ignore[arg-type]
        noise=float(np.exp(rng.uniform(np.log(0.002), np.log(0.025)))),
        read_noise=float(rng.uniform(0.0, 0.012)),
        jpeg_quality=int(rng.integers(35, 96)) if rng.random() < 0.5 else None,
    )


def _motion_kernel(motion_px: tuple[float, float]) -> NDArray[np.float32] | None:
    length = float(np.hypot(*motion_px))
    if length < 0.7:
        return None
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * half + 1):
        x, y = half + t * motion_px[0], half + t * motion_px[1]
        i, j = int(y), int(x)
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx]).astype(np.float32)
    return kernel / kernel.sum()


def exposed(image_bgr: NDArray[np.uint8], sensor: Sensor, scale: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture [H, W, 3] as this camera would deliver it; `scale` is picture pixels per native pixel, at most 1."""
    image: Any = image_bgr.astype(np.float32) * np.float32(1 / 255)
    sigma = sensor.blur_sigma_px * scale
    if sigma > 0.2:
        image = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    kernel = _motion_kernel((sensor.motion_px[0] * scale, sensor.motion_px[1] * scale))
    if kernel is not None:
        image = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    # Saturation, colour cast, gain and contrast are one affine map of the three channels.
    luma = np.tile(np.array([0.114, 0.587, 0.299], np.float32), (3, 1))
    mix = (sensor.saturation * np.eye(3) + (1 - sensor.saturation) * luma) * np.asarray(sensor.cast_bgr)[:, None]
    affine = np.hstack([sensor.contrast * sensor.gain * mix, np.full((3, 1), 0.45 * (1 - sensor.contrast))])
    image = cv2.transform(image, affine.astype(np.float32))
    # Averaging native pixels into one averages their noise, less than ideally because demosaicing correlates it.
    level = max(scale, 0.35)
    sigma_noise = (sensor.noise + sensor.read_noise * np.square(1.0 - np.clip(image, 0, 1))) * np.float32(level)
    image += sigma_noise * rng.standard_normal(image.shape, dtype=np.float32)
    out = cv2.convertScaleAbs(np.maximum(image, 0.0), alpha=255.0)
    if sensor.jpeg_quality is not None:
        quality = sensor.jpeg_quality if scale > 0.6 else max(sensor.jpeg_quality, 60)
        out = cv2.imdecode(cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    return np.asarray(out, dtype=np.uint8)


def _bird(rng: np.random.Generator, side: int) -> NDArray[np.float32]:
    alpha = np.zeros((side, side), np.uint8)
    span = rng.uniform(3.0, 0.22 * side)
    flap, turn = rng.uniform(-0.5, 0.5), rng.uniform(0, 2 * np.pi)
    chord, bend = rng.uniform(0.08, 0.2), rng.uniform(0.0, 0.25)
    elbow = bend * flap
    outline = np.array(
        [
            [-0.5, flap - 0.02],
            [-0.2, elbow - chord / 2],
            [0, -0.35 * chord],
            [0.2, elbow - chord / 2],
            [0.5, flap - 0.02],
            [0.22, elbow + chord / 2],
            [0.03, chord],
            [-0.03, chord],
            [-0.22, elbow + chord / 2],
        ]
    )
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = span * outline @ rotation.T + rng.uniform(0, side, 2)
    cv2.fillPoly(alpha, [np.round(points * 16).astype(np.int32)], 255, cv2.LINE_AA, shift=4)
    return np.asarray(alpha.astype(np.float32) / 255, np.float32)


def _blob(rng: np.random.Generator, side: int, radius: tuple[float, float]) -> NDArray[np.float32]:
    y, x = np.mgrid[:side, :side].astype(np.float32)
    centre, turn = rng.uniform(0, side, 2), rng.uniform(0, np.pi)
    a, b = rng.uniform(*radius, 2)
    u = (np.cos(turn) * (x - centre[0]) + np.sin(turn) * (y - centre[1])) / a
    v = (-np.sin(turn) * (x - centre[0]) + np.cos(turn) * (y - centre[1])) / b
    return np.exp(-0.5 * (u * u + v * v)).astype(np.float32)


def add_distractors(
    image_bgr: NDArray[np.uint8], coverage: NDArray[np.uint8], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Birds, specks and shreds of cloud on a square picture [S, S, 3], behind the aircraft."""
    side = image_bgr.shape[0]
    image, behind = image_bgr.astype(np.float32), 1.0 - coverage.astype(np.float32) / 255
    for _ in range(int(rng.integers(1, 5))):
        kind = rng.random()
        if kind < 0.6:
            alpha, level = _bird(rng, side), rng.uniform(10, 110) * np.ones(3)
        elif kind < 0.8:
            alpha, level = _blob(rng, side, (0.6, 2.5)), rng.uniform(0, 255) * np.ones(3)
        else:
            alpha, level = 0.7 * _blob(rng, side, (0.03 * side, 0.2 * side)), rng.uniform(140, 235) * np.ones(3)
        seen = (alpha * behind)[..., None]
        image += seen * (level.astype(np.float32) - image)
    return np.clip(image, 0, 255).astype(np.uint8)
